"""Low-discrepancy numbers for the first step of a path: additive recurrences in integer arithmetic.

Roberts 2018, "The unreasonable effectiveness of quasirandom sequences": x_i = frac(s + i * a), with a built
from the generalised golden ratio. Here x is a 32-bit integer, so the recurrence is exact however long it
runs, and every lane has its own random start s: the estimate stays unbiased and lanes stay independent
(Cranley & Patterson 1976).
"""

from __future__ import annotations


def recurrence_steps(dimensions: int) -> tuple[int, ...]:
    """Return the odd 32-bit integer steps of the additive recurrence in ``dimensions`` dimensions.

    The generalised golden ratio g is the positive root of g^(d+1) = g + 1; step j is 2^32 / g^j.

    Raises
    ------
    ValueError
        ``dimensions`` is below 1.
    """
    if dimensions < 1:
        raise ValueError(f"dimensions: got {dimensions}, need an integer >= 1")
    ratio = 2.0
    for _ in range(64):  # a contraction: 64 steps reach float64 precision
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    # odd: the recurrence then visits all 2^32 integers before it repeats
    return tuple(int(2.0**32 / ratio**j) | 1 for j in range(1, dimensions + 1))
