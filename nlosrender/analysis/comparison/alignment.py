"""Aligns two captures whose grids are flipped or transposed, or whose bins begin at different times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.stored_header import StoredHeader

T = TypeVar("T", np.float32, np.float64)
Grid = NDArray[np.float64]
POSITION_TOLERANCE = 1e-5  # of the largest coordinate: float32 leaves 6e-8, other writers' arithmetic some more
START_TOLERANCE = 1e-3  # bins; float32 leaves 3e-4 of 3 mm at a start of 10 m


@dataclass(frozen=True)
class GridTurn:
    """How a stored grid (rows, columns) lies in the order of the reference: flipped, then transposed."""

    shape: tuple[int, int]  # of the stored grid
    flip_rows: bool = False
    flip_columns: bool = False
    transposed: bool = False

    @property
    def turned_shape(self) -> tuple[int, int]:
        """Rows and columns in the order of the reference."""
        return self.shape[::-1] if self.transposed else self.shape

    def stored(self, rows: slice, columns: slice) -> tuple[slice, slice]:
        """Return which part of the stored grid lies at some rows and columns of the reference."""
        parts = (columns, rows) if self.transposed else (rows, columns)
        flips = (self.flip_rows, self.flip_columns)
        first, second = (
            slice(length - part.stop, length - part.start) if flip else part
            for part, flip, length in zip(parts, flips, self.shape, strict=True)
        )
        return first, second

    def turned(self, stored: NDArray[T], axis: int = 0) -> NDArray[T]:
        """Return a part of the stored grid, its rows on ``axis`` and its columns on the next, as in the reference."""
        flipped = tuple(axis + offset for offset, flip in enumerate((self.flip_rows, self.flip_columns)) if flip)
        stored = np.flip(stored, flipped)
        return stored.swapaxes(axis, axis + 1) if self.transposed else stored


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the points and bins of a capture are in those of a reference.

    Attributes
    ----------
    header
        The reference's, with a time axis that both fit into.
    notes
        What had to be aligned, in sentences.
    """

    sensors: GridTurn  # of the capture
    lasers: GridTurn
    lead: int  # bins of the common time axis before the capture's first
    reference_lead: int
    header: StoredHeader
    notes: tuple[str, ...] = ()


def align(capture: StoredCapture, reference: StoredCapture) -> Alignment:
    """Find out how the points and bins of a capture lie in those of a reference.

    What does not fit is left as it is, for ``structure_differences`` to name.

    Raises
    ------
    FileError
        A file is damaged.
    """
    a, b = capture.header, reference.header
    try:
        points, others = capture.positions, reference.positions
        sensors = _turn(points.sensor_positions, others.sensor_positions)
        lasers = _turn(points.laser_positions, others.laser_positions)
    except FileError:  # samples mean something without positions too: other writers leave them out
        sensors, lasers = GridTurn(a.sensor_grid), GridTurn(a.laser_grid)
    turns = {"sensor": sensors} | ({} if a.confocal else {"laser": lasers})
    notes = [
        f"{name} points are in another order than the reference's"
        for name, turn in turns.items()
        if turn != GridTurn(turn.shape)
    ]
    lead, reference_lead = _leads(a, b)
    if lead or reference_lead:
        n_bins = max(lead + a.n_bins, reference_lead + b.n_bins)
        start = b.start_opl - reference_lead * b.bin_width_opl
        notes.append(
            f"bins begin at {a.start_opl:.6g} m, the reference's at {b.start_opl:.6g} m: bin 0 below is at "
            f"{start:.6g} m, and bins that one of them lacks count as dark there"
        )
        b = replace(b, sizes={**b.sizes, "bin": n_bins}, start_opl=start)
    return Alignment(sensors, lasers, lead, reference_lead, b, tuple(notes))


def apart(a: Grid, b: Grid) -> bool:
    """Return whether two arrays of positions [m] differ, in shape or by more than rounding."""
    if a.shape != b.shape:
        return True
    largest = max(float(np.abs(b).max()), np.finfo(np.float64).tiny)
    return not bool((np.abs(a - b) <= POSITION_TOLERANCE * largest).all())  # a NaN is apart from everything


def _turn(points: Grid, reference: Grid) -> GridTurn:
    """Return how to turn a grid (rows, columns, 3) onto another; as it is where nothing makes them equal."""
    shape = points.shape[:2]
    for transposed, rows, columns in product((False, True), repeat=3):
        turn = GridTurn(shape, rows, columns, transposed)
        if not apart(turn.turned(points), reference):
            return turn
    return GridTurn(shape)


def _leads(a: StoredHeader, b: StoredHeader) -> tuple[int, int]:
    """Return the bins before each capture's first on a common time axis; zeros where there is none."""
    offset = (a.start_opl - b.start_opl) / b.bin_width_opl
    if not np.isfinite(offset):
        return 0, 0
    whole = round(offset)
    overlap = whole < b.n_bins and -whole < a.n_bins
    if abs(offset - whole) > START_TOLERANCE or not overlap:
        return 0, 0
    return max(whole, 0), max(-whole, 0)
