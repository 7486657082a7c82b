"""Spheres and tubes as relay walls, lit from within or from outside.

Wall coordinates preserve area: the equal-area cylindrical projection of a sphere, arc length and height on a tube.
Longitude and azimuth are 0 in the direction of local +z and grow towards local +x.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np

from nlosrender.scene.bounding_box import Bounds
from nlosrender.scene.picture_orientation import round_plugin
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.walls.wall import RelayWall, require_positive


class _RoundWall(RelayWall):
    """What spheres and tubes about the local y axis share."""

    radius: float
    inside: bool
    has_picture: bool
    is_planar = False

    @property
    def default_device_position(self) -> Float64:
        """The middle of a wall lit from within, else 1 m in front of wall coordinates (0, 0): (3,) [m]."""
        return np.array([0.0, 0.0, 0.0 if self.inside else self.radius + 1.0])

    def bounds(self) -> Bounds:
        half = np.array([self.radius, self.height / 2, self.radius])
        return -half, half

    @abstractmethod
    def _outward(self, xy: Float64) -> Float64:
        """Return unit vectors (..., 3) that point away from the centre or axis."""

    def _positions(self, xy: Float64) -> Float64:
        return self.radius * self._outward(xy)

    def _normals(self, xy: Float64) -> Float64:
        return -self._outward(xy) if self.inside else self._outward(xy)

    def _plugin(self, height: float | None) -> dict[str, object]:
        return round_plugin(self.radius, height, inside=self.inside, turned=self.inside and self.has_picture)


@dataclass(frozen=True, eq=False)
class SphereWall(_RoundWall):
    """A whole sphere as relay wall; wall coordinates are the equal-area cylindrical projection.

    Its local frame has the sphere's centre and the scene's axes. ValueError for a radius that is not positive.
    """

    center: Float64  # (3,) in the scene [m]
    radius: float  # m, > 0
    inside: bool = True  # lit from within: normals point to the centre
    # whether texture coordinates matter; without, the frames that directions are sampled in stay Mitsuba's
    has_picture: bool = False
    pose: Pose = field(init=False)
    width: float = field(init=False)  # the equator's length
    height: float = field(init=False)  # the diameter

    def __post_init__(self) -> None:
        require_positive(radius=self.radius)
        object.__setattr__(self, "pose", Pose(np.eye(3), np.asarray(self.center, dtype=np.float64)))
        object.__setattr__(self, "width", 2 * np.pi * self.radius)
        object.__setattr__(self, "height", 2 * self.radius)

    @property
    def area(self) -> float:
        return 4 * np.pi * self.radius**2

    def shape_description(self) -> dict[str, object]:
        return self._plugin(None)

    def _outward(self, xy: Float64) -> Float64:
        longitude = xy[..., 0] / self.radius
        sine = np.clip(xy[..., 1] / self.radius, -1.0, 1.0)
        cosine = np.sqrt((1.0 - sine) * (1.0 + sine))
        return np.stack([cosine * np.sin(longitude), sine, cosine * np.cos(longitude)], axis=-1)


@dataclass(frozen=True, eq=False)
class CylinderWall(_RoundWall):
    """An open tube as relay wall; wall coordinates are arc length and position along the axis.

    ValueError for a size that is not positive.
    """

    pose: Pose  # of the middle of the axis; the axis is the local y axis
    radius: float  # m, > 0
    height: float  # m, > 0
    inside: bool = True  # lit from within: normals point to the axis
    has_picture: bool = False  # as of ``SphereWall``
    width: float = field(init=False)  # the circumference

    def __post_init__(self) -> None:
        require_positive(radius=self.radius, height=self.height)
        object.__setattr__(self, "width", 2 * np.pi * self.radius)

    @property
    def area(self) -> float:
        return self.width * self.height

    def shape_description(self) -> dict[str, object]:
        return self._plugin(self.height)

    def _outward(self, xy: Float64) -> Float64:
        azimuth = xy[..., 0] / self.radius
        return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], axis=-1)

    def _positions(self, xy: Float64) -> Float64:
        points = super()._positions(xy)
        points[..., 1] = xy[..., 1]
        return points
