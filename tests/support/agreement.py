"""Comparing estimates: t statistics with Šidák's correction, so that many bins can be tested at once.

The variance of a bin comes from R replicas, so (mean - truth) / sqrt(variance) follows Student's t with R - 1 degrees
of freedom, not a normal distribution: with two replicas 12.7 "sigmas" are exceeded once in 20.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]
FALSE_ALARM = 1e-3  # chance that a test of a true law fails, over all its bins


def t_limit(n_tests: int, degrees_of_freedom: int, false_alarm: float = FALSE_ALARM) -> float:
    """Largest |t| that ``n_tests`` independent true statements stay below with probability 1 - ``false_alarm``.

    Šidák 1967: each may fail with 1 - (1 - false_alarm)^(1 / n_tests).
    """
    single = -np.expm1(np.log1p(-false_alarm) / n_tests)
    return float(stats.t.isf(single / 2, degrees_of_freedom))


def worst_t(mean: ArrayLike, variance: ArrayLike, reference: ArrayLike, floor: ArrayLike = 0.0) -> tuple[float, int]:
    """Largest |mean - reference| in standard deviations after taking off ``floor``, and the number of statements.

    Bins in which both are exactly the same, such as empty ones, state nothing and do not count.
    """
    difference = np.abs(np.asarray(mean) - np.asarray(reference))
    stated = (difference > 0) | (np.asarray(variance) > 0)
    excess = np.maximum(difference - np.asarray(floor), 0)[stated]
    deviation = np.sqrt(np.broadcast_to(variance, difference.shape)[stated])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(excess > 0, excess / deviation, 0.0)
    return (float(t.max()), int(stated.sum())) if stated.any() else (0.0, 1)


def grouped(reference: Array, share: float) -> Array:
    """Number the bins of a histogram (bin,): consecutive ones form groups of at least ``share`` of its energy."""
    group, energy, labels = 0, 0.0, np.zeros(len(reference), dtype=np.int64)
    least = share * reference.sum()
    for i, value in enumerate(reference):
        if energy >= least > 0:
            group, energy = group + 1, 0.0
        labels[i] = group
        energy += value
    if energy < least:
        labels[labels == group] = max(group - 1, 0)
    return labels


def assert_agrees(
    mean: Array,
    variance: Array,
    reference: Array,
    *,
    replicas: int,
    reference_variance: Array | float = 0.0,
    floor: float = 0.0,
    share: float = 0.02,
) -> None:
    """Compare histograms (..., bin) per bin, per histogram and in total.

    Bins are independent or, sharing samples that land in one or the other, anticorrelated: the variance of a sum is
    at most the sum of the variances.

    Parameters
    ----------
    replicas
        Independent estimates behind each variance.
    reference_variance
        Of a stochastic reference with at least as many replicas.
    floor
        Error that is not noise (quadrature, float32), relative to the largest bin of each histogram; and of sums of
        bins relative to the sum.
    share
        Neighbouring bins are joined until they hold this share of their histogram: a bin of a few deposits is not
        normally distributed, and may look exact by being empty in all replicas.
    """
    n_bins = mean.shape[-1]
    variance = np.broadcast_to(variance + reference_variance, mean.shape).reshape(-1, n_bins)
    mean, reference = mean.reshape(-1, n_bins), reference.reshape(-1, n_bins)
    statements: list[tuple[float, float, float, float]] = []
    for row in zip(mean, variance, reference, strict=True):
        labels = grouped(row[2], share)
        sums = [np.bincount(labels, weights=values) for values in row]
        statements += zip(*sums, np.full(len(sums[0]), floor * sums[2].max()), strict=True)
        statements.append((*(float(values.sum()) for values in row), floor * float(row[2].sum())))
    statements.append((mean.sum(), variance.sum(), reference.sum(), floor * float(reference.sum())))
    t, n = worst_t(*(np.array(column) for column in zip(*statements, strict=True)))
    limit = t_limit(n, replicas - 1)
    assert t <= limit, f"|t| = {t:.2f} > {limit:.2f} over {n} statements"


def relative_l2(difference: Array, reference: Array) -> float:
    """Relative L2 norm of a difference."""
    return float(np.linalg.norm(difference) / np.linalg.norm(reference))
