"""A patch's light over the bins it covers: no noise, exact for a delay that is linear over the patch.

Let t0 <= t1 <= t2 be the delays (in bins) at a triangle's corners; with the delay linear in between, the part of its
area with a delay below t is

    (t - t0)^2 / ((t2 - t0)(t1 - t0))          for t0 <= t <= t1
    1 - (t2 - t)^2 / ((t2 - t0)(t2 - t1))      for t1 <= t <= t2

and the share of a bin is the difference of this function at the bin's edges. Cf. Iseringhausen & Hullin 2020; Tsai et
al. 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from nlosrender.engine.virtual_lights.block_histogram import BLOCK, BlockHistogram

NARROWEST = 1e-3  # bins: below it a triangle's delay counts as one number


@dataclass(frozen=True, eq=False)
class _Delays:
    """Delays of a triangle's corners [bins], ascending, and what its share takes."""

    t0: mi.Float
    t1: mi.Float
    t2: mi.Float
    rising: mi.Float
    falling: mi.Float

    @classmethod
    def of(cls, t0: mi.Float, t1: mi.Float, t2: mi.Float) -> _Delays:
        span = dr.maximum(t2 - t0, NARROWEST)
        rising, falling = dr.rcp(span * dr.maximum(t1 - t0, 1e-6)), dr.rcp(span * dr.maximum(t2 - t1, 1e-6))
        return cls(t0, t1, t2, rising, falling)

    def share_below(self, delay: mi.Float | int) -> mi.Float:
        """Return the share of the area with a smaller delay."""
        up = dr.square(dr.maximum(delay - self.t0, 0)) * self.rising
        down = 1 - dr.square(dr.maximum(self.t2 - delay, 0)) * self.falling
        return dr.select(delay < self.t1, up, down)

    def shares(self, below: mi.Float) -> tuple[list[mi.Float], mi.Float]:
        """Return the shares of the bins of a block that begins at 0, and of all up to its end; ``below`` lie before."""
        edges = [below, *(self.share_below(edge) for edge in range(1, BLOCK + 1))]
        return [right - left for left, right in pairwise(edges)], edges[-1]


@dr.syntax
def spread_triangle(
    histogram: BlockHistogram,
    lane: mi.UInt32,
    laser: mi.UInt32,
    delays: mi.Vector3f,
    whole: mi.Int32,
    value: mi.Spectrum,
    active: mi.Bool,
) -> None:
    """Deposit ``value`` over the bins that a triangle covers.

    Parameters
    ----------
    histogram, lane, laser
        Which row.
    delays, whole
        Delays of the corners [bins], and whole bins to add to all of them.
    value, active
        What is deposited, and where anything is.
    """
    a, b, c = delays
    low, high = dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))
    middle = dr.maximum(dr.minimum(a, b), dr.minimum(dr.maximum(a, b), c))
    base = dr.floor(low)
    first = mi.Int32(base) + whole
    last = first + mi.Int32(high - base)
    block = dr.maximum(first, 0) // BLOCK
    # delays are counted from the block's left edge
    shift = mi.Float(first - block * BLOCK) - base
    t0, t1, t2 = low + shift, middle + shift, high + shift
    below = mi.Float(0)  # share of the area with a delay below the block
    early, late = first < 0, last >= histogram.shape.n_bins
    spilled = active & (early | late)
    if dr.hint(spilled, exclude=[histogram, value, lane, laser]):
        triangle = _Delays.of(t0, t1, t2)
        end = mi.Float(histogram.shape.n_bins - block * BLOCK)
        below = dr.select(early, triangle.share_below(mi.Float(0)), 0)
        beyond = dr.select(late, 1 - triangle.share_below(end), 0)
        histogram.deposit_outside(lane, laser, value * (below + beyond), spilled)
    more = active & (last >= 0) & (block < histogram.n_blocks)
    while dr.hint(more, exclude=[histogram, value, lane, laser]):
        shares, below = _Delays.of(t0, t1, t2).shares(below)
        histogram.deposit(lane, laser, block, shares, value, more)
        block += 1
        more = (t2 > BLOCK) & (block < histogram.n_blocks)
        t0 -= BLOCK
        t1 -= BLOCK
        t2 -= BLOCK
