"""Rigid poses in float64, and the local frame every engine works in.

The local frame has the relay wall's centre as origin, the wall's x and y axes as x and y, and the wall's
normal as z. Everything is brought there in float64 before anything becomes float32, so that a scene
far from the origin of its own coordinates loses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]
MIN_LENGTH = 1e-12  # of a direction, whose numbers are near 1: below it is rounding of 0


@dataclass(frozen=True)
class Pose:
    """A rigid pose: columns of ``rotation`` are the frame's axes in scene coordinates, ``origin`` its origin [m]."""

    rotation: Float64  # (3, 3), orthonormal, determinant +1
    origin: Float64  # (3,) m

    @classmethod
    def from_normal_up(cls, center: ArrayLike, normal: ArrayLike, up: ArrayLike) -> Pose:
        """Build the pose whose z axis is ``normal`` and whose y axis is ``up`` made perpendicular to it.

        Parameters
        ----------
        center
            (3,) origin [m].
        normal, up
            (3,) directions, any length.

        Raises
        ------
        ValueError
            A direction is zero or not finite, or the two are parallel.
        """
        z, y = unit_direction(normal, "normal"), unit_direction(up, "up")
        y = y - np.dot(y, z) * z
        if np.linalg.norm(y) < 1e-9:
            raise ValueError(f"up {np.ravel(up).tolist()} is parallel to normal {np.ravel(normal).tolist()}")
        y = y / np.linalg.norm(y)
        return cls(np.column_stack([np.cross(y, z), y, z]), np.asarray(center, dtype=np.float64))

    @classmethod
    def identity(cls) -> Pose:
        """Return the pose of the scene's own frame."""
        return cls(np.eye(3), np.zeros(3))

    def to_local(self, points: ArrayLike) -> Float64:
        """Express scene points (..., 3) [m] in this frame."""
        return (np.asarray(points, dtype=np.float64) - self.origin) @ self.rotation

    def to_scene(self, points: ArrayLike) -> Float64:
        """Express points (..., 3) [m] of this frame in scene coordinates."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.origin

    def direction_to_local(self, directions: ArrayLike) -> Float64:
        """Express scene directions (..., 3) in this frame."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation

    def direction_to_scene(self, directions: ArrayLike) -> Float64:
        """Express directions (..., 3) of this frame in scene coordinates."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation.T

    def seen_from(self, frame: Pose) -> Pose:
        """Return this pose in the coordinates of another frame; both are given in the scene's."""
        return Pose(frame.rotation.T @ self.rotation, frame.to_local(self.origin))

    def matrix(self) -> Float64:
        """Return the (4, 4) homogeneous matrix from this frame to scene coordinates."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.origin
        return matrix

    def inverse_matrix(self) -> Float64:
        """Return the (4, 4) homogeneous matrix from scene coordinates to this frame."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T
        matrix[:3, 3] = -self.rotation.T @ self.origin
        return matrix


def euler_xyz(rotate_deg: ArrayLike) -> Float64:
    """Return the (3, 3) rotation about x, then y, then z by angles (3,) in degrees."""
    ax, ay, az = np.radians(np.asarray(rotate_deg, dtype=np.float64))
    rx = np.array([[1, 0, 0], [0, np.cos(ax), -np.sin(ax)], [0, np.sin(ax), np.cos(ax)]])
    ry = np.array([[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]])
    rz = np.array([[np.cos(az), -np.sin(az), 0], [np.sin(az), np.cos(az), 0], [0, 0, 1]])
    return rz @ ry @ rx


def cylinder_pose(center: ArrayLike, axis: ArrayLike) -> Pose:
    """Return the local frame of a cylinder: origin at the middle of its axis, y along the axis.

    Azimuth 0 (local z) is the scene's z axis made perpendicular to the axis; the scene's x axis when the cylinder's
    axis is within 1 degree of z.

    Parameters
    ----------
    center
        (3,) middle of the axis in the scene [m].
    axis
        (3,) direction of the axis, any length; ValueError for zero or one that is not finite.
    """
    y = unit_direction(axis, "axis")
    reference = np.array([0.0, 0.0, 1.0]) if abs(y[2]) < np.cos(np.radians(1.0)) else np.array([1.0, 0.0, 0.0])
    return Pose.from_normal_up(center, reference - np.dot(reference, y) * y, y)


def unit_direction(direction: ArrayLike, name: str) -> Float64:
    """Return a direction (3,) at length 1; ValueError, with its name, where it has none."""
    vector = np.asarray(direction, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    if not np.isfinite(length) or length < MIN_LENGTH:
        raise ValueError(f"{name} {vector.tolist()} has no direction: need a finite, non-zero vector")
    return vector / length
