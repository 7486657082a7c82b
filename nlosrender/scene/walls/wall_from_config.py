"""Builds the relay wall of a configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nlosrender.errors import ConfigError
from nlosrender.scene.picture_orientation import has_picture
from nlosrender.scene.pose import Pose, cylinder_pose
from nlosrender.scene.walls.mesh_wall import mesh_wall_from_config
from nlosrender.scene.walls.round_walls import CylinderWall, SphereWall
from nlosrender.scene.walls.wall import RectangleWall, RelayWall

if TYPE_CHECKING:
    from nlosrender.config.relay_wall import RelayWallConfig


def relay_wall_from_config(wall: RelayWallConfig) -> RelayWall:
    """Return the relay wall of ``scene.relay_wall``, whose ``pose`` defines the local frame of everything else.

    Raises
    ------
    ConfigError
        The type is unknown, a size is not positive, a pose is degenerate, or a mesh cannot be a wall.
    """
    try:
        if wall.type == "rectangle":
            pose = Pose.from_normal_up(wall.center, wall.normal, wall.up)
            return RectangleWall(pose, float(wall.width), float(wall.height))
        if wall.type == "mesh":
            return mesh_wall_from_config(wall)
        if wall.type in ("sphere", "cylinder"):
            pictured, radius, inside = has_picture(wall.bsdf), float(wall.radius), bool(wall.inside)
            if wall.type == "sphere":
                return SphereWall(np.asarray(wall.center, dtype=np.float64), radius, inside, pictured)
            return CylinderWall(cylinder_pose(wall.center, wall.axis), radius, float(wall.height), inside, pictured)
    except ValueError as error:
        raise ConfigError.at("scene.relay_wall", f"{error}.") from error
    raise ConfigError.at("scene.relay_wall.type", f"got {wall.type!r}, need rectangle, sphere, cylinder or mesh.")
