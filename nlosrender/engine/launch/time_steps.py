"""Time steps of a few bins that light above the third bounce is added in or smoothed by, as a pilot allows.

It has been spread by two surfaces at least, while most of the noise of single contributions is from one bin to the
next. docs/virtual-lights.md, 7.7.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from nlosrender.capture.relative_error import relative_l2_error
from nlosrender.engine.launch.histogram import DeviceHistogram

MIN_STEPS = 4  # in the window


class StepKernel:
    """Replaces the bins of a step by those of ``StepSums``: of light that was added bin by bin.

    Parameters
    ----------
    bins_per_step
        Bins in a step. Those of a last, shorter step stay as they are.
    """

    def __init__(self, bins_per_step: int):
        self.bins_per_step = bins_per_step

    def smoothed(self, values: mi.Float64, row: int) -> mi.Float64:
        """Return rows of ``row`` entries, the last for light outside the window; see ``TemporalKernel.smoothed``."""
        bins, steps = self.bins_per_step, (row - 1) // self.bins_per_step
        if bins == 1 or steps < MIN_STEPS:
            return values
        line, step = divided(dr.arange(mi.UInt32, dr.width(values) // row * steps), steps)
        sums = mi.Float64(0)
        for number in range(bins):
            sums += dr.gather(mi.Float64, values, line * row + step * bins + number)
        dr.eval(sums)
        line, entry = divided(dr.arange(mi.UInt32, dr.width(values)), row)
        step, number = divided(entry, bins)
        is_whole, step, x = step < steps, mi.Int32(step), (mi.Float64(number) + 0.5) / bins - 0.5
        neighbours = (mi.UInt32(dr.clip(step + k, 0, steps - 1)) for k in (-1, 0, 1))
        before, here, after = (dr.gather(mi.Float64, sums, line * steps + one, is_whole) for one in neighbours)
        return dr.select(is_whole, bin_of_step(before, here, after, x, bins), values)


def bin_of_step(before: Any, here: Any, after: Any, x: Any, bins: int) -> Any:
    """Return the light of a bin at ``x``, -1/2 to 1/2 of the step: docs/virtual-lights.md, (20b)."""
    slope, curvature = (after - before) / 2, after - 2 * here + before
    # over the step: |x| is at most 1/2, and |x^2 / 2 - 1/24| at most 1/12
    lowest = here - dr.abs(slope) / 2 - dr.abs(curvature) / 12
    bent = slope * x + curvature * (dr.square(x) / 2 + 1 / (24 * bins**2) - 1 / 24)
    return (here + dr.select(lowest >= 0, bent, 0)) / bins


@dataclass(frozen=True)
class TimeSteps:
    """Time steps that light may be added in, and what a pilot says of them."""

    bins: int  # in a step
    error: float  # of the pilot, relative to H
    change: float = 0.0  # that they bring about, relative to H

    @classmethod
    def of_pilot(
        cls,
        pilot: DeviceHistogram,
        lengths: tuple[int, ...],
        done: int,
        known_squares: float,
        lengthened: Callable[[DeviceHistogram, int], DeviceHistogram] | None = None,
    ) -> list[TimeSteps]:
        """Return steps of one bin, and those of so many.

        Products of the halves of the replicas have no noise in the mean.

        Parameters
        ----------
        pilot
            Sums over ``done`` units in steps of one bin.
        lengths
            Bins per step.
        known_squares
            Of what else H holds.
        lengthened
            Returns what the pilot would hold in steps of so many bins; None: what ``StepKernel`` makes of it.
        """
        row = pilot.shape.row
        halves = pilot.halves(done)
        inside = dr.arange(mi.UInt32, dr.width(halves[0])) % row < row - 1

        def squares(one: mi.Float64, other: mi.Float64) -> float:
            return float(dr.sum(dr.select(inside, one * other, 0))[0])

        def error_of(one: mi.Float64, other: mi.Float64) -> float:
            difference, mean = (one - other) / 2, (one + other) / 2
            return relative_l2_error(squares(difference, difference), squares(mean, mean) + known_squares)

        truth = max(squares(*halves), 0.0) + known_squares
        result = [cls(1, error_of(*halves))]
        for bins in (bins for bins in lengths if bins * MIN_STEPS < row):
            if lengthened is None:
                longer = [StepKernel(bins).smoothed(one, row) for one in halves]
            else:
                longer = lengthened(pilot, bins).halves(done)
            dr.eval(longer)
            changes = [after - before for after, before in zip(longer, halves, strict=True)]
            change = math.sqrt(max(squares(*changes), 0.0) / max(truth, 1e-300))
            result.append(cls(bins, error_of(*longer), change))
        return result


def divided(index: mi.UInt32, by: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return quotient and rest."""
    divisor = dr.opaque(mi.UInt32, by)
    quotient = index // divisor
    return quotient, index - quotient * divisor
