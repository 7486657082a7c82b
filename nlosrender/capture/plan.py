"""The order of work: items of sensor and laser points, in batches that fit the memory at hand.

A work item is rendered, written and recorded as finished at once. What a lane computes depends on its sensor point
alone, so how a capture is cut changes no bit of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from nlosrender.capture.grids import Capture
from nlosrender.capture.part import WHOLE, Part, Selection, Tiling
from nlosrender.capture.tile import Tile, joined, runs
from nlosrender.errors import ConfigError

BYTES_PER_SUM = 8  # a float64 sum per replica and bin
MAX_SUMS = 2**32 - 1  # of a batch: Dr.Jit indexes with 32 bits
# mean and variance on the device and their host copies in memory and file order (56), and the float32 copies of the
# work item before, which is being written (8)
BYTES_OF_STATISTICS = 64
BYTES_OF_ASSEMBLY = 24  # mean and variance of a work item assembled from batches (16), and its float32 copies (8)
# of a sensor point, as many as a CPU gives one point alone: loops over them are unrolled in Python. The lanes of a GPU
# make 8,738 of each of 15 points, which took minutes to write into one kernel
REPLICA_LIMIT = 128
MAX_ITEM_SAMPLES = 2**26  # whatever the memory: 256 MB of float32, so that an interruption costs little


@dataclass(frozen=True)
class Batch:
    """What the engine renders at once: every laser of ``lasers`` for every sensor point of ``sensors``.

    Confocal captures have ``lasers`` equal to ``sensors``, one laser per sensor point.
    """

    sensors: Tile
    lasers: Tile


@dataclass(frozen=True)
class WorkItem:
    """What is written at once: whole storage tiles (as far as the part has them) for ``lasers``.

    It is one batch, unless a single storage tile with a single laser takes more memory than there is.
    """

    sensors: Tile
    lasers: Tile  # confocal: equal to ``sensors``
    batches: tuple[Batch, ...]


@dataclass(frozen=True)
class Plan:
    """How a capture, or a part of it, is cut into work items."""

    work_items: tuple[WorkItem, ...]
    replicas: int  # independent copies of every sensor point's estimate, >= 2
    bytes_per_batch: int  # of the largest batch
    tiling: Tiling
    part: Part

    @property
    def batches(self) -> tuple[Batch, ...]:
        """The batches of all work items."""
        return tuple(batch for item in self.work_items for batch in item.batches)


def plan_capture(
    capture: Capture,
    *,
    rows_per_pair: int,
    n_bins: int,
    lanes: int,
    memory_limit: int,
    storage_tile: tuple[int, int] = (1, 1),
    selection: Selection = WHOLE,
    max_item_samples: int = MAX_ITEM_SAMPLES,
    min_items: int = 1,
) -> Plan:
    """Cut a capture into work items.

    Parameters
    ----------
    capture
        What is measured.
    rows_per_pair, n_bins
        Histogram rows per (sensor, laser), which are bounce slots times channels; bins per row.
    lanes
        Number of lanes that keeps the backend busy; small grids get more replicas per sensor point.
    memory_limit
        Bytes a batch may take.
    storage_tile
        Rows and columns of sensor points that share a chunk of the file.
    selection
        The part that is rendered.
    max_item_samples, min_items
        Bounds on the size and number of work items; but each is at least a storage tile with one laser.

    Raises
    ------
    ConfigError
        There is no such part, or not even one sensor point with one laser fits.
    """
    replicas = replicas_for(lanes, capture.n_sensors)
    row = rows_per_pair * (n_bins + 1)
    pair = row * (BYTES_PER_SUM * replicas + BYTES_OF_STATISTICS)
    tiling = Tiling(capture.sensor_grid.ny, capture.sensor_grid.nx, *storage_tile)
    part = selection.part(capture.lasers_per_sensor, tiling)
    cell = storage_tile[0] * storage_tile[1]
    fitting = min(memory_limit // pair, MAX_SUMS // (replicas * row))
    if fitting < cell:  # work items of several batches
        fitting = min(fitting, (memory_limit - cell * row * BYTES_OF_ASSEMBLY) // pair)
    if fitting < 1:
        needed = pair + (cell * row * BYTES_OF_ASSEMBLY if cell > 1 else 0)
        one = "one pixel" if capture.is_line_of_sight else "one sensor point with one laser"
        message = (
            f"{one} needs {needed / 1e6:.0f} MB but {memory_limit / 1e6:.0f} MB are left for it. Raise it, or use "
            f"fewer bins ({n_bins}) or bounces."
        )
        raise ConfigError.at("render.memory_limit", message)
    wanted = max_item_samples // row
    if min_items > 1:  # only then: the part's share is rounded, and would cut a small rest off a single work item
        share = part.share_of(tiling.everything(capture.lasers_per_sensor))
        wanted = min(wanted, round(capture.n_sensors * capture.lasers_per_sensor * share) // min_items)
    busy = math.ceil(lanes / replicas)
    work_items = tuple(_work_items(capture, tiling, part, fitting, max(1, wanted), busy))
    confocal = capture.scan_type == "confocal"
    largest = max(b.sensors.size * (1 if confocal else b.lasers.size) for item in work_items for b in item.batches)
    return Plan(work_items, replicas, largest * pair, tiling, part)


def replicas_for(lanes: int, n_sensors: int) -> int:
    """Return how many independent estimates stand behind each sensor point: enough of them to keep the lanes busy.

    An even number, at most ``REPLICA_LIMIT``. They depend on the capture, not on the batch: the result must not depend
    on the memory limit.
    """
    replicas = max(2, math.ceil(lanes / n_sensors))
    return min(replicas + replicas % 2, REPLICA_LIMIT)


def remaining_items(plan: Plan, confocal: bool, finished: Iterable[tuple[Tile, Tile]]) -> list[WorkItem]:
    """Return the work that is left when the (sensors, lasers) of ``finished`` are done.

    An earlier run may have cut the capture otherwise, for another memory; a work item that is done in part is taken
    apart into storage tiles with single lasers, which no run cuts.
    """
    done = set(finished)
    left: list[WorkItem] = []
    for item in plan.work_items:
        if (item.sensors, item.lasers) in done:
            continue
        touching = [pair for pair in done if pair[0].overlaps(item.sensors) and pair[1].overlaps(item.lasers)]
        if not touching:
            left.append(item)
            continue
        for small in _smallest_items(plan, item, confocal):
            if not any(s.contains(small.sensors) and b.contains(small.lasers) for s, b in touching):
                left.append(small)
    return left


def _work_items(
    capture: Capture, tiling: Tiling, part: Part, fitting: int, wanted: int, busy: int
) -> Iterator[WorkItem]:
    """Yield the work items: first sensor points to keep ``busy`` lanes, then lasers, then more sensor points.

    ``fitting`` pairs of a sensor and a laser point fit the memory of a batch, ``wanted`` make a work item.
    """
    pairs, n_lasers = min(fitting, wanted), part.lasers[1] - part.lasers[0]
    for sensors in joined(tiling.cells(part.strips), max(pairs // n_lasers, min(busy, pairs))):
        if capture.scan_type == "confocal":
            yield _work_item(sensors, None, fitting)
            continue
        for lasers in runs(*part.lasers, capture.laser_grid.nx, max(1, pairs // sensors.size)):
            yield _work_item(sensors, lasers, fitting // lasers.size)


def _smallest_items(plan: Plan, item: WorkItem, confocal: bool) -> Iterator[WorkItem]:
    """Yield a work item's storage tiles with one laser each."""
    max_points = max(batch.sensors.size for batch in item.batches)
    for cell in plan.tiling.cells(plan.part.strips):
        if item.sensors.contains(cell):
            y_range, x_range = range(item.lasers.y0, item.lasers.y1), range(item.lasers.x0, item.lasers.x1)
            for laser in [None] if confocal else [Tile(y, y + 1, x, x + 1) for y in y_range for x in x_range]:
                yield _work_item(cell, laser, max_points)


def _work_item(sensors: Tile, lasers: Tile | None, max_points: int) -> WorkItem:
    """Return a work item in batches of at most ``max_points`` sensor points; lasers None: confocal."""
    y0, x0, (rows, columns) = sensors.y0, sensors.x0, sensors.shape
    pieces = (
        Tile(y0 + tile.y0, y0 + tile.y1, x0 + tile.x0, x0 + tile.x1)
        for tile in runs(0, rows * columns, columns, max_points)
    )
    return WorkItem(sensors, lasers or sensors, tuple(Batch(piece, lasers or piece) for piece in pieces))
