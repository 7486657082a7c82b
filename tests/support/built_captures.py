"""Captures built from stand-ins of a configuration, for tests that need no YAML."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from nlosrender.capture.grids import Capture, build_capture
from nlosrender.scene.walls.wall import RelayWall


def grid(nx: int, ny: int, width: float | None = None, height: float | None = None) -> Any:
    """Return a ``GridConfig``."""
    return SimpleNamespace(nx=nx, ny=ny, width=width, height=height)


def built_capture(wall: RelayWall, **changes: Any) -> Capture:
    """Return an exhaustive capture of 5 x 3 sensor and 7 x 2 laser points, with ``changes`` of its section."""
    keys = {
        "scan_type": "exhaustive",
        "sensor_grid": grid(5, 3),
        "laser_grid": grid(7, 2, 1.4, 0.4),
        "laser_energy": 1.0,
        "laser_spot_radius": 0.0,
        "account_first_and_last_bounces": True,
    }
    absent = ("sensor_list", "laser_list", "spot_list", "laser_spot_weights", "footprint", "laser_flash")
    absent += ("laser_point", "laser_position", "sensor_position")
    return build_capture(SimpleNamespace(**dict.fromkeys(absent) | keys | changes), wall)
