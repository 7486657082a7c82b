"""How many histograms a second a detector counts: response and each kind of pile-up, in memory."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from nlosrender.bench.runs import Timer
from nlosrender.config.sensor import SensorConfig
from nlosrender.files.measured import BLOCK_SAMPLES
from nlosrender.files.thread_pool import in_order, processors
from nlosrender.sensor.detector import Detector, detector_of
from nlosrender.sensor.rebinning import Float32, TimeBins

POINTS, BINS, WIDTH = 256 * 256, 512, 0.003
ROUNDS = 3
DETECTORS: dict[str, dict[str, Any]] = {
    "none": {},
    "first_photon": {"pile_up": "first_photon"},
    "dead_time": {"pile_up": "dead_time", "dead_time_ps": 50_000},
}


def counting_rates() -> list[dict[str, Any]]:
    """Return seconds, CPU seconds and points per second of each kind of pile-up: the fastest of ``ROUNDS``, in turns.

    65,536 histograms of 512 bins, a 95 ps response, 11 MHz, 0.1 s, 0.05 photons per pulse and ambient light.
    """
    light = _front()
    blocks = [light[:, i : i + BLOCK_SAMPLES // BINS] for i in range(0, POINTS, BLOCK_SAMPLES // BINS)]
    best, threads = dict[str, tuple[float, float]](), {"threads": processors()}
    for _ in range(ROUNDS):
        for name, keys in DETECTORS.items():
            values = {"jitter_fwhm_ps": 95, "repetition_rate": 11e6, "exposure_time": 0.1, "ambient_rate": 1e4}
            scale = {"photons_per_pulse": {"mean": 0.05}}
            detector = detector_of(SensorConfig.model_validate(values | scale | keys), TimeBins(0.0, WIDTH, BINS))
            timer = Timer()
            for _ in in_order(functools.partial(_counted, detector), enumerate(blocks)):
                pass
            best[name] = min(best.get(name, (np.inf, np.inf)), timer.read())
    return [
        {"pile_up": name, "seconds": wall, "cpu_seconds": cpu, "points_per_second": POINTS / wall} | threads
        for name, (wall, cpu) in best.items()
    ]


def _counted(detector: Detector, numbered: tuple[int, Float32]) -> None:
    number, block = numbered
    detector.measure(block, np.random.Generator(np.random.Philox(number)))


def _front() -> Float32:
    """Return light (bins, points), 0.05 per point: a front that arrives at different times and decays."""
    later = np.arange(BINS)[:, None] - np.random.default_rng(0).integers(100, 200, POINTS)
    light = np.where(later >= 0, np.exp(-np.abs(later) / 80), 0).astype(np.float32)
    return light * np.float32(0.05) / light.sum(axis=0)
