"""The relay wall: wall coordinates, positions, normals and texture coordinates of every wall type.

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

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.mesh_wall import mesh_wall_from_config
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pictures import has_picture
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.round_walls import CylinderWall, SphereWall, cylinder_pose
from nlosrender.scene.wall_coordinates import on_wall, require_positive

if TYPE_CHECKING:
    from nlosrender.config.relay_wall import RelayWallConfig


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

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the wall, (3,) and (3,) [m, local frame]."""

    def shape_description(self) -> dict[str, object] | TriangleMesh:
        """Return a Mitsuba shape dict in the local frame, without bsdf (matrices as (4, 4) arrays), or a mesh."""


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
        require_positive("relay wall", width=self.width, height=self.height)

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
        xy = on_wall(self, xy)
        return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)

    def normals(self, xy: ArrayLike) -> Float64:
        """Return the unit normals (..., 3) at wall coordinates (..., 2) [m]: +z; ValueError off the wall."""
        xy = on_wall(self, xy)
        return np.broadcast_to([0.0, 0.0, 1.0], (*xy.shape[:-1], 3)).copy()

    def uv(self, xy: ArrayLike) -> Float64:
        """Return Mitsuba's texture coordinates (..., 2), 0 to 1 along x and y; ValueError off the wall.

        v grows along y, and pictures lie the other way up (``pictures.upright_bsdf``).
        """
        return on_wall(self, xy) / [self.width, self.height] + 0.5

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the wall, (3,) and (3,) [m, local frame]."""
        half = np.array([self.width / 2, self.height / 2, 0.0])
        return -half, half

    def shape_description(self) -> dict[str, object]:
        """Return the Mitsuba shape dict in the local frame, without bsdf."""
        return {"type": "rectangle", "to_world": np.diag([self.width / 2, self.height / 2, 1.0, 1.0])}


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
        The type is unknown, a size is not positive, a pose is degenerate, or a mesh cannot be a wall; the message
        begins with the key then.
    """
    wall = relay_wall_config
    pictured = has_picture(wall.bsdf)
    if wall.type == "rectangle":
        pose = Pose.from_normal_up(wall.center, wall.normal, wall.up)
        return RectangleWall(pose, float(wall.width), float(wall.height))
    if wall.type == "sphere":
        return SphereWall(np.asarray(wall.center, dtype=np.float64), float(wall.radius), bool(wall.inside), pictured)
    if wall.type == "cylinder":
        return CylinderWall(
            cylinder_pose(wall.center, wall.axis), float(wall.radius), float(wall.height), bool(wall.inside), pictured
        )
    if wall.type == "mesh":
        return mesh_wall_from_config(wall)
    raise ValueError(f"relay wall type {wall.type!r}: need rectangle, sphere, cylinder or mesh")
