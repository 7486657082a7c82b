"""The error of a capture as one number."""

from __future__ import annotations

import math


def relative_l2_error(noise: float, energy: float) -> float:
    """Return sqrt(sum of variances / sum of squared truths) from sums over bins of variance and squared estimate.

    E[estimate^2] = truth^2 + variance, so the variances are subtracted; 0 for an empty capture, inf for pure noise.
    """
    if noise <= 0:
        return 0.0
    truth = energy - noise
    return math.sqrt(noise / truth) if truth > 0 else math.inf
