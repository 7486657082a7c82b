"""``capture.camera``: where a line-of-sight capture is seen from."""

from __future__ import annotations

import math
from collections.abc import Iterator

from nlosrender.config.fields import Direction, FieldOfView, GridCount, Point3
from nlosrender.config.refusal import Fault, shown
from nlosrender.config.section import Section
from nlosrender.config.vectors import parallel


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

    def rules(self) -> Iterator[Fault]:
        """Yield the fault of a camera that looks nowhere, or whose picture has no up."""
        towards = tuple(a - b for a, b in zip(self.look_at, self.position, strict=True))
        needs = (("position",), ("look_at",), ("up",))
        if math.hypot(*towards) < 1e-9:
            yield Fault(
                ("look_at",), f"got {shown(self.look_at)}, the camera's position, need another point.", "value", needs
            )
        elif parallel(towards, self.up):
            message = f"got {shown(self.up)}, the direction the camera looks in, need one across it."
            yield Fault(("up",), message, "value", needs)
