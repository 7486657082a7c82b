"""Counts of a detector: the laws of the first photon and of dead times, and a simulation photon by photon."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from nlosrender.config.sensor import SensorConfig
from nlosrender.sensor.detection import DeadTime, coates, first_photon_counts, first_photon_mean
from nlosrender.sensor.detector import detector_of
from nlosrender.sensor.rebinning import TimeBins

BINS = TimeBins(0.0, 1.0, 40)
PULSES = 1_000_000
SURE = 1e-4  # of a false alarm


def flux(total: float, points: int = 1) -> np.ndarray:
    """Two echoes on a floor, (bins, points), with ``total`` photons per pulse."""
    x = np.arange(BINS.count)
    shape = np.exp(-(((x - 12) / 4) ** 2)) + 0.3 * np.exp(-(((x - 28) / 3) ** 2)) + 0.02
    return np.repeat((total * shape / shape.sum())[:, None], points, axis=1)


def is_drawn_from(counts: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether counts (bins,) agree with a mean and a covariance by chi-square."""
    difference = counts - mean
    statistic = difference @ np.linalg.solve(covariance, difference)
    low, high = chi2.ppf([SURE / 2, 1 - SURE / 2], len(mean))
    return bool(low < statistic < high)


def simulated(r: np.ndarray, dead_time: float, seed: int, first_only: bool = False) -> np.ndarray:
    """Counts (bins,) of ``PULSES`` pulses in a row, photon by photon; every bin's photons come evenly in it."""
    random, total = np.random.default_rng(seed), float(r.sum())
    arrivals = random.poisson(total * PULSES)
    pulse = random.integers(0, PULSES, arrivals)
    within = random.choice(BINS.count, arrivals, p=r / total) + random.random(arrivals)
    times = np.sort(pulse * float(BINS.count) + within)
    if first_only:
        _, first = np.unique((times // BINS.count).astype(int), return_index=True)
        detected = times[first]
    else:
        kept, ready = [], -math.inf
        for time in times.tolist():
            if time >= ready:
                kept.append(time)
                ready = time + dead_time
        detected = np.array(kept)
    return np.bincount((detected % BINS.count).astype(int), minlength=BINS.count)


def test_without_pile_up_the_mean_is_the_variance() -> None:
    """1e6 Poisson draws of two rates, by the index of dispersion: chi-square with as many degrees of freedom."""
    config = SensorConfig.model_validate({"pulses": 1000, "photons_per_pulse": {"mean": 1}})
    detector = detector_of(config, TimeBins(0.0, 0.003, 100))
    light = np.repeat(np.array([[0.002], [0.05]], np.float32), 50, axis=0) * np.ones((1, 10_000), np.float32)
    counts, totals = detector.measure(light, np.random.default_rng(8))
    for rate, rows in ((2.0, counts[:50]), (50.0, counts[50:])):
        dispersion = ((rows - rate) ** 2).sum() / rate
        low, high = chi2.ppf([SURE / 2, 1 - SURE / 2], rows.size)
        # the variance of (n - m)^2 / m is 2 + 1 / m of a Poisson, 2 of chi-square
        spread = math.sqrt(1 + 1 / (2 * rate))
        assert rows.size + (low - rows.size) * spread < dispersion < rows.size + (high - rows.size) * spread
        assert rows.mean() == pytest.approx(rate, abs=5 * math.sqrt(rate / rows.size))
    assert totals.counts == counts.sum()


def test_coates_inverts_the_expected_first_photons() -> None:
    """r comes back to 1e-9, also where few pulses are left."""
    for total in (1e-3, 0.5, 4.0):
        r = flux(total)
        np.testing.assert_allclose(coates(PULSES * first_photon_mean(r), PULSES), r, rtol=1e-9)


@pytest.mark.parametrize("total", [0.01, 0.5, 3.0])
def test_first_photons_are_those_of_a_simulation(total: float) -> None:
    """Photon by photon, 1e6 pulses; drawn and simulated counts have the covariance of a multinomial."""
    p = first_photon_mean(flux(total))[:, 0]
    covariance = PULSES * (np.diag(p) - np.outer(p, p))
    assert is_drawn_from(simulated(flux(total)[:, 0], 0.0, 3, first_only=True), PULSES * p, covariance)
    drawn = first_photon_counts(flux(total, 5), PULSES, np.random.default_rng(4))
    assert all(is_drawn_from(counts, PULSES * p, covariance) for counts in drawn.T)


@pytest.mark.parametrize("total", [0.01, 0.5, pytest.param(3.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dead_time", [0.4, 9.7, 40.0, pytest.param(95.5, marks=pytest.mark.slow)])
def test_dead_times_are_those_of_a_simulation(total: float, dead_time: float) -> None:
    """Photon by photon, 1e6 pulses, dead times below a bin and above two periods; our draws tell the covariance."""
    detector = DeadTime(BINS, dead_time, float(BINS.count))
    draws = detector.counts(flux(total, 2000), PULSES, np.random.default_rng(5))
    mean = PULSES * detector.mean(flux(total))[:, 0]
    covariance = np.cov(draws)
    # the mean of the draws is the mean, by their own spread
    assert is_drawn_from(draws.mean(axis=1), mean, covariance / draws.shape[1])
    # the simulation is one more draw; the covariance of 2000 is known to 40 / 2000 of it
    assert is_drawn_from(simulated(flux(total)[:, 0], dead_time, 6), mean, covariance)


@pytest.mark.parametrize(("total", "dead_time"), [(0.3, 7.3), (3.0, 0.3), (3.0, 7.3), (10.0, 38.0), (10.0, 95.0)])
def test_constant_light_makes_the_renewal_process(total: float, dead_time: float) -> None:
    """The rate lambda / (1 + lambda tau), and the variance lambda t / (1 + lambda tau)^3 of all counts."""
    bins, points = TimeBins(0.0, 1.0, 20), 4000
    detector, rate = DeadTime(bins, dead_time, 20.0), total / 20
    r = np.full((20, points), rate)
    np.testing.assert_allclose(detector.mean(r[:, :1]), rate / (1 + rate * dead_time), rtol=1e-6)
    counts = detector.counts(r, PULSES, np.random.default_rng(7)).sum(axis=0)
    expected = PULSES * total / (1 + rate * dead_time) ** 3
    # a variance of n draws has the relative deviation sqrt(2 / n); rounding adds at most 20 x 1/4
    assert counts.var() == pytest.approx(expected, rel=4.5 * math.sqrt(2 / points))
    assert counts.mean() == pytest.approx(PULSES * total / (1 + rate * dead_time), rel=5e-5)


def test_below_one_per_cent_all_modes_agree() -> None:
    """Of little light nothing is lost: to the flux itself."""
    r = flux(0.009)
    for mean in (first_photon_mean(r), DeadTime(BINS, 15.0, 40.0).mean(r), DeadTime(BINS, 15.0).mean(r)):
        np.testing.assert_allclose(mean, r, rtol=0.009)


@pytest.mark.parametrize(("dead_time", "period"), [(0.4, 40.0), (9.7, 40.0), (95.5, 40.0), (9.7, math.inf)])
def test_dead_times_are_inverted(dead_time: float, period: float) -> None:
    """As Coates does the first photon: r comes back to what the mean is solved to, of bright bins to 1 %."""
    detector = DeadTime(BINS, dead_time, period)
    for total, tolerance in ((0.3, 1e-5), (0.8, 0.01)):
        r = flux(total)
        np.testing.assert_allclose(detector.corrected(PULSES * detector.mean(r), PULSES), r, rtol=tolerance)


def test_pulses_far_apart_meet_a_ready_detector() -> None:
    """With a dead time beyond the bins it is the first photon."""
    r = flux(1.5)
    # photons come evenly in a bin, which the first of the pulse does not: both agree as the bins become fine
    np.testing.assert_allclose(DeadTime(BINS, 41.0).mean(r), first_photon_mean(r), rtol=1e-9)


def test_between_the_pulses_there_is_background() -> None:
    """Bins that are a part of the period, and those of all of it: the same light, the same detections."""
    background, period = 1e-3, 160.0
    r, part = flux(0.8) + background, DeadTime(BINS, 30.0, period)
    whole = DeadTime(TimeBins(0.0, 1.0, 160), 30.0, period)
    full = np.concatenate([r, np.full((120, 1), background)])
    np.testing.assert_allclose(part.mean(part.with_gap(r, background))[:40], whole.mean(full)[:40], rtol=1e-5)
