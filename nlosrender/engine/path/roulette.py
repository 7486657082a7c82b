"""How many paths go on beyond the third bounce: of n paths one does, and carries the light of all n.

What all paths cost and what the further bounces add, in time and in variance, differs: with n the variance is A + n B
and the time a + b / n, and their product is least at n = sqrt(A b / (B a)) (efficiency-optimised roulette, Veach 1997,
section 10.4). A and B are measured by a pilot; b / a is a property of the loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.systematic_sequence import GOLDEN

PILOT_SAMPLES = 64  # per lane
PILOT_SEED = 0x5EED  # of its own: the choice does not depend on the render's seed
LEAST_PATHS = 2**20  # of a capture: fewer are traced faster than tried out
PHASE_TILE = 4  # sensor points along either axis whose paths go on at the same time


@dataclass(frozen=True)
class LoopCost:
    """What going on costs in one of the loops, and of how many paths at most one goes on.

    A pilot does not see what is rare: it must not become much rarer. Where bounces are kept apart, none of them may
    take longer to the same error than if all paths went on.
    """

    relative: float  # b / a, measured on open scenes
    most: int
    most_split: int


DIRECT = LoopCost(2.0, 8, 3)  # ``trace_direct_paths``
TRACED = LoopCost(0.5, 8, 1)  # ``trace_paths``


def best_continuation_period(variance: Callable[[int], float], cost: LoopCost, split: bool) -> int:
    """Return of how many paths one goes on.

    Parameters
    ----------
    variance
        Of a pilot in which one of n paths goes on, given n; from the same random numbers for every n.
    cost
        Of going on.
    split
        Whether bounces are kept apart.
    """
    most = cost.most_split if split else cost.most
    if most == 1:
        return 1
    at_one, at_most = variance(1), variance(cost.most)
    further = (at_most - at_one) / (cost.most - 1)
    third = max(at_one - further, 0.0)
    if further <= 0:  # lost in the pilot's noise, or there is no light at all
        return most if at_one > 0 else 1
    return min(max(round(math.sqrt(third * cost.relative / further)), 1), most)


def first_phases(seed: int, points: NDArray[np.integer], nx: int, lanes: int, every: mi.UInt32) -> mi.UInt32:
    """Return for every lane which of its first ``every`` paths goes on, the first one being 0.

    Parameters
    ----------
    seed
        Of the render.
    points, nx
        (n,) flat indices of the sensor points of the lanes, in their order, and the columns of their grid.
    lanes
        Number of lanes: every replica has one per point.
    every
        Of so many paths one goes on.
    """
    tile = points // nx // PHASE_TILE * -(-nx // PHASE_TILE) + points % nx // PHASE_TILE
    lane = dr.arange(mi.UInt32, lanes)
    own = dr.gather(mi.UInt32, on_device(mi.UInt32, tile), lane % len(points))
    random, _ = mi.sample_tea_32(own, (lane // len(points)) ^ dr.opaque(mi.UInt32, seed * GOLDEN % 2**32), 8)
    phases = random % every
    dr.eval(phases)
    return phases
