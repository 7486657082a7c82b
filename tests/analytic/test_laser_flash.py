"""A laser flash: a cone of light onto the wall, against many spots that share one pulse."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.rendering import configured, flat_wall, render

from nlosrender.capture.flash import Flash
from nlosrender.errors import ConfigError

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0.05, 0.7], "normal": [0.2, 0.1, -1]}
FLOOR = {"type": "rectangle", "width": 1, "height": 0.5, "center": [-0.3, -0.7, 0.5], "normal": [0, 1, 0]}
ITEMS = (PLATE, FLOOR | {"up": [0, 0, 1]})
LASER, TARGET = np.array([0.4, 0.3, 0.6]), np.array([0.2, -0.1, 0.0])
LEGS = {"account_first_and_last_bounces": True, "laser_position": LASER.tolist()}
WALL = np.array([2.0, 1.6])  # that of ``flat_wall``


def flash(fov_deg: float | None, **keys: Any) -> dict[str, Any]:
    laser = {"laser_point": TARGET[:2].tolist()} | ({"laser_flash": {"fov_deg": fov_deg}} if fov_deg else {})
    return flat_wall(*ITEMS, sensors=(5, 3), capture=LEGS | laser, bins=(0.0, 0.05, 160), **keys)


def lit_by(fov_deg: float, n: int) -> tuple[NDArray[np.float64], float]:
    """Where n x n directions of a cone, each of equal energy, meet the wall, and the share that does."""
    u, v = ((axis.ravel() + 0.5) / n for axis in np.indices((n, n)))
    cosine, turn = 1 - u * (1 - math.cos(math.radians(fov_deg) / 2)), 2 * math.pi * v
    axis = (TARGET - LASER) / np.linalg.norm(TARGET - LASER)
    across = np.cross(axis, [0, 1, 0]) / np.linalg.norm(np.cross(axis, [0, 1, 0]))
    sine = np.sqrt(1 - cosine**2)
    rays = cosine[:, None] * axis + (sine * np.cos(turn))[:, None] * across
    rays += (sine * np.sin(turn))[:, None] * np.cross(axis, across)
    places = LASER + rays * (-LASER[2] / rays[:, 2])[:, None]
    meets = (rays[:, 2] < 0) & (np.abs(places[:, :2]) <= WALL / 2).all(axis=1)
    return places[meets, :2], float(meets.mean())


@pytest.mark.parametrize(("fov_deg", "max_bounces"), [(30, 3), (100, 5)])
def test_a_flash_is_very_many_spots(fov_deg: float, max_bounces: int) -> None:
    """H is the mean over directions of the cone; those that miss the wall (of 100 degrees a tenth) bring nothing."""
    places, share = lit_by(fov_deg, 16)
    assert (share < 1) == (fov_deg == 100)
    spots = {"laser_spots": places.tolist(), "multiplex": True, "laser_point": None, "laser_energy": share}
    keys: dict[str, Any] = {"max_bounces": max_bounces, "spp": 4096}
    described = flat_wall(*ITEMS, sensors=(5, 3), capture=LEGS | spots, bins=(0.0, 0.05, 160), **keys)
    expected = render(described)
    found = render(flash(fov_deg, **keys | {"spp": 65536}))
    off = np.linalg.norm(found.total - expected.total) / np.linalg.norm(expected.total)
    # 0.01: 16 directions on either axis of the cone for all of them
    assert off < 3 * np.hypot(found.error_estimate, expected.error_estimate) + 0.01
    assert found.total.sum() == pytest.approx(expected.total.sum(), rel=0.02)


def test_a_narrow_flash_tends_to_the_point() -> None:
    """At a tenth of a degree the lit disc is 1 mm wide: H is that of the laser point, but for noise."""
    narrow, point = render(flash(0.1, spp=65536)), render(flash(None, spp=65536))
    off = np.linalg.norm(narrow.total - point.total) / np.linalg.norm(point.total)
    assert 0 < off < 3 * np.hypot(narrow.error_estimate, point.error_estimate)
    wide = render(flash(60, spp=65536))
    assert np.linalg.norm(wide.total - point.total) / np.linalg.norm(point.total) > 0.2


def test_the_reach_of_a_flash_bounds_what_it_lights() -> None:
    """No lit place is farther from the laser point, and the bound is not loose where the cone is on the wall."""
    for fov_deg in (10.0, 30.0, 100.0, 179.0):
        places, share = lit_by(fov_deg, 200)
        farthest = float(np.linalg.norm(places - TARGET[:2], axis=1).max())
        reach = Flash.onto(math.radians(fov_deg), LASER, TARGET, (2.0, 1.6)).reach
        assert farthest <= reach
        assert share < 1 or reach < 1.02 * farthest


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"laser_flash": {"fov_deg": 180}}, r"laser_flash\.fov_deg: got 180, need an angle between 0 and 180"),
        ({"laser_flash": {}}, r"laser_flash\.fov_deg: missing"),
        ({"laser_spots": [[0, 0]], "multiplex": True, "laser_point": None}, r"laser_flash: stands beside laser_spots"),
        ({"laser_spot_radius": 0.1}, r"laser_spot_radius: got 0\.1, need 0 with laser_flash"),
    ],
)
def test_what_a_flash_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    """Each mistake has its key."""
    described = flash(40)
    described["capture"] |= changes
    with pytest.raises(ConfigError, match=message):
        configured(described)
