"""Outliers among the numbers of a data set."""

import numpy as np
import pytest

from nlosrender.analysis.outliers import MAX_SCORE, MIN_CAPTURES, outliers

USUAL = [1.0, 1.1, 0.9, 1.05, 0.95, 1.2, 0.8, 1.02, 0.97]


@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e6])
def test_an_outlier_does_not_depend_on_the_unit(factor):
    """One number a hundred times the others is found, with the same score in any unit; the others are not."""
    found = outliers([factor * value for value in [*USUAL, 100.0]])
    assert list(found) == [len(USUAL)]
    logarithms = np.log([*USUAL, 100.0])
    deviations = np.abs(logarithms - np.median(logarithms))
    # the definition; logarithms of 1e6 have a rounding of 2e-15, divided by a spread of 0.1
    assert found[len(USUAL)] == pytest.approx(deviations[-1] / (1.4826 * np.median(deviations)), rel=1e-12)
    assert outliers([factor * value for value in [*USUAL, 0.01]])[len(USUAL)] < -MAX_SCORE


def test_numbers_without_logarithm_say_nothing():
    """None, zero and negative numbers are neither outliers nor usual; they keep the others' places."""
    assert list(outliers([None, 0.0, -1.0, *USUAL, 100.0])) == [3 + len(USUAL)]
    assert outliers([None] * 50) == {}


def test_few_or_equal_numbers_have_no_outliers():
    """Fewer than MIN_CAPTURES known numbers say nothing about what is usual; equal ones have no spread."""
    few = [*USUAL[: MIN_CAPTURES - 2], 100.0]
    assert outliers(few) == {}
    assert list(outliers([*few, 1.0])) == [len(few) - 1]
    assert outliers([2.0] * 20) == {}


def test_one_number_among_equal_ones_is_found():
    """Where the median deviation is 0, the mean one decides."""
    assert list(outliers([2.0] * 20 + [3.0])) == [20]
