"""Spheres and tubes as relay walls, lit from within or from outside.

Wall coordinates preserve area: the equal-area cylindrical projection of a sphere, arc length and height on a tube.
Longitude and azimuth are 0 in the direction of local +z and grow towards local +x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pictures import round_plugin
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.wall_coordinates import on_wall, require_positive


class _RoundWall(ABC):
    """What spheres and tubes about the local y axis share."""

    radius: float
    inside: bool
    has_picture: bool

    @abstractmethod
    def _outward(self, xy: ArrayLike) -> Float64:
        """Return unit vectors (..., 3) that point away from the centre or axis; ValueError off the wall."""

    @property
    def _sense(self) -> int:
        """Whether u grows along the wall coordinate x, 1, or against it, -1: a picture's, seen from within."""
        return -1 if self.inside and self.has_picture else 1

    def _turns(self, xy: Float64) -> Float64:
        """Return u (...,) in [0, 1): 1/2 at wall coordinate x = 0."""
        turns = np.mod(0.5 + self._sense * xy[..., 0] / (2 * np.pi * self.radius), 1.0)
        return np.where(turns < 1.0, turns, 0.0)  # mod of a tiny negative number rounds up to 1.0

    @property
    def is_planar(self) -> bool:
        """False: light may go from the wall to the wall."""
        return False

    @property
    def default_device_position(self) -> Float64:
        """The middle of a wall lit from within, else 1 m in front of wall coordinates (0, 0): (3,) [m]."""
        return np.array([0.0, 0.0, 0.0 if self.inside else self.radius + 1.0])

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the lit side at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return -self._outward(xy) if self.inside else self._outward(xy)


@dataclass(frozen=True, eq=False)
class SphereWall(_RoundWall):
    """A whole sphere as relay wall; wall coordinates are the equal-area cylindrical projection.

    Parameters
    ----------
    center
        (3,) centre in the scene [m].
    radius
        Radius [m], > 0.
    inside
        Lit from within: normals point to the centre.
    has_picture
        Whether texture coordinates matter; without, the frames that directions are sampled in stay Mitsuba's.

    Raises
    ------
    ValueError
        The radius is not finite and positive.
    """

    center: Float64
    radius: float
    inside: bool = True
    has_picture: bool = False

    def __post_init__(self) -> None:
        require_positive("relay wall", radius=self.radius)

    @property
    def pose(self) -> Pose:
        """Pose of the local frame in the scene: the sphere's centre, the scene's axes."""
        return Pose(np.eye(3), np.asarray(self.center, dtype=np.float64))

    @property
    def width(self) -> float:
        """Extent of the wall coordinate x [m]: the equator's length."""
        return 2 * np.pi * self.radius

    @property
    def height(self) -> float:
        """Extent of the wall coordinate y [m]: the diameter."""
        return 2 * self.radius

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return 4 * np.pi * self.radius**2

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return self.radius * self._outward(xy)

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2): u = 1/2 + longitude / 2 pi in [0, 1), v = 0 at the +y pole, 1 at -y.

        Of a picture seen from within u runs the other way.

        Raises
        ------
        ValueError
            A point is off the wall.
        """
        xy = on_wall(self, xy)
        v = np.arccos(np.clip(xy[..., 1] / self.radius, -1.0, 1.0)) / np.pi
        return np.stack([self._turns(xy), v], axis=-1)

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the wall, (3,) and (3,) [m, local frame]."""
        half = np.array([self.radius, self.height / 2, self.radius])
        return -half, half

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return round_plugin(self.radius, None, inside=self.inside, turned=self._sense < 0)

    def _outward(self, xy: ArrayLike) -> Float64:
        xy = on_wall(self, xy)
        longitude = xy[..., 0] / self.radius
        sine = np.clip(xy[..., 1] / self.radius, -1.0, 1.0)
        cosine = np.sqrt((1.0 - sine) * (1.0 + sine))
        return np.stack([cosine * np.sin(longitude), sine, cosine * np.cos(longitude)], axis=-1)


@dataclass(frozen=True, eq=False)
class CylinderWall(_RoundWall):
    """An open tube as relay wall; wall coordinates are arc length and position along the axis.

    Parameters
    ----------
    pose
        Pose in the scene of the middle of the axis; the axis is the local y axis.
    radius, height
        Radius and length of the tube [m], > 0.
    inside
        Lit from within: normals point to the axis.
    has_picture
        Whether texture coordinates matter; without, the frames that directions are sampled in stay Mitsuba's.

    Raises
    ------
    ValueError
        A size is not finite and positive.
    """

    pose: Pose
    radius: float
    height: float
    inside: bool = True
    has_picture: bool = False

    def __post_init__(self) -> None:
        require_positive("relay wall", radius=self.radius, height=self.height)

    @property
    def width(self) -> float:
        """Extent of the wall coordinate x [m]: the circumference."""
        return 2 * np.pi * self.radius

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return self.width * self.height

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        points = self.radius * self._outward(xy)
        points[..., 1] = np.asarray(xy, dtype=np.float64)[..., 1]
        return points

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2): u = 1/2 + azimuth / 2 pi in [0, 1), v from 0 at -y to 1 at +y.

        Of a picture seen from within both run the other way; others ``pictures.upright_bsdf`` turns over.

        Raises
        ------
        ValueError
            A point is off the wall.
        """
        xy = on_wall(self, xy)
        return np.stack([self._turns(xy), self._sense * xy[..., 1] / self.height + 0.5], axis=-1)

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the wall, (3,) and (3,) [m, local frame]."""
        half = np.array([self.radius, self.height / 2, self.radius])
        return -half, half

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return round_plugin(self.radius, self.height, inside=self.inside, turned=self._sense < 0)

    def _outward(self, xy: ArrayLike) -> Float64:
        xy = on_wall(self, xy)
        azimuth = xy[..., 0] / self.radius
        return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], axis=-1)


def cylinder_pose(center: ArrayLike, axis: ArrayLike) -> Pose:
    """Return the local frame of a cylinder: origin at the middle of its axis, y along the axis.

    Azimuth 0 (local z) is the scene's z axis made perpendicular to the axis; the scene's x axis when the cylinder's
    axis is within 1 degree of z.

    Parameters
    ----------
    center
        (3,) middle of the axis in the scene [m].
    axis
        (3,) direction of the axis, any length.

    Raises
    ------
    ValueError
        The axis is zero or not finite.
    """
    axis = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError(f"axis {axis.tolist()} has no direction: need a finite, non-zero vector")
    y = axis / length
    reference = np.array([0.0, 0.0, 1.0]) if abs(y[2]) < np.cos(np.radians(1.0)) else np.array([1.0, 0.0, 0.0])
    return Pose.from_normal_up(center, reference - np.dot(reference, y) * y, y)
