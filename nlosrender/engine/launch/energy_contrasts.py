"""Energy contrasts: balanced half-samples (McCarthy 1969), from which the standard error of a capture's energy follows.

The variance of the energy is not the sum of the variances of bins: sensor points share VPL subpaths, and the lasers of
an exhaustive capture share paths. Replicas are independent: those of each sensor point where paths are traced, those of
all sensor points together, and rounds, where VPL subpaths are shared. A contrast is the sum of the energies of replicas
with random signs, opposite within a pair, so that the energy itself cancels. Contrasts are linear in H: those of the
parts of a capture add up to that of the whole, whatever the correlations. The mean square of ``CONTRASTS`` contrasts
estimates the variance of the energy, with as many degrees of freedom as contrasts, or as independent pairs if fewer.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.histogram import DeviceHistogram

CONTRASTS = 32  # a standard error of the energy's error of 1 / sqrt(2 * 32) = 13 %
FEW_PAIRS = 8  # independent pairs below which contrasts weight places of the wall (``_slow_weights``)
Contrasts = NDArray[np.float64]  # (contrast, channel, slot) [J m^-2 sr^-1]


def no_contrasts(channels: int, slots: int) -> Contrasts:
    """Return the contrasts of an exact result: zero."""
    return np.zeros((CONTRASTS, channels, slots))


def contrasts_of_points(
    histogram: DeviceHistogram, sensors: NDArray[np.integer], factor: float, slots: range
) -> Contrasts:
    """Return the contrasts of sensor points with replicas of their own.

    Parameters
    ----------
    histogram
        After the last launch.
    sensors
        (sensors,) flat indices of its sensor points in the capture: the signs of a sensor point are the same for all
        lasers, in whatever batch.
    factor
        What sums are multiplied by to become H, replicas added.
    slots
        Bounce slots of the result, as for ``DeviceHistogram.statistics``.
    """
    energies = histogram.energies().sum(axis=2)  # (replica, sensor, slot, channel)
    pairs = energies.shape[0] // 2
    differences = energies[0 : 2 * pairs : 2] - energies[1 : 2 * pairs : 2]
    keys = np.arange(pairs)[:, None] * 2**32 + np.asarray(sensors, dtype=np.int64)
    sums = np.einsum("kps,psbc->kcb", random_signs(keys), differences, optimize=True)
    return _in_slots(sums * (factor * _unpaired(energies.shape[0])), slots)


class RoundContrasts:
    """Contrasts of sensor points that share VPL subpaths: a sign per replica and group of rounds, or part of a round.

    It is that of all points.

    Parameters
    ----------
    histogram
        That the rounds are added to, empty.
    places
        (sensors, 2) where its sensor points are, see ``PointGrid.places``.
    """

    def __init__(self, histogram: DeviceHistogram, places: NDArray[np.float64]):
        shape = histogram.shape
        self._histogram, self.groups = histogram, 0
        self._weights = np.stack([np.ones((CONTRASTS, shape.sensors)), _slow_weights(places)])
        self._wanted = math.ceil(CONTRASTS / max(shape.replicas // 2, 1))
        self.grouped = np.zeros((2, CONTRASTS, shape.replicas, shape.slots, shape.channels))
        self.sums = np.zeros((2, CONTRASTS, shape.channels, shape.slots))

    def restore(self, sums: NDArray[np.float64], grouped: NDArray[np.float64], groups: int) -> None:
        """Continue from saved values of these attributes."""
        self.sums[:], self.grouped[:], self.groups = sums, grouped, groups

    def add(self, done: int, is_last: bool) -> None:
        """Close a group of rounds, after ``done`` rounds, when the group is complete or ``is_last``."""
        every = 2 ** max(0, math.floor(math.log2(done / self._wanted)))
        if not (is_last or done % every == 0):
            return
        energies = self._weighted(self._histogram.energies().sum(axis=2))
        self._add(energies - self.grouped)
        self.grouped = energies

    def add_part(self, energies: NDArray[np.float64]) -> None:
        """Add the ``energies`` (replica, sensor, slot, channel) of a part of a round, independent of its others."""
        self._add(self._weighted(energies))

    def _weighted(self, energies: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("wks,rsbc->wkrbc", self._weights, energies, optimize=True))

    def _add(self, energies: NDArray[np.float64]) -> None:
        pairs = energies.shape[2] // 2
        differences = energies[:, :, 0 : 2 * pairs : 2] - energies[:, :, 1 : 2 * pairs : 2]
        signs = random_signs(np.arange(pairs) * 2**32 + self.groups)
        self.sums += np.einsum("kp,wkpbc->wkcb", signs, differences)
        self.groups += 1

    def result(self, factor: float, slots: range) -> Contrasts:
        """Return the contrasts; parameters as for ``contrasts_of_points``."""
        replicas = self._histogram.shape.replicas
        is_few = replicas // 2 * self.groups < FEW_PAIRS
        return _in_slots(self.sums[int(is_few)] * (factor * _unpaired(replicas)), slots)


def contrasts_of_deviation(deviation: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the contrasts (contrast, channel) of a known deviation, estimated minus true, of one bounce.

    Parameters
    ----------
    deviation
        (channel, laser, sensor, bin) [J m^-2 sr^-1]: one sample of it.
    places
        As for ``RoundContrasts``.
    """
    per_sensor = deviation.sum(axis=(1, 3))
    return np.asarray(_slow_weights(places) @ per_sensor.T, dtype=np.float64)


def _slow_weights(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (contrast, sensor) about 1 that change slowly from place to place.

    With few samples of a difference its sum may be small by chance while parts of the wall deviate much. Weights that
    vary slowly over the wall reveal them; a constant deviation counts once, and no error more than sqrt(3) times.
    """
    waves = np.random.default_rng(0).random((3, CONTRASTS))
    phase = (waves[:2].T * 2 - 1) @ np.ascontiguousarray(places.T) + waves[2][:, None]  # at most a period over the grid
    return np.asarray(1 + math.sqrt(2) * np.cos(2 * math.pi * phase), dtype=np.float64)


def random_signs(keys: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return (contrast, *shape of the keys) 1 or -1, independent for different keys, the same for the same key."""
    bits = keys.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)  # the mixing function of SplitMix64 (Steele 2014)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits ^= bits >> np.uint64(31)
    shifts = np.arange(CONTRASTS, dtype=np.uint64).reshape(-1, *(1,) * keys.ndim)
    return np.asarray(((bits >> shifts) & np.uint64(1)) * 2.0 - 1.0, dtype=np.float64)


def _unpaired(replicas: int) -> float:
    """Return the factor that makes up for an odd replica, which has no partner."""
    return math.sqrt(replicas / max(replicas // 2 * 2, 1))


def _in_slots(sums: NDArray[np.float64], slots: range) -> Contrasts:
    """Return sums (contrast, channel, own slot) in the slots of the result; those the histogram does not have are 0."""
    result = no_contrasts(sums.shape[1], len(slots))
    for place, slot in enumerate(slots):
        if 0 <= slot < sums.shape[2]:
            result[:, :, place] = sums[:, :, slot]
    return result
