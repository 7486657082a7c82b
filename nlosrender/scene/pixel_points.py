"""Laser and sensor points of a capture with a camera: the first surface that each ray meets, on whatever shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.walls.wall import RectangleWall

NO_SHAPE = -1


@dataclass(frozen=True, eq=False)
class FirstHits:
    """What a grid of rays meets first; arrays (rows, columns, ...)."""

    origin: Float64  # (3,) of all rays [m, frame of the scene that they were traced in]
    directions: Float64  # (..., 3) unit
    positions: Float64  # (..., 3) m; where nothing is met, these and the normals are those of another ray
    normals: Float64  # (..., 3) unit, on the side that is seen
    is_front: NDArray[np.bool_]  # the ray arrives on the side that the surface's own normal looks to
    shapes: NDArray[np.int64]  # number in the scene; NO_SHAPE: nothing is met
    is_reached: NDArray[np.bool_]  # the ray gets there
    interactions: Any  # of all rays, on the device, row by row; without a shape where not reached

    @property
    def is_empty(self) -> NDArray[np.bool_]:
        """Which rays meet nothing."""
        return np.asarray(self.shapes == NO_SHAPE)

    @property
    def n_hidden(self) -> int:
        """Number of rays that are aimed at a surface and do not get there."""
        return int((~self.is_reached & ~self.is_empty).sum())


@dataclass(frozen=True, eq=False)
class PixelAreas:
    """The pixels of a camera on its image plane, as vectors from where it stands [m, frame of the points]."""

    corners: Float64  # (rows, columns, 3) to the lower left corner of each pixel
    edges: Float64  # (2, 3) along a pixel to the right, and up
    reach: float  # of all pixels, see ``PixelFootprint``


@dataclass(frozen=True, eq=False)
class PixelPoints:
    """The sensor points of a camera's pixels, and the laser points."""

    frame: Pose  # of all positions, in the scene
    sensors: FirstHits
    lasers: FirstHits
    areas: PixelAreas | None = None  # that sensor points stand for; None: they are points

    @property
    def laser(self) -> Float64:
        """Where the laser stands (3,) [m]."""
        return self.lasers.origin

    @property
    def laser_follows(self) -> bool:
        """Whether the laser points are the sensor points."""
        return self.lasers.positions is self.sensors.positions

    def wall_coordinates(self, wall: RectangleWall) -> tuple[Float64, Float64]:
        """Return wall coordinates (..., 2) [m] of sensor and laser points that all lie on a rectangle.

        In float64, where the rays meet its plane; rays that meet nothing have those of another one.
        """
        sensors = self._on_rectangle(wall, self.sensors)
        return sensors, sensors if self.laser_follows else self._on_rectangle(wall, self.lasers)

    def _on_rectangle(self, wall: RectangleWall, hits: FirstHits) -> Float64:
        points, eye = (wall.pose.to_local(self.frame.to_scene(each)) for each in (hits.positions, hits.origin))
        ways = wall.pose.direction_to_local(self.frame.direction_to_scene(hits.directions))
        met = eye - ways * (eye[2] / np.where(ways[..., 2] == 0, 1.0, ways[..., 2]))[..., None]
        exact = np.where(hits.is_reached[..., None], met, points)[..., :2]
        half = np.array([wall.width, wall.height]) / 2
        return np.clip(exact, -half, half)
