"""Footprints of sensor points: H is the mean over the area that a point stands for."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.rendering import flat_wall, render
from support.varied_scenes import Stage

from nlosrender.errors import ConfigError

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0.05, 0.7], "normal": [0.2, 0.1, -1]}
FLOOR = {"type": "rectangle", "width": 1, "height": 0.5, "center": [-0.3, -0.7, 0.5], "normal": [0, 1, 0]}
ITEMS = (PLATE, FLOOR | {"up": [0, 0, 1]})
# Cells of 0.06 x 0.05 m: longer than a bin. The sensor is near and to the side, so that the legs differ over a cell.
NX, NY, FINER = 3, 2, 8
EXTENT = {"width": 0.18, "height": 0.1}
DEVICES = {"account_first_and_last_bounces": True, "sensor_position": [0.3, -0.2, 0.2]}
BOX = {"box": [0.06, 0.05]}
N_BINS = 130


def config(
    engine: str, footprint: Any = None, finer: int = 1, scan: str = "single", **render_keys: Any
) -> dict[str, Any]:
    grid = {"nx": NX * finer, "ny": NY * finer, **EXTENT}
    capture = {**DEVICES, "sensor_grid": grid} | ({"footprint": footprint} if footprint else {})
    budget = {"spp": None, "target_error": 0.012} if engine == "virtual_lights" else {"spp": 400_000}
    keys: dict[str, Any] = {"engine": engine, **budget, **render_keys}
    return flat_wall(*ITEMS, scan=scan, lasers=(2, 1), capture=capture, bins=(0.0, 0.04, N_BINS), **keys)


@cache
def cell_means(scan: str, max_bounces: int) -> tuple[NDArray[np.float64], float]:
    """The mean of a grid of 8 x 8 points in every cell, and its stated error."""
    fine = render(config("virtual_lights", finer=FINER, scan=scan, max_bounces=max_bounces))
    total = fine.total
    shape = (*total.shape[:2], NY, FINER, NX, FINER, N_BINS)
    return total.reshape(shape).mean(axis=(3, 5)), fine.error_estimate


@pytest.mark.parametrize(
    ("scan", "max_bounces"), [("single", 3), pytest.param("exhaustive", 3, marks=pytest.mark.slow), ("single", 4)]
)
@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_a_footprint_of_the_cell_is_the_mean_of_a_fine_grid(engine: str, scan: str, max_bounces: int) -> None:
    """Within the stated errors; the point in the middle is off by many times that."""
    expected, error = cell_means(scan, max_bounces)
    found = render(config(engine, BOX, scan=scan, max_bounces=max_bounces))
    point = render(config("virtual_lights", scan=scan, max_bounces=max_bounces))
    off, off_point = (np.linalg.norm(each.total - expected) / np.linalg.norm(expected) for each in (found, point))
    # 2: the error of one draw may be more than the standard error; 0.003: midpoints of 8 x 6 mm in bins of 40 mm
    limit = 2 * np.hypot(error, found.error_estimate) + 0.003
    assert off < limit
    assert off_point > 1.5 * limit


def energies(*footprints: Any) -> list[float]:
    """Energies by paths that begin with the same numbers, so that the same light is seen from nearby places."""
    return [float(render(config("path", footprint)).total.sum()) for footprint in footprints]


def test_light_of_a_footprint_tends_to_the_points_at_second_order() -> None:
    """The energy differs from the point's by an amount that falls to a quarter when the radius is halved."""
    point, small, large = energies(None, {"radius": 0.04}, {"radius": 0.08})
    assert 1e-4 < abs(small - point) / point < 1e-2
    # what is linear in the place averages out: 2.4e6 paths leave 1e-3 of it, a hundredth of the difference
    assert (large - point) / (small - point) == pytest.approx(4, rel=0.1)


def test_a_disc_is_not_its_square() -> None:
    """Of a disc the mean squared distance from the middle is R^2 / 2, of the square around it 2 R^2 / 3: so are the
    differences from the point."""
    point, disc, square = energies(None, {"radius": 0.08}, {"box": [0.16, 0.16]})
    assert (square - point) / (disc - point) == pytest.approx(4 / 3, rel=0.05)


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_how_footprints_are_cut_into_batches_changes_no_bit(engine: str) -> None:
    """Places in a footprint depend on the sensor point, not on the batch that it is in."""
    described = config(engine, {"radius": 0.01}, max_bounces=4, **({"spp": 64} if engine == "path" else {}))
    whole, cut = render(described), render(described, batch_bytes=250_000)
    assert len(cut.plan.batches) > len(whole.plan.batches)
    assert np.array_equal(whole.mean, cut.mean)
    assert np.array_equal(whole.variance, cut.variance)


def test_the_laser_of_a_confocal_scan_stays_a_point() -> None:
    """A confocal pair with a footprint is a single capture with the same laser point and footprint."""
    grid = {"nx": 1, "ny": 1, "width": 0.1, "height": 0.1}
    capture = {**DEVICES, "footprint": {"radius": 0.03}, "sensor_grid": grid}
    budget: dict[str, Any] = {"engine": "auto", "spp": None, "target_error": 0.05}
    pair, single = (
        render(flat_wall(*ITEMS, scan=scan, capture=capture | laser, bins=(0.0, 0.04, N_BINS), **budget))
        for scan, laser in (("confocal", {}), ("single", {"laser_point": [0, 0]}))
    )
    off = np.linalg.norm(pair.total - single.total) / np.linalg.norm(single.total)
    assert 0 < off < 2 * np.hypot(pair.error_estimate, single.error_estimate)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"footprint": {"box": [0.1, 1.56]}},
            r"footprint: got a height of 1\.56 m, which leaves the wall: .*at most 1\.55 m",
        ),
        ({"footprint": {"radius": 0.93}}, r"footprint: got a height of 1\.86 m, which leaves"),
        ({"footprint": {}}, r"footprint: need one of radius and box"),
        ({"footprint": {"radius": 1, "box": [1, 1]}}, r"footprint: need one of radius and box"),
        ({"footprint": {"box": [1, 0]}}, r"footprint\.box: got \[1, 0\], need 2 numbers > 0"),
    ],
)
def test_footprints_that_leave_the_wall_are_refused(changes: dict[str, Any], message: str) -> None:
    """A footprint is whole and on the wall: the mean over a part of it would be another detector's."""
    described = flat_wall(capture={"sensor_grid": {"nx": 3, "ny": 2, **EXTENT}, **changes})
    with pytest.raises(ConfigError, match=message):
        render(described)


def test_light_of_mirrors_has_no_footprint() -> None:
    """Mirrored laser points are points of light: with a footprint they are refused, not taken for its middle's."""
    mirror = PLATE | {"bsdf": {"type": "conductor"}}
    described = flat_wall(mirror, capture={"footprint": {"radius": 0.01}})
    with pytest.raises(ConfigError, match=r"footprint: the scene has mirrors.*roughconductor"):
        render(described)


def test_paths_render_footprints_that_hidden_geometry_touches() -> None:
    """Also where virtual lights are asked for: a few places of a footprint miss what its other places see close up."""
    touching = {"type": "rectangle", "width": 0.2, "height": 0.2, "center": [0.0, 0.0, 0.1], "normal": [1, 0, 0]}
    for item, engine in ((touching, "path"), (PLATE, "virtual_lights")):
        capture = {"sensor_grid": {"nx": NX, "ny": NY, **EXTENT}, "footprint": BOX}
        assert (
            Stage.of(flat_wall(item, capture=capture, engine="virtual_lights", spp=None), Path()).engine.name == engine
        )
