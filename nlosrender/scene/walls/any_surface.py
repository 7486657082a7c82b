"""What stands for the relay wall where laser and sensor points lie on any surfaces of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

from nlosrender.scene.bounding_box import Bounds
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.walls.wall import RelayWall


@dataclass(frozen=True, eq=False)
class AnySurface(RelayWall):
    """All surfaces of a scene. It has no wall coordinates: points are what rays meet first."""

    pose: Pose  # of the engine's frame, in the scene
    box: Bounds  # around all surfaces [m, local frame]
    device: Float64  # (3,) where the camera stands [m, local frame]
    width = height = 0.0
    is_planar = False

    @property
    def area(self) -> NoReturn:
        raise self._no_coordinates

    @property
    def default_device_position(self) -> Float64:
        """Where the camera stands: (3,) local frame [m]."""
        return self.device

    def bounds(self) -> Bounds:
        return self.box

    def shape_description(self) -> NoReturn:
        raise self._no_coordinates

    def _positions(self, xy: Float64) -> NoReturn:
        raise self._no_coordinates

    _normals = _positions

    @property
    def _no_coordinates(self) -> ValueError:
        return ValueError("points that a camera sees lie on any surface, which has no wall coordinates")
