"""A few sensor and laser points of a capture, spread over its grids, on which settings for all of it are tried.

They are the same however the capture is cut into batches or shards, and so is what they decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlosrender.capture.grids import Capture, PointGrid

SENSORS_PER_AXIS = 16
LASERS_PER_AXIS = 3


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


def pilot_of(capture: Capture, sensors_per_axis: int = SENSORS_PER_AXIS) -> Pilot:
    """Return a grid of at most so many sensor points and, of exhaustive captures, at most 3 x 3 laser points."""
    sensors = spread(capture.sensor_grid, sensors_per_axis)
    if capture.scan_type == "confocal":
        return Pilot(sensors, sensors)
    return Pilot(sensors, spread(capture.laser_grid, LASERS_PER_AXIS))


def spread(grid: PointGrid, most: int) -> Selection:
    """Return at most ``most`` x ``most`` points spread evenly over a grid."""
    rows, columns = (
        np.unique(((np.arange(min(most, n)) + 0.5) * n / min(most, n)).astype(int)) for n in (grid.ny, grid.nx)
    )
    return Selection(tuple(int(y * grid.nx + x) for y in rows for x in columns))
