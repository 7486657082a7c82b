"""Continuation period n: Russian roulette after bounce 3 lets one path in n continue, with weight n.

The third bounce has most of the variance, the higher ones most of the cost. With period n the variance is A + n B and
the time a + b / n; their product is least at n = sqrt(A b / (B a)) (efficiency-optimised roulette, Veach 1997, section
10.4). A and B are measured by a pilot; b / a is a property of the loop (``LoopCost``). Which path of n it is, the
phase, is random per tile of sensor points, so the estimate is unbiased and the lanes of a packet continue together.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.sequences import GOLDEN
from nlosrender.engine.path.tuning import PHASE_TILE, LoopCost


def best_continuation_period(variance: Callable[[int], float], cost: LoopCost, split: bool) -> int:
    """Return the continuation period n.

    Parameters
    ----------
    variance
        Of a pilot as a function of n, from the same random numbers for every n.
    cost
        Cost of the higher bounces, and bounds on n.
    split
        Whether bounces are kept apart.
    """
    max_period = cost.max_period_split if split else cost.max_period
    if max_period == 1:
        return 1
    at_one, at_max = variance(1), variance(cost.max_period)
    further = (at_max - at_one) / (cost.max_period - 1)
    third = max(at_one - further, 0.0)
    if further <= 0:  # below the pilot's noise, or there is no light at all
        return max_period if at_one > 0 else 1
    return min(max(round(math.sqrt(third * cost.relative / further)), 1), max_period)


def first_phases(seed: int, points: NDArray[np.integer], nx: int, lanes: int, period: mi.UInt32) -> mi.UInt32:
    """Return for every lane the phase: which of its first ``period`` paths continues, counted from 0.

    Parameters
    ----------
    seed
        Of the render.
    points, nx
        (n,) flat indices of the sensor points of the lanes, in their order, and the columns of their grid.
    lanes
        Number of lanes: every replica has one per point.
    period
        n of the roulette.
    """
    tile = points // nx // PHASE_TILE * -(-nx // PHASE_TILE) + points % nx // PHASE_TILE
    lane = dr.arange(mi.UInt32, lanes)
    own = dr.gather(mi.UInt32, on_device(mi.UInt32, tile), lane % len(points))
    random, _ = mi.sample_tea_32(own, (lane // len(points)) ^ dr.opaque(mi.UInt32, seed * GOLDEN % 2**32), 8)
    phases = random % period
    dr.eval(phases)
    return phases
