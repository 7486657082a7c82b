"""Sums over a capture do not depend on how the work is cut or in which order it is done."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import numpy as np
import pytest

from nlosrender.files.sums import Sums, exact_sum, sums_of


def test_a_sum_is_exact() -> None:
    """Numbers of all sizes and both signs, subnormal ones too, add up without any rounding."""
    random = np.random.default_rng(1)
    values = random.normal(size=5000) * 10.0 ** random.integers(-300, 300, 5000)
    values[:7] = (0.0, -0.0, 5e-324, -5e-324, 1.7e308, 1.7e308, 2.0**-1030)
    total = exact_sum(values)
    assert total == sum(map(Fraction, values.tolist()))
    assert float(exact_sum(values[7:])) == math.fsum(values[7:])
    assert exact_sum([]) == 0
    with pytest.raises(ValueError, match="not finite"):
        exact_sum([1.0, np.inf])


def test_parts_add_up_to_the_whole() -> None:
    """However a block is cut along lasers and sensors, and whatever the layout in memory, the sums are the same."""
    random = np.random.default_rng(2)
    mean = random.lognormal(0, 9, (3, 2, 5, 7, 300))
    variance, outside = mean * random.random(mean.shape), random.random(mean.shape[:-1])
    whole = sums_of(mean, variance, outside, 64, 1.0)
    for cut in (slice(0, 4), slice(4, 7)), (slice(0, 1), slice(1, 2), slice(2, 7)):
        parts = Sums()
        for sensors in reversed(cut):
            for laser in range(5):
                at = (slice(None), slice(None), slice(laser, laser + 1), sensors)
                copy = mean[at].transpose(3, 2, 1, 0, 4).copy().transpose(3, 2, 1, 0, 4)
                parts += sums_of(copy, variance[at], outside[at], 64 + laser, 1 / 16)
        assert parts.squares == whole.squares
        assert (parts.noise, parts.energy, parts.outside) == (whole.noise, whole.energy, whole.outside)
        assert (parts.samples, parts.error_estimate) == (64, whole.error_estimate)
    assert float(whole.squares) == pytest.approx((mean**2).sum())
    assert float(whole.energy[1]) == pytest.approx(mean[:, 1].sum())


def test_sums_are_kept_as_text() -> None:
    """They come back from JSON to the last bit."""
    sums = Sums(Fraction(1, 3 << 70), exact_sum([1e300, 1e-300]), Fraction(5), (Fraction(7), Fraction(0)), 12, 0.25)
    assert Sums.from_json(json.loads(json.dumps(sums.as_json()))) == sums
    for damaged in ({}, {**sums.as_json(), "noise": "1/0"}, {**sums.as_json(), "energy": 3}):
        with pytest.raises(ValueError, match="no sums"):
            Sums.from_json(damaged)
