"""The relay wall: what every type has, and the flat rectangle.

Convention. A point of the wall is named by wall coordinates (x, y) in metres, with the origin at the wall's centre.
On all types but meshes they preserve area (dA = dx dy), so that a grid uniform in (x, y) is uniform in area:

- rectangle: x and y are the wall's own axes;
- sphere: the equal-area cylindrical projection (Lambert 1772): x = R * longitude, y = height above the equator;
- cylinder: x = R * azimuth (arc length), y = position along the axis;
- mesh: the file's texture coordinates (u, v) in [0, 1], centred and scaled to metres.

Everything is given in the local frame of the wall, whose pose in the scene is ``pose``: the rectangle lies in z = 0
with normal +z; a sphere has its centre as origin and the scene's axes; a cylinder has the centre of its axis as origin
and its axis as y; a mesh has its centroid as origin and its mean normal as z.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.bounding_box import Bounds
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64, Pose

EDGE_TOLERANCE = 1e-9  # relative to the wall's extent: decimal YAML numbers may overshoot the edge by rounding


class RelayWall(ABC):
    """What grids, engines and files need to know of a relay wall; immutable."""

    pose: Pose  # of the local frame in the scene
    width: float  # extent of the wall coordinate x [m]
    height: float  # extent of the wall coordinate y [m]
    is_planar: bool  # whether no point of the wall sees another one

    @property
    @abstractmethod
    def area(self) -> float:
        """Area of the lit side [m^2]."""

    @property
    @abstractmethod
    def default_device_position(self) -> Float64:
        """Where laser and sensor stand when the configuration does not say: (3,) local frame [m]."""

    @abstractmethod
    def bounds(self) -> Bounds:
        """Return the smallest and largest coordinates of the wall [m, local frame]."""

    @abstractmethod
    def shape_description(self) -> dict[str, object] | TriangleMesh:
        """Return a Mitsuba shape dict in the local frame, without bsdf (matrices as (4, 4) arrays), or a mesh."""

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return self._positions(self.on_wall(xy))

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the lit side at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return self._normals(self.on_wall(xy))

    def on_wall(self, xy: ArrayLike) -> Float64:
        """Return wall coordinates as an array (..., 2) [m]; ValueError for a wrong shape or a point off the wall."""
        xy = np.asarray(xy, dtype=np.float64)
        if xy.ndim < 1 or xy.shape[-1] != 2:
            raise ValueError(f"wall coordinates have shape {xy.shape}: need (..., 2)")
        outside = ~np.all(np.abs(xy) <= self._extent * (0.5 + EDGE_TOLERANCE), axis=-1)  # NaN is off the wall, too
        if np.any(outside):
            x, y = xy[outside][0]
            size = f"{self.width:g} x {self.height:g} m"
            raise ValueError(f"wall point ({x:g}, {y:g}) m is off the wall, which is {size}")
        return xy

    @property
    def _extent(self) -> Float64:
        return np.array([self.width, self.height])

    @abstractmethod
    def _positions(self, xy: Float64) -> Float64: ...

    @abstractmethod
    def _normals(self, xy: Float64) -> Float64: ...


def require_positive(**sizes: float) -> None:
    """Raise ValueError for a size of a relay wall [m] that is not finite and positive."""
    for name, size in sizes.items():
        if not (np.isfinite(size) and size > 0):
            raise ValueError(f"relay wall {name}: got {size!r}, need a finite number > 0 [m]")


@dataclass(frozen=True, eq=False)
class RectangleWall(RelayWall):
    """A flat wall in z = 0 of its local frame, lit on the +z side; ValueError for a size that is not positive."""

    pose: Pose  # of the wall's centre, axes and normal in the scene
    width: float  # along the local x axis [m], > 0
    height: float  # along the local y axis [m], > 0
    is_planar = True

    def __post_init__(self) -> None:
        require_positive(width=self.width, height=self.height)

    @property
    def area(self) -> float:
        return self.width * self.height

    @property
    def default_device_position(self) -> Float64:
        """1 m in front of the wall's centre: (3,) local frame [m]."""
        return np.array([0.0, 0.0, 1.0])

    def bounds(self) -> Bounds:
        half = np.array([self.width / 2, self.height / 2, 0.0])
        return -half, half

    def shape_description(self) -> dict[str, object]:
        return {"type": "rectangle", "to_world": np.diag([self.width / 2, self.height / 2, 1.0, 1.0])}

    def _positions(self, xy: Float64) -> Float64:
        return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)

    def _normals(self, xy: Float64) -> Float64:
        return np.broadcast_to([0.0, 0.0, 1.0], (*xy.shape[:-1], 3)).copy()
