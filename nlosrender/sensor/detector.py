"""A detector of a configuration: from light of sensor points to counts, and what is worth saying about them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.random import Generator

from nlosrender.config.sensor import MAX_BINS, OPL_PER_PS, PLANCK, SensorConfig
from nlosrender.constants import SPEED_OF_LIGHT
from nlosrender.errors import ConfigError
from nlosrender.sensor.curve_file import KEY, read_curve
from nlosrender.sensor.detection import (
    DeadTime,
    Float64,
    coates,
    first_photon_counts,
    first_photon_mean,
)
from nlosrender.sensor.rebinning import Float32, Rebinning, TimeBins
from nlosrender.sensor.response import FWHM_OF_SIGMA, Response, convolved, measured_response, parametric_response

MOST_COUNTS = 1e18  # of a bin: numpy draws integers of 64 bits
LONGEST_AFTERPULSES = 40  # decay constants after which none are followed: exp(-40)
LEAST_CASCADE = 1e-9  # of a detection: afterpulses of afterpulses below it are not followed
AFTERPULSE_CELLS = 2**22  # at most, of their distribution


@dataclass
class Totals:
    """Sums over histograms: photons per pulse, and expected counts of all pulses."""

    histograms: int = 0
    photons: float = 0.0  # per pulse, that reach the detector at any time
    in_bins: float = 0.0  # of them, in the bins
    signal: float = 0.0  # counts if each photon were one, with crosstalk
    background: float = 0.0  # counts of ambient light and of none
    expected: float = 0.0  # counts, with pile-up and afterpulses
    detected: float = 0.0  # of them, no afterpulses
    brightest: float = 0.0  # detections per pulse, of the brightest histogram
    counts: float = 0.0  # drawn
    without_ready: int = 0  # histograms with bins that pile-up could not be corrected in

    def add(self, other: Totals) -> None:
        """Add those of further histograms."""
        for each in fields(self):
            both = getattr(self, each.name), getattr(other, each.name)
            setattr(self, each.name, max(both) if each.name == "brightest" else sum(both))


@dataclass(frozen=True, eq=False)
class Detector:
    """A detector before a capture's time axis; made by ``detector_of``."""

    config: SensorConfig
    rebinning: Rebinning
    scale: float = 1.0  # photons per pulse of a unit of the capture's data

    @property
    def bins(self) -> TimeBins:
        """Time bins that photons are counted in."""
        return self.rebinning.detector

    @property
    def response(self) -> Response:
        """Time response of laser pulse and detector together."""
        return self.rebinning.response

    @cached_property
    def background(self) -> Float64:
        """(bins,) detections per pulse without the laser."""
        seconds = self.bins.width / SPEED_OF_LIGHT
        return self.config.background_rate * seconds * self.rebinning.open_share

    @cached_property
    def _crosstalk(self) -> Float64 | None:
        talk = self.config.crosstalk
        return None if talk is None or not talk.share else talk.share * self.rebinning.of_moment(talk.delay_opl)

    @cached_property
    def _dead_time(self) -> DeadTime | None:
        if self.config.pile_up != "dead_time" or self.config.dead_time_ps is None:
            return None
        return DeadTime(self.bins, self.config.dead_time_ps * OPL_PER_PS, self.config.period_opl)

    def _rates(self, light: Float32) -> tuple[Float64, Totals]:
        """Return r (bins, points), the detections per pulse and bin without pile-up, and sums over them."""
        r = self.rebinning.apply(light).astype(np.float64)
        photons, ratio = light.sum(axis=0, dtype=np.float64), self.config.photon_detection_ratio
        totals = Totals(light.shape[1], float(photons.sum()) * self.scale, float(r.sum()) * self.scale)
        if self._crosstalk is not None:
            r += np.outer(self._crosstalk, photons)
        r *= self.scale * ratio
        totals.signal = float(r.sum()) * self.config.n_pulses
        totals.background = float(self.background.sum()) * self.config.n_pulses * light.shape[1]
        r += self.background[:, None]
        most = float(r.max(initial=0.0))
        if not most * self.config.n_pulses < MOST_COUNTS:
            message = (
                f"makes {most:.3g} detections per pulse and bin in {self.config.n_pulses} pulses; need less light."
            )
            raise ConfigError.at("sensor.photons_per_pulse", message)
        return r, totals

    def measure(self, light: Float32, random: Generator | None) -> tuple[Float64, Totals]:
        """Return counts (bins, points) of light (source bins, points), and sums; without ``random`` their expectation.

        The expectation of a dead time is not computed twice: the sums of a draw have the drawn counts in its place.
        """
        config, pulses = self.config, self.config.n_pulses
        r, totals = self._rates(light)
        if config.pile_up == "first_photon":
            per_pulse = -np.expm1(-r.sum(axis=0))
            counts = first_photon_counts(r, pulses, random) if random else pulses * first_photon_mean(r)
        elif self._dead_time is not None:
            cells = self._dead_time.with_gap(r, self._gap_rate)
            counts = self._dead_time.counts(cells, pulses, random) if random else pulses * self._dead_time.mean(cells)
            counts = counts[: self.bins.count]
            per_pulse = counts.sum(axis=0) / pulses
        else:
            per_pulse = r.sum(axis=0)
            counts = random.poisson(pulses * r).astype(np.float64) if random else pulses * r
        totals.detected = pulses * float(per_pulse.sum())
        totals.brightest = float(per_pulse.max(initial=0.0))
        totals.expected = totals.detected
        if config.afterpulse_probability:
            followed = np.maximum(convolved(counts, self._afterpulses), 0.0)
            followed = followed[self.bins.count - 1 : 2 * self.bins.count - 1]
            totals.expected += float(followed.sum())
            counts = counts + (random.poisson(followed) if random else followed)
        totals.counts = float(counts.sum())
        return counts, totals

    def corrected(self, counts: Float64, corrections: tuple[str, ...]) -> tuple[Float64, int]:
        """Return counts without pile-up or background, and how many histograms have bins where that is impossible.

        Those bins, after which no pulse is left, are 0.
        """
        pulses, lost = self.config.n_pulses, 0
        if "pile_up" in corrections and self.config.pile_up != "none":
            inverse = self._dead_time.corrected if self._dead_time is not None else coates
            r = inverse(counts, pulses)
            wrong = ~np.isfinite(r)
            lost = int(wrong.any(axis=0).sum())
            counts = pulses * np.where(wrong, 0.0, r)
        if "background" in corrections:
            counts = counts - pulses * self.background[:, None]
        return counts, lost

    @property
    def _gap_rate(self) -> float:
        """Background rate [1/m of path] after the last bin, up to the next pulse; 0 where a gate is shut then."""
        gated = self.config.gate is not None
        return 0.0 if gated else self.config.background_rate / SPEED_OF_LIGHT

    @cached_property
    def _afterpulses(self) -> Float64:
        """(2 bins - 1,) afterpulses of one detection by how many bins later, of the whole cascade, by pulse period.

        A detection has a false one after the dead time and an exponential delay, with probability p, and that has one
        in turn: p / (1 - p) in all, in Fourier space p h / (1 - p h) with h the distribution of the delay.
        """
        count, width, p = self.bins.count, self.bins.width, self.config.afterpulse_probability
        decays = np.array(self.config.afterpulse_decay_ps) * OPL_PER_PS
        dead = (self.config.dead_time_ps or 0.0) * OPL_PER_PS
        generations = max(math.ceil(math.log(LEAST_CASCADE) / math.log(p)), 1)
        reach = (generations * dead + LONGEST_AFTERPULSES * decays.max()) / width
        cells = 2 ** math.ceil(math.log2(max(reach, count) + 1))
        if cells > AFTERPULSE_CELLS:
            need = f"delays of at most {AFTERPULSE_CELLS} bins, and they reach {reach:.3g}"
            raise ConfigError.at("sensor.afterpulse_decay_ps", f"got afterpulses after long delays, need {need}.")
        edges = np.maximum((np.arange(cells + 1) - 0.5) * width - dead, 0.0)
        delays = np.diff(np.mean([-np.expm1(-edges / decay) for decay in decays], axis=0))
        spectrum = np.fft.rfft(delays)
        cascade = np.maximum(np.fft.irfft(p * spectrum / (1 - p * spectrum), cells), 0.0)
        kernel = np.zeros(2 * count - 1)  # by delay from -(count - 1) to count - 1
        if math.isinf(self.config.period_opl):
            kernel[count - 1 :] = cascade[:count]
            return kernel
        period = self.config.period_opl / width
        for lap in range(math.floor(-count / period), math.ceil(cells / period) + 1):
            at = np.arange(-(count - 1), count) + round(lap * period)
            inside = (at >= 0) & (at < cells)
            kernel[inside] += cascade[at[inside]]
        return kernel


def detector_of(config: SensorConfig, source: TimeBins) -> Detector:
    """Return the detector of a configuration for a capture with bins ``source``, its scale still 1.

    Raises
    ------
    ConfigError
        Its response, bins, period or gate do not fit each other.
    """
    response, period = _response(config), config.period_opl
    width = config.bin_width_opl or source.width
    start = source.start if config.start_opl is None else config.start_opl
    count = config.n_bins
    if count is None:
        extent = min(source.end - start, period)
        count = (
            max(math.ceil(extent / width - 1e-6), 1) if extent < period else max(math.floor(period / width + 1e-6), 1)
        )
    bins = TimeBins(start, width, count)
    if count > MAX_BINS:
        raise ConfigError.at(
            "sensor.bin_width_opl", f"got {width:.3g} m, which makes {count} bins; need at most {MAX_BINS}."
        )
    if bins.count * width > period * (1 + 1e-9):
        most = f"at most {math.floor(period / width)}: repetition_rate has a period of {period:.6g} m"
        raise ConfigError.at("sensor.n_bins", f"got {count} bins of {width:.6g} m, need {most}.")
    if config.gate is not None and (config.gate[0] >= bins.end or config.gate[1] <= bins.start):
        span = f"{bins.start:.6g} to {bins.end:.6g} m"
        raise ConfigError.at("sensor.gate", f"got {list(config.gate)}, need some of the bins, from {span}.")
    if response.spread > bins.count * width:
        message = f"99.9 % of the response take {response.spread:.6g} m, and all bins {bins.end - start:.6g} m; "
        message += "need more bins or less jitter."
        raise ConfigError.at("sensor.jitter_file" if config.jitter_file else "sensor.jitter_fwhm_ps", message)
    gate = config.gate or (-math.inf, math.inf)
    return Detector(config, Rebinning(source, bins, response, period, gate))


def _response(config: SensorConfig) -> Response:
    laser, jitter, tail = (
        ps * OPL_PER_PS for ps in (config.laser_jitter_fwhm_ps, config.jitter_fwhm_ps, config.jitter_tail_ps)
    )
    try:
        if config.jitter_file is not None:
            counts, cell = read_curve(config.jitter_file, config.jitter_file_bin_ps)
            return measured_response(counts, cell * OPL_PER_PS, laser / FWHM_OF_SIGMA, config.zero_delay)
        sigma = math.hypot(laser, jitter) / FWHM_OF_SIGMA
        return parametric_response(sigma, tail, config.jitter_tail_share or 0.0, config.zero_delay)
    except ValueError as error:
        key = KEY if config.jitter_file is not None else "sensor.jitter_tail_ps"
        raise ConfigError.at(key, f"{config.jitter_file or 'the response'} {error}.") from error


def detector_warnings(detector: Detector) -> Iterator[str]:
    """Yield a sentence for what is legal and hardly meant."""
    source, bins, period = detector.rebinning.source, detector.bins, detector.config.period_opl
    if source.end - source.start > period * (1 + 1e-9):
        yield (
            f"sensor.repetition_rate: the capture is {source.end - source.start:.6g} m long and the period "
            f"{period:.6g} m: later light is counted with the next pulse, at the beginning of the bins."
        )
    is_cut = bins.start > source.start + bins.width or bins.end < source.end - bins.width
    if is_cut and source.end - source.start <= period:
        yield (
            f"sensor: the bins are from {bins.start:.6g} to {bins.end:.6g} m, the capture from {source.start:.6g} "
            f"to {source.end:.6g} m: light outside the bins does not reach the detector."
        )
    if detector.config.dead_time_ps and detector.config.pile_up != "dead_time":
        yield f"sensor.dead_time_ps has no effect with pile_up: {detector.config.pile_up}, but on afterpulses."


def measurement_of(detector: Detector, totals: Totals) -> dict[str, object]:
    """Return what is worth knowing of all counts: plain numbers."""
    config, n, response = detector.config, totals.histograms, detector.response
    free = totals.signal + totals.background
    return {
        "pulses": config.n_pulses,
        "photons_per_pulse": totals.photons / n,
        "scale": detector.scale,  # photons per pulse of a unit of the capture's data
        "counts": totals.counts,
        "counts_per_histogram": totals.counts / n,
        "expected_counts": totals.expected,
        "detections_per_pulse": totals.detected / (config.n_pulses * n),
        "detections_per_pulse_brightest": totals.brightest,
        "lost_to_pile_up": 1 - totals.detected / free if free and config.pile_up != "none" else 0.0,
        "signal_to_background": totals.signal / totals.background if totals.background else None,
        "outside_the_bins": max(1 - totals.in_bins / totals.photons, 0.0) if totals.photons else 0.0,
        "afterpulses": totals.expected - totals.detected,
        "response_fwhm_opl": response.fwhm,
        "response_mean_delay_opl": response.mean_delay,
    }


def physical_scale(config: SensorConfig, cell_area: float) -> float:
    """Return photons per pulse of 1 J m^-2 sr^-1 from a sensor point whose cell is ``cell_area`` [m^2]."""
    energy = PLANCK * SPEED_OF_LIGHT / ((config.wavelength_nm or math.nan) * 1e-9)
    area = config.footprint_area or cell_area
    return area * (config.aperture_solid_angle or math.nan) * config.transmission / energy
