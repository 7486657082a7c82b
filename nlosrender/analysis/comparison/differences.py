"""Sums over two captures that tell how far apart they are: relative L2, energies, and where they differ most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.blocks import Block, Samples
from nlosrender.files.reading.stored_header import StoredHeader

Float64 = NDArray[np.float64]


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
    """Sums over the blocks of two captures of the same structure, a (the new one) and b (the reference).

    Attributes
    ----------
    energy_a, energy_b
        (bounce,) sums of H [J m^-2 sr^-1].
    squares_b, squares_bounce
        (bounce,) sums of b^2 and of (a - b)^2.
    squares_laser, squares_sensor, squares_bin
        Sums of (a - b)^2 over all but (Ly, Lx), (Ny, Nx), (bin,).
    largest
        The sample with the largest |a - b|; None while there is no difference.
    """

    def __init__(self, header: StoredHeader):
        n_bounces = header.sizes["bounce"]
        lasers = (1, 1) if header.confocal else header.laser_grid
        self.energy_a, self.energy_b = np.zeros(n_bounces), np.zeros(n_bounces)
        self.squares_b, self.squares_bounce = np.zeros(n_bounces), np.zeros(n_bounces)
        self.squares_laser, self.squares_sensor = np.zeros(lasers), np.zeros(header.sensor_grid)
        self.squares_bin = np.zeros(header.n_bins)
        self.largest: LargestDifference | None = None

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

    @property
    def relative_l2(self) -> float:
        """Relative L2 norm of a - b, over everything."""
        return ratio(math.sqrt(self.squares_bounce.sum()), math.sqrt(self.squares_b.sum()))

    def relative_l2_of(self, bounce: int) -> float:
        """Relative L2 norm of a - b in one bounce index."""
        return ratio(math.sqrt(self.squares_bounce[bounce]), math.sqrt(self.squares_b[bounce]))

    def relative_energy_of(self, bounce: int) -> float:
        """Return (energy of a - energy of b) / energy of b of one bounce index; signed."""
        return ratio(float(self.energy_a[bounce] - self.energy_b[bounce]), float(self.energy_b[bounce]))

    @property
    def relative_energy(self) -> float:
        """The same over all bounces."""
        return ratio(float(self.energy_a.sum() - self.energy_b.sum()), float(self.energy_b.sum()))

    @property
    def lit_bounces(self) -> tuple[int, ...]:
        """Bounce indices that hold anything in either capture."""
        return tuple(int(bounce) for bounce in np.flatnonzero((self.squares_b > 0) | (self.squares_bounce > 0)))

    @property
    def worst(self) -> WorstPlaces | None:
        """Where most of the squared difference is; None where there is none."""
        if self.largest is None:
            return None
        return WorstPlaces(
            laser=_index(self.squares_laser),
            sensor=_index(self.squares_sensor),
            bounce=int(np.argmax(self.squares_bounce)),
            bin=int(np.argmax(self.squares_bin)),
        )

    def _note_largest(self, block: Block, difference: Float64) -> None:
        flat = int(np.argmax(np.abs(difference)))
        where = np.unravel_index(flat, difference.shape)
        value, reference = _value(block.a, where), _value(block.b, where)
        if self.largest and abs(value - reference) <= abs(self.largest.value - self.largest.reference):
            return
        channel, slot, row, column, time_bin = (int(index) for index in where)
        sensor = (block.rows.start + row, block.columns.start + column)
        self.largest = LargestDifference(
            block.laser, sensor, block.bounces[slot], channel, time_bin, value, reference
        )  # fmt: skip


def ratio(numerator: float, denominator: float) -> float:
    """Return a quotient in which nothing compared with nothing is 0, and something with nothing infinite."""
    if numerator == 0:
        return 0.0
    return numerator / denominator if denominator != 0 else math.copysign(math.inf, numerator)


def _index(sums: Float64) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return int(row), int(column)


def _value(samples: Samples, where: tuple[np.intp, ...]) -> float:
    return float(samples[where])
