"""Responses and rebinning: light is moved and spread, none is made or lost."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.stats import exponnorm

from nlosrender.errors import ConfigError
from nlosrender.sensor.curve_file import read_curve
from nlosrender.sensor.rebinning import BLOCK_BINS, Rebinning, TimeBins
from nlosrender.sensor.response import FWHM_OF_SIGMA, Response, measured_response, parametric_response

SOURCE = TimeBins(0.3, 0.003, 2 * BLOCK_BINS + 37)
NOTHING = parametric_response(0.0)
RESPONSES = {
    "gaussian": parametric_response(0.0123),
    "tail": parametric_response(0.0123, 0.031, 0.4),
    "exponential": parametric_response(0.0, 0.02, 1.0, "mean"),
    "curve": measured_response([0.0, 1.0, 5.0, 2.0, 1.0, 0.5], 0.007, 0.004),
    "sharp curve": measured_response([0.0, 1.0, 5.0, 2.0, 1.0, 0.5], 0.007, zero_delay="mean"),
}


def light(points: int = 3) -> np.ndarray:
    """Random light in the middle of the source bins, (bins, points)."""
    found = np.zeros((SOURCE.count, points), np.float32)
    found[120:160] = np.random.default_rng(1).random((40, points))
    return found


def moment(bins: TimeBins, values: np.ndarray) -> np.ndarray:
    """The first moment of light in bins [m]."""
    return (bins.start + (np.arange(bins.count) + 0.5) * bins.width) @ values / values.sum(axis=0)


@pytest.mark.parametrize("response", RESPONSES.values(), ids=RESPONSES)
@pytest.mark.parametrize("detector", [SOURCE, TimeBins(0.2, 0.0071, 160), TimeBins(0.2111, 0.0013, 900)])
def test_area_is_kept_and_the_first_moment_moved_by_the_stated_delay(response: Response, detector: TimeBins) -> None:
    """Sums in float32: 1e-6. The middles of other bins know a moment to a small part of their width only."""
    given = light()
    found = Rebinning(SOURCE, detector, response).apply(given)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=0, dtype=float), given.sum(axis=0, dtype=float), rtol=1e-6)
    shift = moment(detector, found.astype(float)) - moment(SOURCE, given.astype(float))
    np.testing.assert_allclose(shift, response.mean_delay, atol=1e-6 if detector is SOURCE else detector.width / 200)


def test_equal_bins_without_response_are_the_identity() -> None:
    """Bit for bit, and one to two is a sum of neighbours."""
    given = light()
    assert np.array_equal(Rebinning(SOURCE, SOURCE, NOTHING).apply(given), given)
    pairs = Rebinning(SOURCE, TimeBins(0.3, 0.006, 146), NOTHING).apply(given)
    np.testing.assert_allclose(pairs, given[:292].reshape(146, 2, 3).sum(axis=1), rtol=1e-6)


def test_pulse_and_jitter_add_in_quadrature() -> None:
    """The half widths of histograms of a moment, in fine bins, to 1e-3."""
    laser, jitter = 0.021, 0.034
    fine = TimeBins(-0.2, 0.0002, 2000)

    def width(response: Response) -> float:
        histogram = Rebinning(TimeBins(0.0, 1e-5, 1), fine, response).apply(np.ones((1, 1), np.float32))[:, 0]
        return Response(histogram.astype(float), fine.width, fine.start, 0.0).fwhm

    first, second = parametric_response(laser / FWHM_OF_SIGMA), parametric_response(jitter / FWHM_OF_SIGMA)
    both = parametric_response(np.hypot(laser, jitter) / FWHM_OF_SIGMA)
    assert width(first) == pytest.approx(laser, rel=1e-3)
    assert width(second) == pytest.approx(jitter, rel=1e-3)
    # one after the other is both at once
    once = Rebinning(fine, fine, first).apply(
        Rebinning(TimeBins(0.0, 1e-5, 1), fine, second).apply(np.ones((1, 1), np.float32))
    )
    assert Response(once[:, 0].astype(float), fine.width, fine.start, 0.0).fwhm == pytest.approx(width(both), rel=1e-3)


def test_the_exponentially_modified_gaussian_is_that_of_scipy() -> None:
    """Bins of a moment against scipy's exponnorm, also where tail and width differ much."""
    for sigma, tail in ((0.01, 0.03), (0.03, 0.004), (0.002, 0.08)):
        response = parametric_response(sigma, tail, 1.0, "mean")
        bins = TimeBins(-0.3, 0.005, 400)
        found = Rebinning(TimeBins(0.0, 1e-7, 1), bins, response).apply(np.ones((1, 1), np.float32))[:, 0]
        expected = np.diff(exponnorm.cdf(bins.edges + tail, tail / sigma, scale=sigma))
        np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())


def test_a_measured_gaussian_is_the_parametric_one() -> None:
    """A curve in fine cells, spread by a pulse, is the Gaussian of both."""
    x = (np.arange(400) - 200) * 0.0005
    curve = measured_response(np.exp(-((x / 0.02) ** 2) / 2), 0.0005, 0.015)
    assert curve.fwhm == pytest.approx(0.025 * FWHM_OF_SIGMA, rel=1e-3)
    assert curve.mean_delay == pytest.approx(0.0, abs=1e-5)


def test_later_light_comes_with_the_next_pulse() -> None:
    """Folded by the period; a gate lets light through only while it is open."""
    given, bins = light(1), TimeBins(0.3, 0.003, 100)
    folded = Rebinning(SOURCE, bins, NOTHING, period=0.3).apply(given)
    expected = np.zeros(100)
    np.add.at(expected, np.arange(SOURCE.count) % 100, given[:, 0].astype(float))
    np.testing.assert_allclose(folded[:, 0], expected, rtol=1e-5, atol=1e-6)
    gate = Rebinning(SOURCE, SOURCE, NOTHING, gate=(0.3 + 130.5 * 0.003, 0.3 + 140 * 0.003))
    open_share = np.zeros(SOURCE.count)
    open_share[130], open_share[131:140] = 0.5, 1.0
    np.testing.assert_allclose(gate.open_share, open_share, atol=1e-9)
    np.testing.assert_allclose(gate.apply(given)[:, 0], given[:, 0] * open_share, rtol=1e-5)


@pytest.mark.parametrize("bad", [[], [0.0, 0.0], [1.0, -1.0], [1.0, np.nan], [np.inf]])
def test_no_response_from_nonsense(bad: list[float]) -> None:
    """Empty, dark, negative and infinite curves."""
    with pytest.raises(ValueError, match="holds"):
        measured_response(bad, 0.001)


def test_curves_from_files(tmp_path: Path) -> None:
    """The same curve from every kind of file, and what is told of those that do not say enough."""
    counts, width = np.array([1.0, 4.0, 2.0, 1.0]), 4.0
    table = np.stack([np.arange(4) * width, counts], axis=1)
    np.savetxt(tmp_path / "named.csv", table, delimiter=",", header="ps,counts", comments="")
    np.savetxt(tmp_path / "tabs.txt", table, delimiter="\t")
    np.save(tmp_path / "table.npy", table)
    np.save(tmp_path / "alone.npy", counts)
    with h5py.File(tmp_path / "curve.hdf5", "w") as file:
        file["counts"], file["timebin_width_ps"] = counts[:, None], width
    for name in ("named.csv", "tabs.txt", "table.npy", "alone.npy", "curve.hdf5"):
        found, cell = read_curve(tmp_path / name, width if name == "alone.npy" else None)
        assert np.array_equal(found, counts)
        assert cell == pytest.approx(width)
    with pytest.raises(ConfigError, match="jitter_file_bin_ps"):
        read_curve(tmp_path / "alone.npy", None)
    np.savetxt(tmp_path / "uneven.csv", table**2, delimiter=",")
    with pytest.raises(ConfigError, match="equal steps"):
        read_curve(tmp_path / "uneven.csv", None)
    (tmp_path / "text.csv").write_text("a,b\nc,d\n")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_curve(tmp_path / "text.csv", None)
