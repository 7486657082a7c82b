"""The test that a sum over time is a steady picture: it passes noise and finds a bias."""

from __future__ import annotations

import numpy as np
import pytest

from nlosrender.bench.paper.steady import SIGNIFICANCE, worst_deviation


@pytest.mark.parametrize("shape", [(1, 16, 24), (3, 35, 20), (4, 5, 7)])
def test_noise_passes_and_bias_does_not(shape: tuple[int, int, int]) -> None:
    """Pictures that differ by their noise alone stay below the limit; one block off by ten deviations does not."""
    generator = np.random.default_rng(3)
    truth = generator.random(shape) + 1
    variance = 0.01 * truth**2
    ours, theirs = (truth + generator.normal(0, np.sqrt(variance)) for _ in range(2))
    worst, limit, count = worst_deviation(ours, variance, theirs, variance)
    blocks = shape[0] * max(shape[1] // 8, 1) * max(shape[2] // 8, 1)
    assert count == blocks
    assert worst <= limit
    ours[0, :8, :8] += 10 * np.sqrt(2 * variance[0, :8, :8].mean() / ours[0, :8, :8].size)
    assert worst_deviation(ours, variance, theirs, variance)[0] > limit


def test_the_limit_grows_with_the_number_of_blocks() -> None:
    """One block: the two-sided normal quantile of the significance."""
    flat = np.ones((1, 8, 8))
    _, limit, count = worst_deviation(flat, flat, flat, flat)
    assert count == 1
    assert limit == pytest.approx(3.2905, abs=1e-3)  # of 1 - SIGNIFICANCE / 2
    assert SIGNIFICANCE == 1e-3
    assert (
        worst_deviation(np.ones((1, 64, 64)), np.ones((1, 64, 64)), np.ones((1, 64, 64)), np.ones((1, 64, 64)))[1]
        > limit
    )


def test_pixels_without_noise_say_nothing() -> None:
    """Dark on both sides."""
    dark = np.zeros((2, 8, 8))
    assert worst_deviation(dark, dark, dark, dark)[::2] == (0.0, 0)
