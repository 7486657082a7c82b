"""Sums of the light of VPLs in time steps of a few bins, and the bins that they are turned into.

Light above the third bounce has been spread by two surfaces at least: steps of several bins hold all there is to know,
at a part of the cost. docs/virtual-lights.md, 7.7.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape
from nlosrender.engine.launch.time_steps import bin_of_step, divided

PARTS_BITS, BLOCK_BITS = 1, 3
PARTS = 2**PARTS_BITS  # of a step, which delays are rounded to: light moves by at most half of one, by none on average
BLOCK = 2**BLOCK_BITS  # steps that are added at once: 0.50 ns a step; 0.59 at 4
SHARPENING = 1 / (12 * PARTS**2)  # of the second difference: half the variance of two roundings to parts of a step


class StepSums:
    """Sums of a batch by blocks of time steps, float32: of one chunk of VPLs.

    Parameters
    ----------
    fine
        Shape of the histogram that they are added to.
    bins_per_step
        Bins of that in a step; the last step may end behind the window.
    """

    def __init__(self, fine: HistogramShape, bins_per_step: int):
        self.bins_per_step = bins_per_step
        self.shape = shape = replace(fine, n_bins=-(-fine.n_bins // bins_per_step))
        self.blocks = -(-shape.n_bins // BLOCK)
        lines = shape.lanes * shape.rows_per_lane
        self.sums, self.outside = dr.zeros(mi.Float, lines * self.blocks * BLOCK), dr.zeros(mi.Float, lines)
        dr.make_opaque(self.sums, self.outside)

    def add_to(self, histogram: DeviceHistogram) -> None:
        """Add them to ``histogram``."""
        fine, bins = histogram.shape, self.bins_per_step
        dr.eval(self.sums, self.outside)
        if bins > 1:
            self._sharpen()
        lane, place = divided(dr.arange(mi.UInt32, fine.size), fine.entries_per_lane)
        row, entry = divided(place, fine.row)
        owns, is_last, line = row < fine.rows_per_lane, entry == fine.n_bins, lane * fine.rows_per_lane + row
        step, number = divided(entry, bins)
        added = self._bin(line, step, number, owns & ~is_last)
        added += dr.gather(mi.Float, self.outside, line, owns & is_last)
        for late in range(fine.n_bins % bins, bins if fine.n_bins % bins else 0):
            added += self._bin(line, mi.UInt32(fine.n_bins // bins), mi.UInt32(late), owns & is_last)
        histogram.sums += mi.Float64(added)
        dr.eval(histogram.sums)
        dr.sync_thread()

    def energies(self) -> NDArray[np.float64]:
        """Return the sums over the time window (replica, sensor, slot, channel)."""
        dr.eval(self.sums)
        sums, shape = dr.block_sum(self.sums, self.blocks * BLOCK).numpy(), self.shape
        return np.asarray(sums, np.float64).reshape(shape.replicas, shape.sensors, shape.slots, shape.channels)

    def _step(self, line: mi.UInt32, step: mi.Int32, active: mi.Bool) -> mi.Float:
        """Return the light of steps; before the first and after the last as much as in these."""
        step = mi.UInt32(dr.clip(step, 0, self.shape.n_bins - 1))
        return dr.gather(mi.Float, self.sums, line * (self.blocks * BLOCK) + step, active)

    def _sharpen(self) -> None:
        """Take back what roundings have spread: light moves from the lower of two neighbours to the higher one."""
        line, place = divided(dr.arange(mi.UInt32, dr.width(self.sums)), self.blocks * BLOCK)
        step, active = mi.Int32(place), place < self.shape.n_bins
        before, here, after = (self._step(line, step + k, active) for k in (-1, 0, 1))
        # no more than a quarter of what the lower one has: light stays positive
        gained = [dr.clip(SHARPENING * (here - other), -here / 4, other / 4) for other in (before, after)]
        self.sums = dr.select(active, here + gained[0] + gained[1], 0)
        dr.eval(self.sums)

    def _bin(self, line: mi.UInt32, step: mi.UInt32, number: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Return the light of the bin ``number`` of a step: by the parabola with the sums of three, if positive."""
        bins = self.bins_per_step
        here = self._step(line, mi.Int32(step), active)
        if bins == 1:
            return here
        before, after = (self._step(line, mi.Int32(step) + k, active) for k in (-1, 1))
        return bin_of_step(before, here, after, (mi.Float(number) + 0.5) / bins - 0.5, bins)


def in_steps(histogram: DeviceHistogram, bins_per_step: int) -> DeviceHistogram:
    """Return what ``histogram`` would hold if its light had been added in steps of so many bins."""
    shape, rounding, rows = histogram.shape, max(bins_per_step // PARTS, 1), _rows(histogram)
    sums, result = StepSums(shape, bins_per_step), DeviceHistogram(shape)
    box = np.full(rounding, 1 / rounding)
    # two roundings to parts of a step, whose variance in whole bins lacks 1/6; two to parts of a bin have 1/24 of it
    kernel = np.convolve(np.convolve(box, box), [1 / 16, 7 / 8, 1 / 16])
    steps = np.zeros((len(rows), sums.blocks * BLOCK * bins_per_step))
    steps[:, : shape.n_bins] = convolve1d(rows, kernel, axis=-1, mode="nearest")
    steps[:, shape.n_bins : sums.shape.n_bins * bins_per_step] = steps[:, shape.n_bins - 1, None]
    sums.sums = on_device(mi.Float, steps.reshape(len(rows), -1, bins_per_step).sum(axis=-1).ravel())
    sums.add_to(result)
    return result


def _rows(histogram: DeviceHistogram) -> NDArray[np.float64]:
    """Return the sums (lane and row, bin) within the window."""
    shape = histogram.shape
    lanes = np.asarray(histogram.sums.numpy()).reshape(shape.lanes, -1)[:, : shape.rows_per_lane * shape.row]
    return lanes.reshape(-1, shape.row)[:, :-1]
