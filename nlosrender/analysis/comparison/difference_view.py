"""One laser point of two captures side by side: light on the wall, and the histograms that differ most."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.blocks import blocks
from nlosrender.analysis.comparison.captures import open_aligned
from nlosrender.analysis.comparison.differences import index_of_max
from nlosrender.analysis.laser_view import list_on_wall
from nlosrender.files.reading.stored_header import StoredHeader

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DifferenceView:
    """Sums over channels and bounces, in the order of the reference's points.

    Attributes
    ----------
    header
        The reference's, with a time axis that both fit into.
    wall, reference_wall
        (Ny, Nx) sums over time.
    sensor
        (row, column) of the sensor point with most squared difference.
    histogram, reference_histogram
        (bin,) of that point.
    points
        (points, 2) where the sensor points are on the wall [m], where they are a list.
    """

    header: StoredHeader
    laser: tuple[int, int]
    sensor: tuple[int, int]
    wall: Float64
    reference_wall: Float64
    histogram: Float64
    reference_histogram: Float64
    points: Float64 | None


def difference_view(path: str | Path, reference: str | Path, laser: tuple[int, int]) -> DifferenceView:
    """Read one laser point (row, column) of a capture and of a reference of the same structure.

    Raises
    ------
    FileError
        One of them is missing, damaged or not a capture.
    """
    with open_aligned(path, reference) as pair:
        header = pair.alignment.header
        walls = np.zeros((2, *header.sensor_grid))
        histograms, sensor, most = np.zeros((2, header.n_bins)), (0, 0), -1.0
        for block in blocks(pair.a, pair.b, with_variance=False, only=laser):
            light = np.stack([side.astype(np.float64).sum(axis=(0, 1)) for side in (block.a, block.b)])
            walls[:, block.rows, block.columns] = light.sum(axis=-1)
            squares = np.square(light[0] - light[1]).sum(axis=-1)
            row, column = index_of_max(squares)
            if squares[row, column] > most:
                most, histograms = float(squares[row, column]), light[:, row, column]
                sensor = (block.rows.start + row, block.columns.start + column)
        points = list_on_wall(pair.b.capture)
        return DifferenceView(header, laser, sensor, walls[0], walls[1], histograms[0], histograms[1], points)
