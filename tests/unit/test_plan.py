"""Batches cover every pair of laser and sensor point exactly once and fit the memory."""

import itertools

import numpy as np
import pytest

from nlosrender.capture.grids import Capture, point_grid, single_point
from nlosrender.capture.part import WHOLE, Selection
from nlosrender.capture.plan import (
    BYTES_OF_ASSEMBLY,
    BYTES_OF_STATISTICS,
    BYTES_PER_SUM,
    MAX_SUMS,
    Plan,
    plan_capture,
    remaining_items,
    replicas_for,
)
from nlosrender.capture.tile import Tile, joined, runs
from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.0)


def capture(scan_type: str) -> Capture:
    sensors = point_grid(WALL, 5, 3)
    lasers = {"single": single_point(WALL, (0, 0)), "confocal": sensors, "exhaustive": point_grid(WALL, 7, 2)}
    position = np.array([0.0, 0, 1])
    return Capture(scan_type, sensors, lasers[scan_type], position, position, True, 1.0, 0.0)


@pytest.mark.parametrize(("ny", "nx", "most"), [(3, 5, 1), (3, 5, 4), (3, 5, 5), (3, 5, 11), (3, 5, 100), (1, 1, 1)])
def test_tiles_cover_a_grid_once(ny, nx, most):
    """No point is left out, none is done twice, no tile is too large."""
    cut = list(runs(0, ny * nx, nx, most))
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


@pytest.mark.parametrize("lanes", [128, 2**17])
@pytest.mark.parametrize("n_sensors", [1, 3, 15, 4096])
def test_a_point_has_no_more_replicas_on_a_gpu_than_one_alone_has_on_a_cpu(lanes, n_sensors):
    """Engines loop over them in Python: a number that grows with the lanes would make kernels without end."""
    replicas = replicas_for(lanes, n_sensors)
    assert replicas % 2 == 0
    assert 2 <= replicas <= replicas_for(128, 1) == 128
    assert replicas * n_sensors >= min(lanes, 128 * n_sensors)


def test_a_pair_that_does_not_fit_is_an_error_that_says_what_to_do():
    """Nothing is allocated for a histogram that cannot fit."""
    with pytest.raises(ConfigError, match=r"memory_limit.*Raise it"):
        plan_capture(capture("single"), rows_per_pair=6, n_bins=10**9, lanes=8, memory_limit=10**9)


def test_a_batch_stays_within_32_bit_indices():
    """Dr.Jit indexes with 32 bits: more memory than that does not make larger batches."""
    plan = plan_capture(capture("exhaustive"), rows_per_pair=6, n_bins=10**7, lanes=8, memory_limit=10**15)
    largest = max(batch.sensors.size * batch.lasers.size for batch in plan.batches)
    assert largest * plan.replicas * 6 * (10**7 + 1) <= MAX_SUMS
    assert len(plan.batches) > 1


# --- work items ---

PAIR = 101 * (BYTES_PER_SUM * 2 + BYTES_OF_STATISTICS)  # bytes of one pair with one row of 100 bins


def planned(scan_type: str, pairs: float, selection: Selection = WHOLE, lanes: int = 8) -> Plan:
    """Plan with storage tiles of 2 x 3 of the 3 x 5 sensors, and memory for so many pairs."""
    memory = int(pairs * PAIR) + 6 * 101 * BYTES_OF_ASSEMBLY
    scanned = capture(scan_type)
    options = {"rows_per_pair": 1, "n_bins": 100, "lanes": lanes, "memory_limit": memory}
    return plan_capture(scanned, **options, storage_tile=(2, 3), selection=selection)


def pairs_of(item) -> set[tuple[int, int]]:
    return set(itertools.product(item.sensors.flat_indices(5), item.lasers.flat_indices(7)))


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("pairs", [1, 2, 5, 6, 14, 40, 90, 1000])
@pytest.mark.parametrize("shard", [None, (1, 3), (2, 3), (3, 3)])
def test_units_are_whole_storage_tiles(scan_type, pairs, shard):
    """Each chunk of the file is filled by one work item, and a work item's batches cover it once, within the memory."""
    plan = planned(scan_type, pairs, Selection(shard=shard))
    cells = list(plan.tiling.cells(plan.part.strips))
    covered = [0] * len(cells)
    for item in plan.work_items:
        inside = [cell for cell in cells if item.sensors.contains(cell)]
        assert sum(cell.size for cell in inside) == item.sensors.size
        for cell in inside:
            covered[cells.index(cell)] += 1 if scan_type == "confocal" else item.lasers.size
        points = [point for batch in item.batches for point in batch.sensors.flat_indices(5)]
        assert sorted(points) == item.sensors.flat_indices(5)
        for batch in item.batches:
            assert batch.lasers == (batch.sensors if scan_type == "confocal" else item.lasers)
            size = batch.sensors.size * (1 if scan_type == "confocal" else batch.lasers.size)
            assert size * PAIR <= plan.bytes_per_batch <= pairs * PAIR + 6 * 101 * BYTES_OF_ASSEMBLY
    assert covered == [plan.part.lasers[1] - plan.part.lasers[0]] * len(cells)


def test_lanes_come_before_lasers():
    """A batch takes sensor points until the lanes are busy, and only then more lasers: 12 lanes are 6 points twice.

    Storage tiles are 2 x 3, 2 x 2, 1 x 3 and 1 x 2: the last two are joined for it, though memory for 28 pairs would
    do for 2 points with all 14 lasers.
    """
    plan = planned("exhaustive", 28, lanes=12)
    assert plan.replicas == 2
    assert {item.sensors.size for item in plan.work_items} == {6, 4, 5}
    assert {item.lasers.size for item in plan.work_items if item.sensors.size == 6} == {4, 3}


@pytest.mark.parametrize("scan_type", ["confocal", "exhaustive"])
@pytest.mark.parametrize("first", [1, 9, 28, 90])
@pytest.mark.parametrize("then", [1, 13, 50])
def test_what_is_left_after_other_units(scan_type, first, then):
    """Whatever the memory was and is, nothing that is finished is done again and nothing is left out."""
    before, now = planned(scan_type, first), planned(scan_type, then)
    everything = set().union(*(pairs_of(item) for item in now.work_items))
    for n_finished in range(0, len(before.work_items) + 1, max(1, len(before.work_items) // 5)):
        finished = before.work_items[:n_finished]
        left = remaining_items(now, scan_type == "confocal", [(item.sensors, item.lasers) for item in finished])
        done = set().union(*(pairs_of(item) for item in finished)) if finished else set()
        todo = [pair for item in left for pair in pairs_of(item)]
        assert len(todo) == len(set(todo))
        assert done.isdisjoint(todo)
        if scan_type == "exhaustive":
            assert done | set(todo) == everything
        else:
            assert sum(item.sensors.size for item in (*finished, *left)) == 15
        for item in left:
            sizes = [batch.sensors.size for batch in item.batches]
            assert sum(sizes) == item.sensors.size


def test_an_unchanged_plan_goes_on_where_it_stopped():
    """With the same memory the work items that are left are those of the plan, in their order."""
    plan = planned("exhaustive", 9)
    finished = [(item.sensors, item.lasers) for item in plan.work_items[:7]]
    assert remaining_items(plan, False, finished) == list(plan.work_items[7:])


@pytest.mark.parametrize(("first", "last", "most"), [(0, 14, 100), (3, 12, 100), (3, 12, 4), (8, 9, 1), (6, 14, 7)])
def test_runs_keep_the_order_of_the_indices(first, last, most):
    """A range of a 2 x 7 grid is cut into rectangles whose points are the range, in order."""
    found = list(runs(first, last, 7, most))
    assert [index for tile in found for index in tile.flat_indices(7)] == list(range(first, last))
    assert all(tile.size <= most for tile in found)


def test_neighbours_are_joined_along_rows_first():
    """2 x 2 cells of 2 x 3 points: in pairs along a row, then all; a cell larger than asked for stays."""
    cells = [Tile(0, 2, 0, 3), Tile(0, 2, 3, 6), Tile(2, 4, 0, 3), Tile(2, 4, 3, 6)]
    assert joined(cells, 1) == cells
    assert joined(cells, 12) == [Tile(0, 2, 0, 6), Tile(2, 4, 0, 6)]
    assert joined(cells, 23) == [Tile(0, 2, 0, 6), Tile(2, 4, 0, 6)]
    assert joined(cells, 24) == [Tile(0, 4, 0, 6)]
    assert joined([cells[1], cells[2]], 99) == [cells[1], cells[2]]  # no rectangle


def test_a_storage_tile_that_does_not_fit_is_an_error_that_says_what_to_do():
    """What is put together from batches has to fit beside them."""
    with pytest.raises(ConfigError, match=r"memory_limit.*Raise it"):
        planned("exhaustive", 0.5)
