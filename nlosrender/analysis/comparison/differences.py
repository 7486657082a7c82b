"""Sums over two captures that tell how far apart they are: relative L2, energies, and where they differ most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.blocks import Block
from nlosrender.files.reading.stored_header import StoredHeader

Float64 = NDArray[np.float64]
ALL = slice(None)  # bounces


@dataclass(frozen=True)
class LargestDifference:
    """The one sample in which two captures differ most; positions are (row, column)."""

    laser: tuple[int, int]
    sensor: tuple[int, int]
    bounce: int  # index on the file's bounce axis
    channel: int
    bin: int
    value: float
    reference: float


@dataclass(frozen=True)
class WorstPlaces:
    """The laser and the sensor point (row, column), the bounce index and the bin with most squared difference."""

    laser: tuple[int, int]
    sensor: tuple[int, int]
    bounce: int
    bin: int


class Differences:
    """Sums over the blocks of two captures of the same structure, a (the new one) and b (the reference)."""

    def __init__(self, header: StoredHeader):
        n_bounces = header.sizes["bounce"]
        lasers = (1, 1) if header.confocal else header.laser_grid
        self.energy_a, self.energy_b = np.zeros(n_bounces), np.zeros(n_bounces)  # sums of H [J m^-2 sr^-1]
        self.squares_b, self.squares_bounce = np.zeros(n_bounces), np.zeros(n_bounces)  # of b^2 and (a - b)^2
        # of (a - b)^2 over all other axes
        self.squares_laser, self.squares_sensor = np.zeros(lasers), np.zeros(header.sensor_grid)
        self.squares_bin = np.zeros(header.n_bins)
        self.largest: LargestDifference | None = None  # None while there is no difference

    def add(self, block: Block) -> None:
        """Take one block into the sums."""
        at = list(block.bounces)
        energy = block.b.sum(axis=(0, 2, 3, 4), dtype=np.float64)
        self.energy_b[at] += energy
        self.squares_b[at] += np.einsum("cbyxt,cbyxt->b", block.b, block.b, dtype=np.float64)
        if np.array_equal(block.a, block.b):  # the rule in a regression check, and three times quicker
            self.energy_a[at] += energy
            return
        self.energy_a[at] += block.a.sum(axis=(0, 2, 3, 4), dtype=np.float64)
        difference = np.subtract(block.a, block.b, dtype=np.float64)
        self._note_largest(block, difference)
        squares = np.square(difference, out=difference)
        self.squares_bounce[at] += squares.sum(axis=(0, 2, 3, 4))
        self.squares_sensor[block.rows, block.columns] += squares.sum(axis=(0, 1, 4))
        self.squares_laser[block.laser] += squares.sum()
        self.squares_bin += squares.sum(axis=(0, 1, 2, 3))

    def relative_l2(self, bounce: int | slice = ALL) -> float:
        """Return the relative L2 norm of a - b over everything, or in one bounce index."""
        return ratio(math.sqrt(self.squares_bounce[bounce].sum()), math.sqrt(self.squares_b[bounce].sum()))

    def relative_energy(self, bounce: int | slice = ALL) -> float:
        """Return (energy of a - energy of b) / energy of b over everything, or in one bounce index; signed."""
        a, b = float(self.energy_a[bounce].sum()), float(self.energy_b[bounce].sum())
        return ratio(a - b, b)

    @property
    def lit_bounces(self) -> tuple[int, ...]:
        """Bounce indices that hold anything in either capture."""
        return tuple(int(bounce) for bounce in np.flatnonzero((self.squares_b > 0) | (self.squares_bounce > 0)))

    @property
    def worst(self) -> WorstPlaces | None:
        """Where most of the squared difference is; None where there is none."""
        if self.largest is None:
            return None
        laser, sensor = index_of_max(self.squares_laser), index_of_max(self.squares_sensor)
        (bounce,), (time_bin,) = index_of_max(self.squares_bounce), index_of_max(self.squares_bin)
        return WorstPlaces((laser[0], laser[1]), (sensor[0], sensor[1]), bounce, time_bin)

    def _note_largest(self, block: Block, difference: Float64) -> None:
        where = channel, slot, row, column, time_bin = index_of_max(np.abs(difference))
        value, reference = float(block.a[where]), float(block.b[where])
        if self.largest and abs(value - reference) <= abs(self.largest.value - self.largest.reference):
            return
        sensor = (block.rows.start + row, block.columns.start + column)
        place = (block.laser, sensor, block.bounces[slot])
        self.largest = LargestDifference(*place, channel, time_bin, value, reference)


def ratio(numerator: float, denominator: float) -> float:
    """Return a quotient in which nothing compared with nothing is 0, and something with nothing infinite."""
    if numerator == 0:
        return 0.0
    return numerator / denominator if denominator != 0 else math.copysign(math.inf, numerator)


def index_of_max(values: Float64) -> tuple[int, ...]:
    """Return the index of the largest value."""
    return tuple(int(index) for index in np.unravel_index(np.argmax(values), values.shape))
