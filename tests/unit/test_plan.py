"""Batches cover every pair of laser and sensor point exactly once and fit the memory."""

import itertools

import numpy as np
import pytest

from nlosrender.capture.grids import Capture, point_grid, single_point
from nlosrender.capture.plan import BYTES_OF_STATISTICS, BYTES_PER_SUM, MOST_SUMS, plan_capture, tiles
from nlosrender.errors import RenderError
from nlosrender.scene.pose import Pose
from nlosrender.scene.relay_wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.0)


def capture(scan_type: str) -> Capture:
    sensors = point_grid(WALL, 5, 3)
    lasers = {"single": single_point(WALL, (0, 0)), "confocal": sensors, "exhaustive": point_grid(WALL, 7, 2)}
    position = np.array([0.0, 0, 1])
    return Capture(scan_type, sensors, lasers[scan_type], position, position, True, 1.0, 0.0)


@pytest.mark.parametrize(("ny", "nx", "most"), [(3, 5, 1), (3, 5, 4), (3, 5, 5), (3, 5, 11), (3, 5, 100), (1, 1, 1)])
def test_tiles_cover_a_grid_once(ny, nx, most):
    """No point is left out, none is done twice, no tile is too large."""
    cut = list(tiles(ny, nx, most))
    points = list(itertools.chain.from_iterable(tile.flat_indices(nx) for tile in cut))
    assert sorted(points) == list(range(ny * nx))
    assert all(1 <= tile.size <= most for tile in cut)


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("pairs", [1, 2, 9, 20, 1000])
def test_batches_cover_every_pair_within_memory(scan_type, pairs):
    """Whatever the memory, each pair is in one batch, and no batch takes more than allowed."""
    scanned = capture(scan_type)
    pair_bytes = 6 * 101 * (BYTES_PER_SUM * 2 + BYTES_OF_STATISTICS)
    plan = plan_capture(scanned, rows_per_pair=6, n_bins=100, lanes=8, memory_limit=pairs * pair_bytes)
    assert plan.replicas == 2
    assert plan.bytes_per_batch <= pairs * pair_bytes
    seen = []
    for batch in plan.batches:
        sensors = batch.sensors.flat_indices(5)
        if scan_type == "confocal":
            assert batch.lasers == batch.sensors
            seen += sensors
        else:
            seen += itertools.product(sensors, batch.lasers.flat_indices(scanned.laser_grid.nx))
    everything = range(15) if scan_type == "confocal" else itertools.product(range(15), range(scanned.n_lasers))
    assert sorted(seen) == sorted(everything)


def test_replicas_depend_on_the_capture_not_on_the_memory():
    """Otherwise the memory limit would change the random numbers."""
    replicas = {
        plan_capture(capture("exhaustive"), rows_per_pair=1, n_bins=10, lanes=100, memory_limit=limit).replicas
        for limit in (10_000, 100_000, 10_000_000)
    }
    assert replicas == {8}  # 100 lanes over 15 sensor points, rounded up to an even number


def test_a_pair_that_does_not_fit_is_an_error_that_says_what_to_do():
    """Nothing is allocated for a histogram that cannot fit."""
    with pytest.raises(RenderError, match=r"memory_limit.*Raise it"):
        plan_capture(capture("single"), rows_per_pair=6, n_bins=10**9, lanes=8, memory_limit=10**9)


def test_a_batch_stays_within_32_bit_indices():
    """Dr.Jit indexes with 32 bits: more memory than that does not make larger batches."""
    plan = plan_capture(capture("exhaustive"), rows_per_pair=6, n_bins=10**7, lanes=8, memory_limit=10**15)
    largest = max(batch.sensors.size * batch.lasers.size for batch in plan.batches)
    assert largest * plan.replicas * 6 * (10**7 + 1) <= MOST_SUMS
    assert len(plan.batches) > 1
