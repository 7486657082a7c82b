"""The additive recurrences that place the first step of every path."""

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("backend")  # Mitsuba starts before an engine module is imported


def recurrence_steps(dimensions):
    """Return the steps of the engine's sequence."""
    from nlosrender.engine.launch import sequences

    return sequences.recurrence_steps(dimensions)


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_steps_are_powers_of_the_generalised_golden_ratio(dimensions):
    """g^(d+1) = g + 1, and step j is 2^32 / g^j."""
    steps = np.array(recurrence_steps(dimensions)) / 2**32
    ratio = 1 / steps[0]
    assert ratio ** (dimensions + 1) == pytest.approx(ratio + 1, rel=1e-8)
    assert steps == pytest.approx(ratio ** -np.arange(1.0, dimensions + 1), rel=1e-8)  # rounded to 2^-32 and made odd


def test_points_cover_the_square_more_evenly_than_random_ones():
    """1024 points leave no cell of a 16 x 16 grid empty and none crowded; random ones have counts of 4 +- 2."""
    index = np.arange(1024, dtype=np.uint64)
    cells = [((index * step) % 2**32 * 16 // 2**32).astype(int) for step in recurrence_steps(2)]
    counts = np.bincount(cells[0] * 16 + cells[1], minlength=256)
    # random counts are Poisson(4): their variance over 256 cells is 4 +- 0.35, so 1 is 8 sigma below
    assert counts.var() < 1
    assert counts.min() >= 2


def test_the_recurrence_visits_every_integer_before_it_repeats():
    """Odd steps have no factor in common with 2^32."""
    assert all(step % 2 == 1 for step in recurrence_steps(3))


def test_no_dimensions_is_an_error():
    """There is no recurrence without a dimension."""
    with pytest.raises(ValueError, match="dimensions"):
        recurrence_steps(0)
