"""Configurations of scans whose points a camera sees: what they need, and how mistakes are told."""

from __future__ import annotations

from typing import Any

import pytest
from support.rendering import configured, flat_wall

from nlosrender.config.load import config_to_dict
from nlosrender.config.warnings import config_warnings
from nlosrender.errors import ConfigError

CAMERA = {"position": [0, 0, 3], "look_at": [0, 0, 0], "width": 5, "height": 3}
ITEM = {"type": "rectangle", "width": 2.0, "height": 1.6, "normal": [0, 0, 1], "center": [0, 0, 0]}


def pixels(scan: str = "single", **capture: Any) -> dict[str, Any]:
    """Return a configuration without relay wall and grid."""
    config = flat_wall(ITEM, scan=scan)
    del config["scene"]["relay_wall"]
    for key in ("sensor_grid", "laser_grid", "laser_point"):
        config["capture"].pop(key, None)
    config["capture"] |= {"camera": CAMERA, "laser_target": [0, 0, 0], **capture}
    return config


@pytest.mark.parametrize(("scan", "lasers"), [("single", 1), ("confocal", 1), ("exhaustive", 15)])
def test_a_camera_takes_the_place_of_wall_and_grids(scan: str, lasers: int) -> None:
    """Its pixels are the sensor points; an exhaustive scan without targets lights each of them."""
    config = configured(pixels(scan))
    assert config.has_pixel_points
    assert (config.capture.n_sensors, config.capture.n_lasers) == (15, lasers)
    assert config_to_dict(configured(config_to_dict(config))) == config_to_dict(config)


def test_what_grids_need_has_no_effect_beside_a_camera() -> None:
    """Keys of grids on a wall are told in one warning, and make the same capture."""
    grids = {"sensor_points": [[0, 0]], "laser_point": [0.1, 0], "sensor_position": [0, 0, 1]}
    config = configured(pixels(**grids))
    assert config_to_dict(config) == config_to_dict(configured(pixels()))
    (note,) = [text for text in config_warnings(config) if "no effect" in text]
    assert all(key in note for key in grids)


@pytest.mark.parametrize(
    ("config", "key", "message"),
    [
        (pixels(laser_target=None), "capture.laser_target", "missing, the laser of a single scan with a camera"),
        (pixels("exhaustive", laser_targets=[]), "capture.laser_targets", "at least one point, or null"),
        (pixels(pixel_point=[0.5, 1.5]), "capture.pixel_point", "two numbers from 0 to 1"),
        (pixels(laser_spot_radius=0.1), "capture.laser_spot_radius", "need 0, or a grid on a rectangle"),
        (pixels() | {"render": {"polarized": True}}, "render.polarized", "the points of a camera lie on any surface"),
        (pixels() | {"output": {"ground_truth": ["depth"]}}, "output.ground_truth", "a capture with a camera has none"),
        (pixels() | {"sensor": {"pulses": 9, "photons_per_pulse": {"mean": 1}, "zones": {"nx": 2, "ny": 1}}},
         "sensor.zones", "points that a camera sees have none"),
        (pixels(footprint={"radius": 0.1}), "capture.footprint", r"got one in metres, .* With a camera: {pixel: true}"),
        (pixels(footprint={"radius": 0.1, "pixel": True}), "capture.footprint", "or with a camera pixel: true"),
        (flat_wall(capture={"footprint": {"pixel": True}}), "capture.footprint.pixel", "around points on a relay wall"),
        (flat_wall(capture={"laser_target": [0, 0, 0]}), "capture.laser_target", "is for scans with a camera"),
    ],
)  # fmt: skip
def test_what_a_camera_scan_cannot_have(config: dict[str, Any], key: str, message: str) -> None:
    """One mistake, at its key, with what to do."""
    with pytest.raises(ConfigError, match=message) as caught:
        configured(config)
    assert [issue.key for issue in caught.value.issues] == [key]
