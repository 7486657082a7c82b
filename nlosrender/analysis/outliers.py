"""Captures of a data set whose numbers are unlike the others'."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

MAX_SCORE = 3.5  # beyond it a number is an outlier (Iglewicz and Hoaglin 1993)
MIN_CAPTURES = 8  # fewer say nothing about what is usual
RULE = (
    f"logarithm more than {MAX_SCORE} robust standard deviations (1.4826 times the median absolute deviation) from the "
    f"median; nothing where the numbers of fewer than {MIN_CAPTURES} captures are known"
)


def outliers(values: Sequence[float | None]) -> Mapping[int, float]:
    """Return the scores of outliers by their index: signed robust standard deviations of the logarithm.

    Where more than half of the values are equal, their mean absolute deviation, times 1.2533, takes the place of the
    median one (Iglewicz and Hoaglin 1993). What is None or not positive has no logarithm and is left out.
    """
    known = {index: float(np.log(value)) for index, value in enumerate(values) if value is not None and value > 0}
    if len(known) < MIN_CAPTURES:
        return {}
    logarithms = np.array(list(known.values()))
    apart = logarithms - np.median(logarithms)
    spread = 1.4826 * float(np.median(np.abs(apart))) or 1.2533 * float(np.abs(apart).mean())
    if spread <= 1e-9:  # equal up to rounding
        return {}
    return {
        index: score for index, score in zip(known, (apart / spread).tolist(), strict=True) if abs(score) > MAX_SCORE
    }
