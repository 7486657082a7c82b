"""The order of work: batches of sensor and laser points that fit the memory at hand.

What a lane computes depends on its sensor point alone, so how a capture is cut changes no bit of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from nlosrender.capture.grids import Capture
from nlosrender.errors import RenderError

BYTES_PER_SUM = 8  # a float64 sum per replica and bin
MOST_SUMS = 2**32 - 1  # of a batch: Dr.Jit indexes with 32 bits
BYTES_OF_STATISTICS = 56  # mean and variance on the device and their host copies in memory and file order


@dataclass(frozen=True)
class Tile:
    """A rectangle of grid points: rows [y0, y1), columns [x0, x1)."""

    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def size(self) -> int:
        """Number of points."""
        return (self.y1 - self.y0) * (self.x1 - self.x0)

    def flat_indices(self, nx: int) -> list[int]:
        """Return the points' indices in a row-major grid with ``nx`` columns."""
        return [y * nx + x for y in range(self.y0, self.y1) for x in range(self.x0, self.x1)]


@dataclass(frozen=True)
class Batch:
    """One unit of work: every laser of ``lasers`` for every sensor point of ``sensors``.

    Confocal captures have ``lasers`` equal to ``sensors``, one laser per sensor point.
    """

    sensors: Tile
    lasers: Tile


@dataclass(frozen=True)
class Plan:
    """How a capture is cut into batches."""

    batches: tuple[Batch, ...]
    replicas: int  # independent copies of every sensor point's estimate, >= 2
    bytes_per_batch: int  # of the largest batch


def plan_capture(capture: Capture, *, rows_per_pair: int, n_bins: int, lanes: int, memory_limit: int) -> Plan:
    """Cut a capture into batches.

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

    Raises
    ------
    RenderError
        Not even one sensor point with one laser fits.
    """
    # Replicas depend on the capture, not on the batch: the result must not depend on the memory limit.
    replicas = max(2, math.ceil(lanes / capture.n_sensors))
    replicas += replicas % 2
    pair = rows_per_pair * (n_bins + 1) * (BYTES_PER_SUM * replicas + BYTES_OF_STATISTICS)
    pairs = min(memory_limit // pair, MOST_SUMS // (replicas * rows_per_pair * (n_bins + 1)))
    if pairs < 1:
        raise RenderError(
            f"one sensor point with one laser needs {pair / 1e6:.0f} MB but render.memory_limit leaves "
            f"{memory_limit / 1e6:.0f} MB. Raise it, or use fewer bins ({n_bins}) or bounces."
        )
    lasers_per_sensor = capture.n_lasers if capture.scan_type == "exhaustive" else 1
    ny, nx = capture.sensor_grid.ny, capture.sensor_grid.nx
    sensors_at_once = max(1, pairs // lasers_per_sensor)
    lasers_at_once = max(1, min(lasers_per_sensor, pairs // sensors_at_once))
    batches = []
    for sensors in tiles(ny, nx, sensors_at_once):
        if capture.scan_type == "confocal":
            batches.append(Batch(sensors, sensors))
            continue
        batches += [
            Batch(sensors, lasers) for lasers in tiles(capture.laser_grid.ny, capture.laser_grid.nx, lasers_at_once)
        ]
    largest = max(b.sensors.size * (1 if capture.scan_type == "confocal" else b.lasers.size) for b in batches)
    return Plan(tuple(batches), replicas, largest * pair)


def tiles(ny: int, nx: int, most: int) -> Iterator[Tile]:
    """Cut a grid of ``ny`` x ``nx`` points into tiles of at most ``most`` points: whole rows, or parts of one row."""
    if most >= nx:
        rows = min(ny, most // nx)
        for y0 in range(0, ny, rows):
            yield Tile(y0, min(y0 + rows, ny), 0, nx)
        return
    for y in range(ny):
        for x0 in range(0, nx, most):
            yield Tile(y, y + 1, x0, min(x0 + most, nx))
