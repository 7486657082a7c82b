"""Histogram of the gather: rows of blocks of bins, so that one memory access adds a patch's light to eight bins.

Dr.Jit adds single values lane by lane and looks for lanes that meet in one place, for every bin anew. A block of
neighbouring bins per lane is one aligned load, addition and store, and a patch covers few blocks.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.histogram import HistogramShape

BLOCK = 8  # bins: 64 bytes of float64, a cache line; 4 and 16 were slower


class BlockHistogram:
    """Sums of a batch in float64; a lane owns its rows.

    Parameters
    ----------
    shape
        Sizes, with one bounce slot. A row is a whole number of blocks here; what falls outside the time window is in an
        array of its own.
    order
        (sensors,) the sensor point of each lane of a replica, numbered as in the batch.
    """

    def __init__(self, shape: HistogramShape, order: NDArray[np.int64]):
        self.shape, self.order = shape, order
        self.n_blocks = -(-shape.n_bins // BLOCK)  # of a row
        rows = shape.lanes * shape.lasers * shape.channels
        self.sums = dr.zeros(mi.Float64, rows * self.n_blocks * BLOCK)
        self.outside = dr.zeros(mi.Float64, rows)
        dr.make_opaque(self.sums, self.outside)

    @staticmethod
    def entries(shape: HistogramShape) -> int:
        """Return how many sums a histogram of this shape holds, padding and what lies outside included."""
        rows = shape.lanes * shape.lasers * shape.channels
        return rows * (-(-shape.n_bins // BLOCK) * BLOCK + 1)

    def deposit(
        self,
        lane: mi.UInt32,
        laser: mi.UInt32,
        block: mi.Int32,
        fractions: list[mi.Float],
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """Add ``value`` times the ``fractions`` of its bins to an existing block of a row."""
        for channel in range(self.shape.channels):
            index = self._row(lane, laser, channel) * self.n_blocks + mi.UInt32(block)
            values = mi.ArrayXf64([mi.Float64(value[channel] * fraction) for fraction in fractions])
            dr.scatter_add(self.sums, values, index, active, dr.ReduceMode.NoConflicts)

    def deposit_outside(self, lane: mi.UInt32, laser: mi.UInt32, value: mi.Spectrum, active: mi.Bool) -> None:
        """Add ``value`` to what falls outside the time window."""
        for channel in range(self.shape.channels):
            row = self._row(lane, laser, channel)
            dr.scatter_add(self.outside, mi.Float64(value[channel]), row, active, dr.ReduceMode.NoConflicts)

    def on_host(self, *, is_symmetric: bool = False) -> NDArray[np.float64]:
        """Return the sums over the lanes of a sensor point, (channel, 1, laser, sensor, row).

        Parameters
        ----------
        is_symmetric
            Whether light from laser i to sensor point j is only there for i <= j, and the same from j to i.
        """
        shape = self.shape
        places = np.empty(shape.sensors, np.uint32)
        places[self.order] = np.arange(shape.sensors)
        index = dr.arange(mi.UInt32, shape.channels * shape.lasers * shape.sensors * shape.row)
        entry, rest = index % shape.row, index // shape.row
        sensor, rest = rest % shape.sensors, rest // shape.sensors
        laser, channel = rest % shape.lasers, rest // shape.lasers
        if is_symmetric:
            laser, sensor = dr.minimum(laser, sensor), dr.maximum(laser, sensor)
        inside = entry < shape.n_bins
        lane = dr.gather(mi.UInt32, on_device(mi.UInt32, places), sensor)
        total = mi.Float64(0)
        for _ in range(shape.replicas):
            row = self._row(lane, laser, channel)
            total += dr.gather(mi.Float64, self.sums, row * (self.n_blocks * BLOCK) + entry, inside)
            total += dr.gather(mi.Float64, self.outside, row, ~inside)
            lane += shape.sensors
        return np.asarray(total.numpy()).reshape(shape.channels, 1, shape.lasers, shape.sensors, shape.row)

    def _row(self, lane: mi.UInt32, laser: mi.UInt32, channel: mi.UInt32 | int) -> mi.UInt32:
        if self.shape.lasers == 1:  # of spots that are lit at once, too
            return lane * self.shape.channels + channel
        return (lane * self.shape.lasers + laser) * self.shape.channels + channel
