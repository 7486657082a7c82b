"""``capture.camera``: where a scene is seen from."""

from __future__ import annotations

import math
from collections.abc import Iterator

from nlosrender.config.fields import Direction, FieldOfView, GridCount, Point3
from nlosrender.config.issues import shown
from nlosrender.config.section import Section
from nlosrender.config.vectors import parallel
from nlosrender.errors import ValidationIssue


class CameraConfig(Section):
    """A pinhole camera; its image plane is taken to lie through ``look_at``."""

    position: Point3
    """m, scene coordinates"""
    look_at: Point3
    """m, the point in the middle of the picture"""
    up: Direction = (0.0, 1.0, 0.0)
    """direction that is up in the picture, any length"""
    fov_deg: FieldOfView = 40.0
    """degrees, horizontal field of view"""
    width: GridCount
    """pixels of a row"""
    height: GridCount
    """pixels of a column"""

    def rule_direction(self) -> Iterator[ValidationIssue]:
        """The camera looks somewhere, and its picture has an up."""
        towards = tuple(a - b for a, b in zip(self.look_at, self.position, strict=True))
        if math.hypot(*towards) < 1e-9:
            message = f"got {shown(self.look_at)}, the camera's position, need another point."
            yield ValidationIssue(("look_at",), message)
        elif parallel(towards, self.up):
            message = f"got {shown(self.up)}, the direction the camera looks in, need one across it."
            yield ValidationIssue(("up",), message)
