"""Kernel density estimation in time (Jarabo et al. 2014, *A framework for transient rendering*, section 5).

A histogram adds each path to its bin: no bias beyond the bin width, and much noise where few paths arrive. A kernel
spreads each path over neighbouring bins: less noise, and a bias that grows with the kernel's width. It is applied to
the sums of each replica instead of to each path. That is linear, so the estimate is the same up to the position of a
path within its bin, and the spread of replicas still estimates the variance.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class TemporalKernel:
    """Epanechnikov's kernel over bins.

    Parameters
    ----------
    width
        Its full width [bins], > 0.
    """

    def __init__(self, width: float):
        self.width = width
        self.reach = math.floor(width / 2) + 1  # bins to either side that light may be moved by
        self.shares = kernel_shares(width, self.reach)

    @dr.syntax
    def smoothed(self, values: mi.Float64, row: int) -> mi.Float64:
        """Return histograms convolved with the kernel.

        Parameters
        ----------
        values
            Rows of ``row`` entries, the last of each for light outside the window. Light that the kernel moves over the
            ends of the window is added to that entry; light that it would move into the window is unknown.
        row
            Entries of a row, >= 2.
        """
        n_bins, reach = row - 1, self.reach
        shares = mi.Float64(self.shares)
        index = dr.arange(mi.UInt32, dr.width(values))
        entry = mi.Int32(index % row)
        start = mi.Int32(index) - entry
        inside = entry < n_bins
        result = dr.select(inside, 0, values)

        # ---- State ---------------------------------------------------------------------------------------------------
        step = mi.Int32(-reach)  # bins that light is moved by
        while dr.hint(step <= reach, exclude=[values, shares, entry, start, inside]):
            source = entry - step
            share = dr.gather(mi.Float64, shares, step + reach)
            arrives = inside & (source >= 0) & (source < n_bins)
            result += dr.select(arrives, share * dr.gather(mi.Float64, values, start + source, arrives), 0)
            # the outside entry gathers the bins that this step moves over an end of the window
            first = dr.select(step > 0, n_bins - step, 0)
            last = dr.select(step > 0, n_bins, -step)
            first, last = dr.maximum(first, 0), dr.minimum(last, n_bins)
            source = mi.Int32(first)
            leaves = ~inside & (source < last)
            while dr.hint(leaves, exclude=[values, start, last, share, inside, step]):
                result += share * dr.gather(mi.Float64, values, start + source, leaves)
                source += 1
                leaves = ~inside & (source < last)
            step += 1
        return result


def kernel_shares(width: float, reach: int) -> NDArray[np.float64]:
    """Return the shares (2 reach + 1,) of a bin's light that go to the bins -reach to reach away; their sum is 1.

    The light of a bin counts as spread evenly over it: the share is the second difference of the twice integrated
    kernel.
    """
    half = width / 2
    t = np.clip(np.arange(-reach - 1, reach + 2) / half, -1, None)
    inside = np.minimum(t, 1)
    twice = half * (inside / 2 + 3 * inside**2 / 8 - inside**4 / 16 + 3 / 16 + np.maximum(t - 1, 0))
    return np.diff(twice, 2)
