"""The order of work: units of sensor and laser points, in batches that fit the memory at hand.

A unit is rendered, written and noted as finished at once. What a lane computes depends on its sensor point alone, so
how a capture is cut changes no bit of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.capture.grids import Capture
from nlosrender.capture.part import WHOLE, Part, Selection, Tiling
from nlosrender.capture.tile import Tile, joined, runs
from nlosrender.errors import ConfigError, Problem

BYTES_PER_SUM = 8  # a float64 sum per replica and bin
MOST_SUMS = 2**32 - 1  # of a batch: Dr.Jit indexes with 32 bits
# mean and variance on the device and their host copies in memory and file order (56), and the float32 copies of the
# unit before, which is being written (8)
BYTES_OF_STATISTICS = 64
BYTES_OF_ASSEMBLY = 24  # mean and variance of a unit that is put together from batches, and its float32 copies
MAX_ITEM_SAMPLES = 2**26  # of a unit at most, whatever the memory: what an interruption can cost stays bounded


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
    """How a capture, or a part of it, is cut into units."""

    work_items: tuple[WorkItem, ...]
    replicas: int  # independent copies of every sensor point's estimate, >= 2
    bytes_per_batch: int  # of the largest batch
    tiling: Tiling
    part: Part

    @property
    def batches(self) -> tuple[Batch, ...]:
        """The batches of all units."""
        return tuple(batch for unit in self.work_items for batch in unit.batches)


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
    """Cut a capture into units.

    Parameters
    ----------
    capture
        What is measured.
    rows_per_pair
        Histogram rows per (sensor, laser): bounce slots times channels.
    n_bins
        Bins per row.
    lanes
        Number of lanes that keeps the backend busy; small grids get more replicas per sensor point.
    memory_limit
        Bytes a batch may take.
    storage_tile
        Rows and columns of sensor points that share a chunk of the file.
    selection
        The part that is rendered.
    max_item_samples
        Samples of a unit at most.
    min_items
        Cut into so many units; but a unit is at least a storage tile with one laser.

    Raises
    ------
    ConfigError
        There is no such part, or not even one sensor point with one laser fits.
    """
    replicas = replicas_for(lanes, capture.n_sensors)
    row = rows_per_pair * (n_bins + 1)
    pair = row * (BYTES_PER_SUM * replicas + BYTES_OF_STATISTICS)
    tiling = Tiling(capture.sensor_grid.ny, capture.sensor_grid.nx, *storage_tile)
    part = selection.part(capture.n_lasers if capture.scan_type == "exhaustive" else 1, tiling)
    cell = storage_tile[0] * storage_tile[1]
    pairs = min(memory_limit // pair, MOST_SUMS // (replicas * row))
    if pairs < cell:  # units of several batches
        pairs = min(pairs, (memory_limit - cell * row * BYTES_OF_ASSEMBLY) // pair)
    if pairs < 1:
        needed = pair + (cell * row * BYTES_OF_ASSEMBLY if cell > 1 else 0)
        one = "one pixel" if capture.scan_type == LINE_OF_SIGHT else "one sensor point with one laser"
        message = (
            f"{one} needs {needed / 1e6:.0f} MB but {memory_limit / 1e6:.0f} MB are left for it. Raise it, or use "
            f"fewer bins ({n_bins}) or bounces."
        )
        raise ConfigError(Problem("", "render.memory_limit", message))
    confocal = capture.scan_type == "confocal"
    enough = max_item_samples // row
    everything = tiling.everything(capture.n_lasers if capture.scan_type == "exhaustive" else 1)
    of_part = round(capture.n_sensors * (1 if confocal else capture.n_lasers) * part.share_of(everything))
    if min_items > 1:  # the share is not exact: of one unit it would cut a crumb
        enough = min(enough, of_part // min_items)
    work_items = tuple(_work_items(capture, tiling, part, pairs, max(1, enough), math.ceil(lanes / replicas)))
    largest = max(b.sensors.size * (1 if confocal else b.lasers.size) for unit in work_items for b in unit.batches)
    return Plan(work_items, replicas, largest * pair, tiling, part)


def replicas_for(lanes: int, n_sensors: int) -> int:
    """Return how many independent estimates stand behind each sensor point: enough of them to keep the lanes busy.

    They depend on the capture, not on the batch: the result must not depend on the memory limit.
    """
    replicas = max(2, math.ceil(lanes / n_sensors))
    return replicas + replicas % 2


def _work_items(
    capture: Capture, tiling: Tiling, part: Part, fitting: int, enough: int, busy: int
) -> Iterator[WorkItem]:
    """Yield the units: first sensor points to keep ``busy`` lanes, then lasers, then more sensor points.

    ``fitting`` pairs of a sensor and a laser point fit the memory; more than ``enough`` are not asked for.
    """
    pairs, n_lasers = min(fitting, enough), part.lasers[1] - part.lasers[0]
    for sensors in joined(tiling.cells(part.strips), max(pairs // n_lasers, min(busy, pairs))):
        if capture.scan_type == "confocal":
            yield WorkItem(sensors, sensors, tuple(Batch(tile, tile) for tile in _cut(sensors, fitting)))
            continue
        for lasers in runs(*part.lasers, capture.laser_grid.nx, max(1, pairs // sensors.size)):
            pieces = _cut(sensors, fitting // lasers.size)
            yield WorkItem(sensors, lasers, tuple(Batch(tile, lasers) for tile in pieces))


def _cut(sensors: Tile, most: int) -> Iterator[Tile]:
    """Yield a tile whole, or in pieces of at most ``most`` points where it has more."""
    rows, columns = sensors.shape
    for tile in tiles(rows, columns, most):
        yield Tile(sensors.y0 + tile.y0, sensors.y0 + tile.y1, sensors.x0 + tile.x0, sensors.x0 + tile.x1)


def tiles(ny: int, nx: int, most: int) -> Iterator[Tile]:
    """Cut a grid of ``ny`` x ``nx`` points into tiles of at most ``most`` points: whole rows, or parts of one row."""
    return runs(0, ny * nx, nx, most)


def remaining_items(plan: Plan, confocal: bool, finished: Iterable[tuple[Tile, Tile]]) -> list[WorkItem]:
    """Return what is left to do when the (sensors, lasers) of ``finished`` are done.

    The units of an earlier run may have been cut otherwise, for another memory; a unit that is done in part is taken
    apart into storage tiles and single lasers, which never are.
    """
    done = set(finished)
    left: list[WorkItem] = []
    for unit in plan.work_items:
        if (unit.sensors, unit.lasers) in done:
            continue
        touching = [pair for pair in done if pair[0].overlaps(unit.sensors) and pair[1].overlaps(unit.lasers)]
        if not touching:
            left.append(unit)
            continue
        for small in _apart(plan, unit, confocal):
            if not any(s.contains(small.sensors) and b.contains(small.lasers) for s, b in touching):
                left.append(small)
    return left


def _apart(plan: Plan, unit: WorkItem, confocal: bool) -> Iterator[WorkItem]:
    """Yield a unit's storage tiles with one laser each."""
    most = max(batch.sensors.size for batch in unit.batches)
    for cell in plan.tiling.cells(plan.part.strips):
        if not unit.sensors.contains(cell):
            continue
        y_range, x_range = range(unit.lasers.y0, unit.lasers.y1), range(unit.lasers.x0, unit.lasers.x1)
        for laser in [cell] if confocal else [Tile(y, y + 1, x, x + 1) for y in y_range for x in x_range]:
            pieces = _cut(cell, most)
            yield WorkItem(cell, laser, tuple(Batch(tile, tile if confocal else laser) for tile in pieces))
