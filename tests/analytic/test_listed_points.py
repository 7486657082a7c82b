"""Captures at listed points against captures at the points of grids."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.rendering import flat_wall, render

from nlosrender.capture.grids import point_grid
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.6)  # that of ``flat_wall``
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0.05, 0.7], "normal": [0.2, 0.1, -1]}
FLOOR = {"type": "rectangle", "width": 1, "height": 0.5, "center": [-0.3, -0.7, 0.5], "normal": [0, 1, 0]}
ITEMS = (PLATE, FLOOR | {"up": [0, 0, 1]})
SENSORS, LASERS = (3, 5), (2, 7)  # columns and rows


def as_lists(config: dict[str, Any]) -> dict[str, Any]:
    capture = {**config["capture"]}
    for name in ("sensor", "laser"):
        if grid := capture.pop(f"{name}_grid", None):
            points = point_grid(WALL, grid["nx"], grid["ny"], grid.get("width"), grid.get("height"))
            capture[f"{name}_points"] = points.wall_coordinates.reshape(-1, 2).tolist()
    return {**config, "capture": capture}


@pytest.mark.parametrize(
    ("engine", "scan"),
    [("path", "exhaustive"), ("virtual_lights", "single"), ("virtual_lights", "confocal")]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in (("path", "single"), ("path", "confocal"), ("virtual_lights", "exhaustive"))
    ],
)
def test_a_grid_given_as_a_list_has_the_bits_of_the_grid(engine: str, scan: str) -> None:
    """H and variance are the same numbers in another shape, calibrated from pilot points of the same places."""
    budget: dict[str, Any] = {"engine": engine, "spp": None, "target_error": 0.2, "max_bounces": 4}
    config = flat_wall(*ITEMS, scan=scan, sensors=SENSORS, lasers=LASERS, bins=(0.0, 0.04, 150), **budget)
    grid, listed = render(config), render(as_lists(config))
    n_lasers = 14 if scan == "exhaustive" else 1
    assert listed.mean.shape == (1, 3, 1, n_lasers, 1, 15, 150)
    assert listed.mean.any()
    for name in ("mean", "variance", "outside"):
        one, other = getattr(grid, name), getattr(listed, name)
        assert np.array_equal(one.reshape(other.shape), other), name


def test_regions_of_the_wall_are_those_of_the_grid() -> None:
    """Close to a surface that touches the wall, patches are cut for parts of the grid: so are they for its list."""
    room = {"type": "room", "size": [2, 1.6, 1.5], "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    budget: dict[str, Any] = {"engine": "virtual_lights", "spp": None, "target_error": 0.2}
    config = flat_wall(room, sensors=(36, 30), bins=(0.0, 0.1, 60), **budget)
    grid, listed = render(config), render(as_lists(config))
    assert np.array_equal(grid.mean.ravel(), listed.mean.ravel())


def test_scattered_points_agree_with_a_grid_within_the_stated_error() -> None:
    """The points of a grid in random order, cut into regions by their places, measure the same light."""
    room = {"type": "room", "size": [2, 1.6, 1.5], "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    budget: dict[str, Any] = {"engine": "virtual_lights", "spp": None, "target_error": 0.05}
    config = flat_wall(room, sensors=(36, 30), bins=(0.0, 0.1, 60), **budget)
    listed = as_lists(config)
    order = np.random.default_rng(2).permutation(36 * 30)
    points = np.array(listed["capture"]["sensor_points"])[order]
    listed["capture"]["sensor_points"] = points.tolist()
    grid, scattered = render(config), render(listed)
    expected = grid.bounce(3).reshape(-1, 60)[order]
    error = np.linalg.norm(scattered.bounce(3).reshape(-1, 60) - expected) / np.linalg.norm(expected)
    assert 0 < error < grid.error_estimate + scattered.error_estimate


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_how_a_list_is_cut_into_batches_changes_no_bit(engine: str) -> None:
    """Scattered points in one batch, and a few at a time."""
    points = np.random.default_rng(3).uniform(-0.7, 0.7, (11, 2)).tolist()
    config = flat_wall(*ITEMS, engine=engine, spp=64, capture={"sensor_points": points})
    config["capture"].pop("sensor_grid")
    whole, cut = render(config), render(config, batch_bytes=100_000)
    assert len(cut.plan.batches) > len(whole.plan.batches)
    assert np.array_equal(whole.mean, cut.mean)
