"""Error against seconds: points, slope, and the time to a given error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

HowKnown = Literal["measured", "interpolated", "extrapolated", "not reached"]


@dataclass(frozen=True)
class Point:
    """What one setting reached."""

    seconds: float  # median over ``repeats``
    cpu_seconds: float  # of all threads, median
    error: float  # relative L2 distance to the reference, median
    repeats: int = 1
    estimate: float | None = None  # the engine's own estimate of the error
    samples: int = 0  # paths per sensor point; 0 for a deterministic engine
    systematic: float | None = None  # part of the error that independent runs share; None when noise hides it
    energy: float = 0.0  # sum of H, in the contender's own unit


@dataclass
class Curve:
    """Points of one contender on one scene, from the cheapest setting up."""

    name: str
    is_random: bool
    points: list[Point] = field(default_factory=list)
    first_seconds: float = 0.0  # the first render of the process, with compilation or loading of cached kernels
    engine: str = ""

    def slope(self, floor: float = 0.0) -> float | None:
        """Return d log(error) / d log(seconds), least squares over the last four points above ``floor``.

        None with fewer than two such points.
        """
        usable = [(point.seconds, point.error) for point in self.points if point.error > floor][-4:]
        return power_law([x for x, _ in usable], [y for _, y in usable])

    @property
    def bias(self) -> float | None:
        """Return the systematic error of the last point that shows one; None when none is known.

        What two runs of the virtual lights share is the error of their resolution, which the next level halves.
        """
        if self.engine == "virtual_lights":
            return None
        return next((point.systematic for point in reversed(self.points) if point.systematic is not None), None)

    def time_to(self, target: float, *, cpu: bool = False) -> tuple[float, HowKnown]:
        """Return the seconds (or CPU seconds) to a relative L2 error of ``target``, and how they are known.

        Interpolated along straight lines of the log-log plot. Beyond the last point, the error of a random contender
        falls as 1 / sqrt(seconds), so the time is extrapolated, unless its bias exceeds the target; for others the
        time is unknown. The time of a first point below the target is an upper bound and counts as measured.
        """
        steps = [(point.cpu_seconds if cpu else point.seconds, point.error) for point in self.points]
        if steps[0][1] <= target:
            return steps[0][0], "measured"
        for (t0, e0), (t1, e1) in pairwise(steps):
            if e1 <= target:
                return t0 * (t1 / t0) ** (math.log(e0 / target) / math.log(e0 / e1)), "interpolated"
        if not self.is_random or (self.bias is not None and self.bias > target):
            return math.inf, "not reached"
        seconds, error = steps[-1]
        return seconds * (error / target) ** 2, "extrapolated"


def power_law(sizes: Sequence[float], values: Sequence[float]) -> float | None:
    """Return the exponent p of the least-squares fit of values ~ sizes^p; None with fewer than two sizes."""
    if len(set(sizes)) < 2 or min(values) <= 0:
        return None
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
