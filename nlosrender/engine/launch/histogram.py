"""The time-resolved histogram on the device: one block of rows per lane, float64, and the statistics over replicas.

A lane owns its rows, so a deposit is an unguarded add: no atomics, and the same bits whatever the thread count.
Sums are float64: float32 stops growing when a deposit is below 6e-8 of what is there already. They are added in pairs,
one of the two plus zero: Dr.Jit adds single values lane by lane and looks for lanes that meet in one place, for every
deposit 4.3 ns of CPU time; a pair is one load, addition and store, 1.7 ns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.relative_error import relative_l2_error
from nlosrender.errors import RenderError

PAIR = 2  # sums that are added at once; 4 and 8 take 1.9 and 2.5 ns


@dataclass(frozen=True)
class HistogramShape:
    """Sizes of a batch's histogram; a row is one (sensor, laser, bounce slot, channel) and has ``n_bins`` + 1 entries.

    The entry past the last bin collects what falls outside the time window.
    """

    replicas: int
    sensors: int
    lasers: int  # per sensor: 1 for single and confocal captures
    slots: int  # bounce slots
    channels: int
    n_bins: int

    @property
    def lanes(self) -> int:
        """Number of lanes: every replica of every sensor point."""
        return self.replicas * self.sensors

    @property
    def row(self) -> int:
        """Entries of a row."""
        return self.n_bins + 1

    @property
    def rows_per_lane(self) -> int:
        """Rows a lane owns."""
        return self.lasers * self.slots * self.channels

    @property
    def entries_per_lane(self) -> int:
        """Entries a lane owns: its rows, and whole pairs."""
        return -(-self.rows_per_lane * self.row // PAIR) * PAIR

    @property
    def size(self) -> int:
        """Entries of all lanes."""
        return self.lanes * self.entries_per_lane


class Kernel(Protocol):
    """Spreads light over time; see ``TemporalKernel.smoothed``."""

    def smoothed(self, values: mi.Float64, row: int) -> mi.Float64:
        """Return rows of ``row`` entries, the last of each for light outside the window."""


class DeviceHistogram:
    """Deposits of a batch, summed per lane in float64.

    Parameters
    ----------
    shape
        Its sizes.
    kernel
        Spreads what was summed over time before statistics are taken; None: nothing is spread.
    """

    def __init__(self, shape: HistogramShape, kernel: Kernel | None = None):
        self.shape, self.kernel = shape, kernel
        self.sums = dr.zeros(mi.Float64, shape.size)
        dr.make_opaque(self.sums)

    def deposit(
        self,
        lane: mi.UInt32,
        laser: mi.UInt32,
        slot: mi.UInt32,
        bins: mi.Int32,
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """Add ``value`` to bin ``bins`` (any integer: outside the window it goes to the outside entry) of a row."""
        shape = self.shape
        inside = (bins >= 0) & (bins < shape.n_bins)
        entry = dr.select(inside, mi.UInt32(bins), mi.UInt32(shape.n_bins))
        row = slot if shape.lasers == 1 else laser * shape.slots + slot  # one row: of spots that are lit at once, too
        for channel in range(shape.channels):
            # a Mueller matrix meets unpolarised light: its first column is a Stokes vector
            carried = mi.Float64(value[channel, 0][0] if mi.is_polarized else value[channel])
            index = lane * shape.entries_per_lane + (row * shape.channels + channel) * shape.row + entry
            pair = mi.ArrayXf64([dr.select(index % PAIR == k, carried, 0) for k in range(PAIR)])
            dr.scatter_add(self.sums, pair, index // PAIR, active, dr.ReduceMode.NoConflicts)

    def statistics(
        self, samples_per_lane: int, scale: float = 1.0, slots: range | None = None
    ) -> tuple[mi.Float64, mi.Float64]:
        """Return mean and variance of the mean over replicas times ``scale``, in memory order, flattened.

        The replicas are independent, so their spread estimates the variance whatever correlates within one.

        Parameters
        ----------
        samples_per_lane
            What a replica's sums are divided by.
        scale
            Of the mean.
        slots
            Bounce slots of the result, counted from the histogram's first; slots it does not have are zero.
        """
        count = self.shape.replicas
        replicas = self._replicas(1.0 / samples_per_lane, slots)
        mean = sum(replicas[1:], replicas[0]) / count
        squares = [dr.square(replica - mean) for replica in replicas]
        variance = sum(squares[1:], squares[0]) / ((count - 1) * count)
        return mean * scale, variance * scale**2

    def energies(self) -> NDArray[np.float64]:
        """Return the sums over the time window (replica, sensor, laser, slot, channel)."""
        shape = self.shape
        lanes = np.asarray(self.sums.numpy()).reshape(shape.lanes, -1)[:, : shape.rows_per_lane * shape.row]
        rows = lanes.reshape(-1, shape.row)[:, :-1].sum(axis=-1)
        return rows.reshape(shape.replicas, shape.sensors, shape.lasers, shape.slots, shape.channels)

    def total(self, scale: float = 1.0) -> mi.Float64:
        """Return the sum over replicas times ``scale``, in memory order, flattened."""
        replicas = self._replicas(scale, None)
        return sum(replicas[1:], replicas[0])

    def on_host(self, values: mi.Float64) -> NDArray[np.float64]:
        """Return statistics as an array (channel, slot, laser, sensor, row), a view of them on a CPU."""
        shape = self.shape
        return np.asarray(values.numpy()).reshape(shape.channels, -1, shape.lasers, shape.sensors, shape.row)

    def _replicas(self, scale: float, slots: range | None) -> list[mi.Float64]:
        """Return the sums of every replica times ``scale``, transposed to memory order while they are read."""
        shape = self.shape
        slots = range(shape.slots) if slots is None else slots
        size = shape.size // shape.replicas
        index = dr.arange(mi.UInt32, shape.sensors * shape.rows_per_lane * shape.row // shape.slots * len(slots))
        entry, rest = index % shape.row, index // shape.row
        sensor, rest = rest % shape.sensors, rest // shape.sensors
        laser, rest = rest % shape.lasers, rest // shape.lasers
        slot, channel = mi.Int32(rest % len(slots)) + slots.start, rest // len(slots)
        own = (slot >= 0) & (slot < shape.slots)
        row = (laser * shape.slots + mi.UInt32(slot)) * shape.channels + channel
        start = sensor * shape.entries_per_lane + row * shape.row + entry
        replicas = [dr.gather(mi.Float64, self.sums, start + r * size, own) * scale for r in range(shape.replicas)]
        if self.kernel is not None:
            dr.eval(replicas)
            replicas = [self.kernel.smoothed(replica, shape.row) for replica in replicas]
        return replicas

    def relative_error(self, samples_per_lane: int, known_squares: float = 0.0) -> float:
        """Return the estimated relative L2 error of H inside the time window.

        ``known_squares`` is the sum of squares of the part of H that is known from elsewhere.
        """
        mean, variance = self.statistics(samples_per_lane)
        inside = dr.arange(mi.UInt32, dr.width(mean)) % self.shape.row < self.shape.n_bins
        noise = dr.sum(dr.select(inside, variance, 0))
        energy = dr.sum(dr.select(inside, dr.square(mean), 0))
        return relative_l2_error(float(noise[0]), float(energy[0]) + known_squares)

    def halves(self, samples_per_lane: int) -> list[mi.Float64]:
        """Return the means of the even and of the odd replicas, of which there are as many; see ``statistics``."""
        replicas = self._replicas(2.0 / (samples_per_lane * self.shape.replicas), None)
        halves = [sum(replicas[first + 2 :: 2], replicas[first]) for first in (0, 1)]
        dr.eval(halves)
        return halves


@dataclass(frozen=True, eq=False)
class Histogram:
    """What an engine returns for a batch, in memory order (channel, bounce, laser, sensor, bin).

    ``mean`` is H [J m^-2 sr^-1 per pulse], ``variance`` the variance of that estimate; zero where H is exact.
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    outside: NDArray[np.float64]  # (channel, bounce, laser, sensor): H outside the time window
    samples: int  # per sensor point; 0 for a deterministic engine
    contrasts: NDArray[np.float64]  # (contrast, channel, bounce) of the energy, see ``energy_contrasts``

    @classmethod
    def of_rows(
        cls, mean: NDArray[np.float64], variance: NDArray[np.float64], samples: int, contrasts: NDArray[np.float64]
    ) -> Histogram:
        """Return the histogram of rows whose last entry is what lies outside the time window; no copies."""
        return cls(mean[..., :-1], variance[..., :-1], mean[..., -1], samples, contrasts)

    def refuse_not_finite(self) -> None:
        """Raise ``RenderError`` where a value is NaN or infinite."""
        if not all(np.isfinite(values).all() for values in (self.mean, self.variance, self.outside)):
            raise RenderError("the engine produced a value that is not finite; please report the configuration")
