"""Pilot points: a few sensor and laser points, spread over the grids, that calibrate settings for a whole capture.

They do not depend on how the capture is cut into batches or shards, and neither do the settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.sequences import recurrence_steps

SENSORS_PER_AXIS = 16  # 256 points: calibrated sample counts scatter by 0.4 to 1.7 % between seeds (bench scenes)
LASERS_PER_AXIS = 3  # corners, edges and centre of the laser grid


@dataclass(frozen=True)
class Selection:
    """Some points of a grid; a ``Tile`` that need not be a rectangle."""

    indices: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.indices)

    def flat_indices(self, nx: int) -> list[int]:
        """Return the points' indices in the row-major grid they were taken from."""
        return list(self.indices)


@dataclass(frozen=True)
class Pilot:
    """A batch of selected points: every one of ``lasers`` for every one of ``sensors``, or confocal."""

    sensors: Selection
    lasers: Selection

    def every(self, stride: int) -> Pilot:
        """Return the pilot of every ``stride``-th sensor point, confocal or with the same lasers."""
        sensors = Selection(self.sensors.indices[::stride])
        return Pilot(sensors, sensors if self.lasers is self.sensors else self.lasers)


def pilot_of(
    capture: Capture,
    sensors_per_axis: int = SENSORS_PER_AXIS,
    choose: Callable[[PointGrid, int], Selection] | None = None,
) -> Pilot:
    """Return a grid of at most so many sensor points and, of exhaustive captures, at most 3 x 3 laser points.

    ``choose``: ``spread`` or ``scattered``.
    """
    sensors = (choose or spread)(capture.sensor_grid, sensors_per_axis)
    if capture.scan_type == "confocal":
        return Pilot(sensors, sensors)
    return Pilot(sensors, spread(capture.laser_grid, LASERS_PER_AXIS))


def scattered(grid: PointGrid, per_axis: int) -> Selection:
    """Return one point of each of ``per_axis`` x ``per_axis`` equal cells of a grid, by a low-discrepancy sequence.

    Few points in the middles of cells leave out the border, where a room's sides are near: the error of VPLs in the
    bench's room came out as 3.0 % of 8 x 8 points spread evenly, 3.8 % of scattered ones, 3.7 % of all.
    """
    grid = grid.lattice
    rows, columns = (min(per_axis, n) for n in (1 if grid.is_list else grid.ny, grid.nx))
    if grid.is_list:
        columns = min(per_axis**2, grid.nx)
    number = np.arange(rows * columns, dtype=np.uint64)
    u, v = (number * np.uint64(step) % np.uint64(2**32) / 2.0**32 for step in recurrence_steps(2))
    x = ((number % columns + u) * (grid.nx / columns)).astype(int)
    if grid.is_list:
        return Selection(tuple(np.sort(np.argsort(morton_order(grid.positions[0]), kind="stable")[x]).tolist()))
    y = ((number // columns + v) * (grid.ny / rows)).astype(int)
    return Selection(tuple(np.sort(y * grid.nx + x).tolist()))


def spread(grid: PointGrid, per_axis: int) -> Selection:
    """Return at most ``per_axis`` x ``per_axis`` points spread evenly over a grid or, of a list, over its places."""
    grid = grid.lattice
    if grid.is_list:
        order, count = np.argsort(morton_order(grid.positions[0]), kind="stable"), min(per_axis**2, grid.nx)
        return Selection(tuple(np.sort(order[((np.arange(count) + 0.5) * grid.nx / count).astype(int)]).tolist()))
    rows, columns = (
        np.unique(((np.arange(min(per_axis, n)) + 0.5) * n / min(per_axis, n)).astype(int)) for n in (grid.ny, grid.nx)
    )
    return Selection(tuple(int(y * grid.nx + x) for y in rows for x in columns))
