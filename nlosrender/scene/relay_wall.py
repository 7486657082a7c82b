"""The relay wall: wall coordinates, positions, normals and texture coordinates of every wall type.

Convention. A point of the wall is named by wall coordinates (x, y) in metres, with the origin at the wall's centre.
They preserve area on every type (dA = dx dy), so that a grid uniform in (x, y) is uniform in area:

- rectangle: x and y are the wall's own axes;
- sphere: the equal-area cylindrical projection (Lambert 1772): x = R * longitude, y = height above the equator;
- cylinder: x = R * azimuth (arc length), y = position along the axis.

Longitude and azimuth are 0 in the direction of local +z and grow towards local +x. Everything is given in the local
frame of the wall, whose pose in the scene is ``pose``: the rectangle lies in z = 0 with normal +z; a sphere has its
centre as origin and the scene's axes; a cylinder has the centre of its axis as origin and its axis as y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pose import Float64, Pose

if TYPE_CHECKING:
    from nlosrender.config.relay_wall import RelayWallConfig

EDGE_TOLERANCE = 1e-9  # relative to the wall's extent: decimal YAML numbers may overshoot the edge by rounding

# Mitsuba's sphere and cylinder have z as their axis and azimuth 0 at x; the wall has its axis on y, azimuth 0 at z.
_POLAR_AXIS_TO_Y = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class RelayWall(Protocol):
    """What grids, engines and files need to know of a relay wall; immutable."""

    @property
    def pose(self) -> Pose:
        """Pose of the local frame in the scene."""

    @property
    def width(self) -> float:
        """Extent of the wall coordinate x [m]."""

    @property
    def height(self) -> float:
        """Extent of the wall coordinate y [m]."""

    @property
    def is_planar(self) -> bool:
        """Whether no point of the wall sees another one."""

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""

    @property
    def default_device_position(self) -> Float64:
        """Where laser and sensor stand when the configuration does not say: (3,) local frame [m]."""

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the lit side at wall coordinates (..., 2) [m]; ValueError off the wall."""

    def uv(self, xy: ArrayLike) -> Float64:
        """Return Mitsuba's texture coordinates (..., 2) at wall coordinates (..., 2) [m]; ValueError off the wall."""

    def shape_description(self) -> dict[str, object]:
        """Return the wall as a Mitsuba shape dict in the local frame, without bsdf; matrices as (4, 4) arrays."""


@dataclass(frozen=True, eq=False)
class RectangleWall:
    """A flat wall in z = 0 of its local frame, lit on the +z side.

    Parameters
    ----------
    pose
        Pose of the wall's centre, axes and normal in the scene.
    width, height
        Extent along the local x and y axes [m], > 0.

    Raises
    ------
    ValueError
        A size is not finite and positive.
    """

    pose: Pose
    width: float
    height: float

    def __post_init__(self) -> None:
        _require_positive("relay wall", width=self.width, height=self.height)

    @property
    def is_planar(self) -> bool:
        """True: no point of the wall sees another one."""
        return True

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return self.width * self.height

    @property
    def default_device_position(self) -> Float64:
        """1 m in front of the wall's centre: (3,) local frame [m]."""
        return np.array([0.0, 0.0, 1.0])

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        xy = _on_wall(self, xy)
        return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)

    def normals(self, xy: ArrayLike) -> Float64:
        """Return the unit normals (..., 3) at wall coordinates (..., 2) [m]: +z; ValueError off the wall."""
        xy = _on_wall(self, xy)
        return np.broadcast_to([0.0, 0.0, 1.0], (*xy.shape[:-1], 3)).copy()

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2), 0 to 1 along x and y; ValueError off the wall."""
        return _on_wall(self, xy) / [self.width, self.height] + 0.5

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return {"type": "rectangle", "to_world": np.diag([self.width / 2, self.height / 2, 1.0, 1.0])}


@dataclass(frozen=True, eq=False)
class SphereWall:
    """A whole sphere as relay wall; wall coordinates are the equal-area cylindrical projection.

    Parameters
    ----------
    center
        (3,) centre in the scene [m].
    radius
        Radius [m], > 0.
    inside
        Lit from within: normals point to the centre.

    Raises
    ------
    ValueError
        The radius is not finite and positive.
    """

    center: Float64
    radius: float
    inside: bool = True

    def __post_init__(self) -> None:
        _require_positive("relay wall", radius=self.radius)

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
    def is_planar(self) -> bool:
        """False: light may go from the wall to the wall."""
        return False

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return 4 * np.pi * self.radius**2

    @property
    def default_device_position(self) -> Float64:
        """The centre of a sphere lit from within, else 1 m in front of wall coordinates (0, 0): (3,) [m]."""
        return np.array([0.0, 0.0, 0.0 if self.inside else self.radius + 1.0])

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return self.radius * self._outward(xy)

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the lit side at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return -self._outward(xy) if self.inside else self._outward(xy)

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2): u = longitude / 2 pi in [0, 1), v = 0 at the +y pole, 1 at the -y pole.

        Raises
        ------
        ValueError
            A point is off the wall.
        """
        xy = _on_wall(self, xy)
        v = np.arccos(np.clip(xy[..., 1] / self.radius, -1.0, 1.0)) / np.pi
        return np.stack([_turns(xy[..., 0] / self.radius), v], axis=-1)

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return {
            "type": "sphere",
            "center": [0.0, 0.0, 0.0],
            "radius": float(self.radius),
            "to_world": _POLAR_AXIS_TO_Y.copy(),
            "flip_normals": bool(self.inside),
        }

    def _outward(self, xy: ArrayLike) -> Float64:
        xy = _on_wall(self, xy)
        longitude = xy[..., 0] / self.radius
        sine = np.clip(xy[..., 1] / self.radius, -1.0, 1.0)
        cosine = np.sqrt((1.0 - sine) * (1.0 + sine))
        return np.stack([cosine * np.sin(longitude), sine, cosine * np.cos(longitude)], axis=-1)


@dataclass(frozen=True, eq=False)
class CylinderWall:
    """An open tube as relay wall; wall coordinates are arc length and position along the axis.

    Parameters
    ----------
    pose
        Pose in the scene of the middle of the axis; the axis is the local y axis.
    radius, height
        Radius and length of the tube [m], > 0.
    inside
        Lit from within: normals point to the axis.

    Raises
    ------
    ValueError
        A size is not finite and positive.
    """

    pose: Pose
    radius: float
    height: float
    inside: bool = True

    def __post_init__(self) -> None:
        _require_positive("relay wall", radius=self.radius, height=self.height)

    @property
    def width(self) -> float:
        """Extent of the wall coordinate x [m]: the circumference."""
        return 2 * np.pi * self.radius

    @property
    def is_planar(self) -> bool:
        """False: light may go from the wall to the wall."""
        return False

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return self.width * self.height

    @property
    def default_device_position(self) -> Float64:
        """The middle of the axis of a tube lit from within, else 1 m in front of wall coordinates (0, 0): (3,) [m]."""
        return np.array([0.0, 0.0, 0.0 if self.inside else self.radius + 1.0])

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ValueError off the wall."""
        points = self.radius * self._outward(xy)
        points[..., 1] = np.asarray(xy, dtype=np.float64)[..., 1]
        return points

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the lit side at wall coordinates (..., 2) [m]; ValueError off the wall."""
        return -self._outward(xy) if self.inside else self._outward(xy)

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2): u = azimuth / 2 pi in [0, 1), v from 0 at -y to 1 at +y.

        Raises
        ------
        ValueError
            A point is off the wall.
        """
        xy = _on_wall(self, xy)
        return np.stack([_turns(xy[..., 0] / self.radius), xy[..., 1] / self.height + 0.5], axis=-1)

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return {
            "type": "cylinder",
            "p0": [0.0, 0.0, -self.height / 2],
            "p1": [0.0, 0.0, self.height / 2],
            "radius": float(self.radius),
            "to_world": _POLAR_AXIS_TO_Y.copy(),
            "flip_normals": bool(self.inside),
        }

    def _outward(self, xy: ArrayLike) -> Float64:
        xy = _on_wall(self, xy)
        azimuth = xy[..., 0] / self.radius
        return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], axis=-1)


def relay_wall_from_config(relay_wall_config: RelayWallConfig) -> RelayWall:
    """Build the relay wall of a configuration.

    Parameters
    ----------
    relay_wall_config
        ``scene.relay_wall``; poses in scene coordinates [m].

    Returns
    -------
    RelayWall
        The wall; its ``pose`` defines the local frame of everything else.

    Raises
    ------
    ValueError
        The type is unknown, a size is not positive, or a pose is degenerate.
    """
    wall = relay_wall_config
    if wall.type == "rectangle":
        pose = Pose.from_normal_up(wall.center, wall.normal, wall.up)
        return RectangleWall(pose, float(wall.width), float(wall.height))
    if wall.type == "sphere":
        return SphereWall(np.asarray(wall.center, dtype=np.float64), float(wall.radius), bool(wall.inside))
    if wall.type == "cylinder":
        return CylinderWall(
            cylinder_pose(wall.center, wall.axis), float(wall.radius), float(wall.height), bool(wall.inside)
        )
    raise ValueError(f"relay wall type {wall.type!r}: need rectangle, sphere or cylinder")


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


def _on_wall(wall: RelayWall, xy: ArrayLike) -> Float64:
    xy = np.asarray(xy, dtype=np.float64)
    if xy.ndim < 1 or xy.shape[-1] != 2:
        raise ValueError(f"wall coordinates have shape {xy.shape}: need (..., 2)")
    limit = np.array([wall.width, wall.height]) * (0.5 + EDGE_TOLERANCE)
    outside = ~np.all(np.abs(xy) <= limit, axis=-1)  # not "any >": NaN is off the wall, too
    if np.any(outside):
        x, y = xy[outside][0]
        raise ValueError(f"wall point ({x:g}, {y:g}) m is off the wall, which is {wall.width:g} x {wall.height:g} m")
    return xy


def _turns(angle: Float64) -> Float64:
    turns = np.mod(angle / (2 * np.pi), 1.0)
    return np.where(turns < 1.0, turns, 0.0)  # mod of a tiny negative angle rounds up to 1.0


def _require_positive(owner: str, **sizes: float) -> None:
    for name, size in sizes.items():
        if not (np.isfinite(size) and size > 0):
            raise ValueError(f"{owner} {name}: got {size!r}, need a finite number > 0 [m]")
