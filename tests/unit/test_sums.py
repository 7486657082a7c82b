"""Sums over a capture do not depend on how the work is cut or in which order it is done."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import numpy as np
import pytest

from nlosrender.capture.bounces import BounceAxis
from nlosrender.files.capture_results import SummedCapture
from nlosrender.files.sums import Sums, exact_sum, sums_of


def test_a_sum_is_exact() -> None:
    """Numbers of all sizes and both signs, subnormal ones too, add up without any rounding."""
    random = np.random.default_rng(1)
    values = random.normal(size=5000) * 10.0 ** random.integers(-300, 300, 5000)
    values[:7] = (0.0, -0.0, 5e-324, -5e-324, 1.7e308, -1.6e308, 2.0**-1030)
    total = exact_sum(values)
    assert total == sum(map(Fraction, values.tolist()))
    assert float(exact_sum(values[7:])) == math.fsum(values[7:])
    assert exact_sum([]) == 0
    for values in ([1.0, np.inf], [1.0, np.nan], [1.7e308, 1.7e308]):
        with pytest.raises((ValueError, OverflowError)):
            exact_sum(values)


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
    noise, squares = (Fraction(1, 3 << 70), Fraction(0)), (exact_sum([1e300, 1e-300]), Fraction(1))
    contrasts = ((Fraction(-1, 8), Fraction(3)), (Fraction(0), Fraction(2)))
    sums = Sums(noise, squares, Fraction(5), (Fraction(7), Fraction(0)), 12, 0.25, contrasts)
    assert Sums.from_json(json.loads(json.dumps(sums.as_json()))) == sums
    for damaged in (
        {},
        {**sums.as_json(), "noise": ["1/0"]},
        {**sums.as_json(), "noise": "1"},
        {**sums.as_json(), "energy": 3},
    ):
        with pytest.raises(ValueError, match="no sums"):
            Sums.from_json(damaged)


def test_every_bounce_has_its_own_errors() -> None:
    """Errors rest on the bounce's own samples; where it has no light, or light is missing from it on, there is none."""
    mean = np.zeros((1, 4, 1, 2, 5))
    mean[:, 1], mean[:, 2] = 2.0, 1.0
    variance = np.zeros_like(mean)
    variance[:, 1], variance[:, 2] = 0.04, 0.5
    contrasts = np.array([[0.0, 3.0, 4.0, 0.0], [0.0, -3.0, 0.0, 0.0]])
    sums = sums_of(mean, variance, mean[..., 0], 8, 1.0, contrasts)
    bounces = BounceAxis(5, split=True)
    # sqrt(noise / (squares - noise)), ten samples each
    expected = {"2": None, "3": math.sqrt(0.4 / (40 - 0.4)), "4": math.sqrt(5 / (10 - 5)), "5": None}
    for unknown_from, missing in ((None, {}), (4, {"4": None})):
        results = SummedCapture(sums, bounces, unknown_from=unknown_from).results()
        assert results["error_estimate_per_bounce"] == pytest.approx(expected | missing, nan_ok=True)
    assert sums.energy_errors(bounces) == pytest.approx({"2": 0, "3": 3, "4": math.sqrt(8), "5": 0}, rel=1e-3)
    assert sums.energy_error == pytest.approx(math.sqrt((7**2 + 3**2) / 2), rel=1e-3)  # contrasts are added first


def test_sums_without_contrasts_know_no_error_of_the_energy() -> None:
    """Nothing is taken for exact that nobody has looked at."""
    sums = sums_of(np.ones((1, 2, 1, 1, 3)), np.zeros((1, 2, 1, 1, 3)), np.zeros((1, 2, 1, 1)), 8, 1.0)
    assert all(math.isnan(error) for error in (sums.energy_error, *sums.energy_errors(BounceAxis(3, True)).values()))
