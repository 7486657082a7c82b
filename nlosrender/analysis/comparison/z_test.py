"""Do two noisy captures show the same scene? A Z-test by the stored variances, with Šidák's correction.

What is tested. A bin of a path-traced histogram holds few paths: it is not normally distributed, and its variance,
estimated from as few as two replicas, is hardly known. So neighbouring bins of one sensor point are joined in twos,
fours, eights, up to the whole histogram, and every joint bin with enough light (``MIN_LIGHT``) and enough independent
estimates of its variance (``MIN_FREEDOM``) is one statement: that the two captures agree there. The same is done with
the histograms summed over the sensor points of a laser, whose noise is independent; that finds small errors which no
single point shows. Sums over lasers are not tested: the lasers of a sensor point share their paths.

How. t = |a - b| / s, with s^2 the sum of both captures' variances; Student's t becomes a normal deviate z by its
degrees of freedom; of n statements none may exceed the z that a single one exceeds with probability
1 - (1 - significance)^(1 / n) (Šidák 1967). Correlated statements make the test stricter on false alarms, not laxer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.analysis.comparison.blocks import Block, Samples
from nlosrender.analysis.comparison.differences import index_of_max
from nlosrender.capture.bounces import FIRST_BOUNCE, LAST_FILE_BOUNCE, THIRD_BOUNCE

Float64 = NDArray[np.float64]
Place = tuple[int, int] | None  # row and column in a grid

MIN_LIGHT = 5.0  # standard deviations: a sum of 25 equal deposits
MIN_FREEDOM = 10.0  # degrees of freedom: below it t is so wide that a statement says nothing
MAX_FREEDOM = 1e9  # t is normal long before
MIN_REPLICAS = 2  # behind a stored variance, where the file does not say
ROUNDING = 1e-5  # relative: float32 samples, and arithmetic that differs between processors
UNLIMITED_BOUNCES = 10  # counted in the last index where paths have no limit: later ones are weak


@dataclass(frozen=True)
class Deviation:
    """The statement that two captures agree least on, about bins first_bin to last_bin."""

    z: float  # inf: light against none at all
    laser: Place  # None: of all laser points
    sensor: Place  # None: of all sensor points
    bounce: int  # index on the file's bounce axis
    channel: int
    first_bin: int
    last_bin: int


@dataclass(frozen=True, eq=False)
class Side:
    """One capture's part in a set of histograms (..., bin): sums of values, and what is known of their errors."""

    value: Float64
    noise: Float64  # variance
    bound: Float64  # error that is no noise, and may have one sign everywhere
    estimates: Float64  # sum of the stored variances, and of their squares / (degrees of freedom + 2):
    estimates_squared: Float64  # together they tell how many estimates are behind the sum

    def joined(self) -> Side:
        """Return the same with neighbouring bins joined in twos."""
        return self._map(_pairs)

    def summed(self, slot: int) -> Side:
        """Return the sum over the sensor points of one bounce: (channel, bounce, y, x, bin) -> (channel, 1, bin)."""
        return self._map(lambda part: part[:, slot : slot + 1].sum(axis=(2, 3)))

    def plus(self, other: Side) -> Side:
        """Return the sum of two independent sides."""
        return Side(*(mine + others for mine, others in zip(vars(self).values(), vars(other).values(), strict=True)))

    def variance_under(self, value: Float64, per_light: Float64) -> Float64:
        """Return the variance if the true value were at least ``value``.

        Deposits are rare and the variance grows with their number: where this side has by chance too few of them,
        its own variance is too small to judge the other side by. ``per_light`` is what a deposit weighs elsewhere.
        """
        own = np.abs(self.value)
        largest = np.maximum(own, np.abs(value))
        scaled = self.noise * np.divide(largest, own, out=np.ones_like(own), where=own > 0)
        return np.maximum(scaled, per_light * largest)

    def _map(self, change: Callable[[Float64], Float64]) -> Side:
        return Side(*(change(part) for part in vars(self).values()))


class Described(Protocol):
    """What the test asks of a capture, stored (``StoredHeader``) or in memory."""

    @property
    def attributes(self) -> Mapping[str, object]: ...  # render_engine, replicas, max_bounces, where they are known
    @property
    def sizes(self) -> Mapping[str, int]: ...  # of at least the axes channel and bounce
    @property
    def split_bounces(self) -> bool | None: ...  # whether each bounce has an index of its own; None: not known
    @property
    def n_bins(self) -> int: ...


class ErrorModel:
    """What the variances in a file mean.

    The path engine stores the variance of the mean of its replicas, independent from sensor point to sensor point.
    The virtual-light engine stores the square of an estimated discretisation error for the third bounce; above it the
    variance of walks, which sensor points may share. In sums the errors are added there, not their squares, which is
    the most they can be.
    """

    def __init__(self, header: Described):
        attributes, n_bounces = header.attributes, header.sizes["bounce"]
        replicas, limit = attributes.get("replicas"), attributes.get("max_bounces")
        self.is_independent = attributes.get("render_engine") != "virtual_lights"
        freedom = max(replicas if isinstance(replicas, int) else 0, MIN_REPLICAS) - 1
        self.freedom = freedom if self.is_independent else 1
        third = THIRD_BOUNCE - FIRST_BOUNCE
        self._is_noise = np.ones(n_bounces, dtype=bool)
        if not self.is_independent and header.split_bounces and n_bounces > third:
            self._is_noise[third] = False
        highest = limit if isinstance(limit, int) else LAST_FILE_BOUNCE + UNLIMITED_BOUNCES
        self._per_path = np.ones(n_bounces)  # deposits of one path in one index
        if header.split_bounces is False and n_bounces > third:
            self._per_path[third] = max(highest - FIRST_BOUNCE, 1)
        elif n_bounces > LAST_FILE_BOUNCE - FIRST_BOUNCE:
            self._per_path[LAST_FILE_BOUNCE - FIRST_BOUNCE] = max(highest - LAST_FILE_BOUNCE + 1, 1)
        # (channel, bounce) sums over all blocks so far
        self.light, self._noise = (np.zeros((header.sizes["channel"], n_bounces)) for _ in range(2))

    def side(self, values: Samples, variance: Samples | None, bounces: tuple[int, ...]) -> Side:
        """Return samples (channel, bounce, y, x, bin) with their errors; without a variance they count as exact."""
        value = values.astype(np.float64)
        stored = np.zeros_like(value) if variance is None else variance.astype(np.float64)
        estimates = stored, np.square(stored) / (self.freedom + 2)
        self.light[:, list(bounces)] += np.abs(value).sum(axis=(2, 3, 4))
        bound = np.zeros_like(value) if self.is_independent else _usual_error(value, stored)
        # deposits of one path in several bins are correlated: var(sum of n) <= n * sum of variances (Cauchy-Schwarz)
        noise = stored * (self._per_path * self._is_noise)[list(bounces), None, None, None]
        self._noise[:, list(bounces)] += noise.sum(axis=(2, 3, 4))
        return Side(value, noise, bound, *estimates)

    def per_light(self, bounces: tuple[int, ...]) -> Float64:
        """Return (channel, bounce) variance per light, which is what a deposit weighs; NaN without any light."""
        light, noise = self.light[:, list(bounces)], self._noise[:, list(bounces)]
        return np.divide(noise, light, out=np.full_like(light, np.nan), where=light > 0)


def _usual_error(value: Float64, stored: Float64) -> Float64:
    """Return the error of each bin (..., bin): its own, at least the root mean square of its histogram's.

    Two resolutions may agree in a bin by chance, above all where both see nothing.
    """
    known = (stored > 0) | (value != 0)
    count = np.maximum(known.sum(axis=-1, keepdims=True), 1)
    return np.sqrt(np.maximum(stored, stored.sum(axis=-1, keepdims=True) / count))


def deviations(a: Side, b: Side, per_light_a: Float64, per_light_b: Float64) -> tuple[Float64, NDArray[np.bool_]]:
    """Return |a - b| as normal deviates z (..., bin), and which of them are statements; z is 0 elsewhere.

    ``per_light_a`` and ``per_light_b``, with as many axes, are ``ErrorModel.per_light``; where they are NaN nothing
    is stated.
    """
    difference = np.abs(a.value - b.value)
    rounding = ROUNDING * (np.abs(a.value) + np.abs(b.value))
    square = a.variance_under(b.value, per_light_a) + b.variance_under(a.value, per_light_b)
    square += np.square(a.bound) + np.square(b.bound) + np.square(rounding)
    estimates, spread = a.estimates + b.estimates, a.estimates_squared + b.estimates_squared
    # Satterthwaite 1946, with E[v^2] = var^2 (1 + 2 / f) taken out of the estimates v with f degrees of freedom
    freedom = np.full_like(difference, MAX_FREEDOM)
    np.divide(np.square(estimates), spread, out=freedom, where=spread > 0)
    freedom = np.where(spread > 0, freedom - 2, MAX_FREEDOM)
    lit = np.square(np.maximum(np.abs(a.value), np.abs(b.value))) >= MIN_LIGHT**2 * square
    stated = ((difference > 0) | (estimates > 0)) & lit & (freedom >= MIN_FREEDOM)
    t = np.divide(difference, np.sqrt(square), out=np.zeros_like(difference), where=stated & (square > 0))
    return normal_deviate(t, np.maximum(freedom, MIN_FREEDOM)), stated


def sidak(significance: float, n: int) -> float:
    """Return the significance of each of ``n`` statements that together have ``significance`` (Šidák 1967)."""
    return -math.expm1(math.log1p(-significance) / max(n, 1))


def normal_deviate(t: ArrayLike, freedom: ArrayLike) -> Float64:
    """Return the normal deviate z that is as rare as Student's t (Wallace 1959), from ``MIN_FREEDOM`` on."""
    f = np.asarray(freedom, dtype=np.float64)
    return (8 * f + 1) / (8 * f + 3) * np.sqrt(f * np.log1p(np.square(t) / f))


class ZTest:
    """Collects statements from blocks and judges them at the end.

    Parameters
    ----------
    a, b
        What is known of the two captures; at least one has variances, the other may be exact.
    significance
        Probability of an alarm where both show the same, over the whole capture.
    """

    def __init__(self, a: Described, b: Described, significance: float):
        self.models = (ErrorModel(a), ErrorModel(b))
        self.significance = significance
        self.n_statements = 0
        self.worst: Deviation | None = None
        self._n_bins = b.n_bins
        self._laser = (0, 0)
        self._sums: dict[int, tuple[Side, Side]] = {}  # per bounce, (channel, 1, bin): over the sensor points so far

    def add(self, block: Block) -> None:
        """Take the statements of one block; the blocks of a laser come one after the other."""
        if block.laser != self._laser:
            self._finish_laser()
            self._laser = block.laser
        a = self.models[0].side(block.a, block.variance_a, block.bounces)
        b = self.models[1].side(block.b, block.variance_b, block.bounces)
        for slot, bounce in enumerate(block.bounces):
            sums, known = (a.summed(slot), b.summed(slot)), self._sums.get(bounce)
            self._sums[bounce] = (known[0].plus(sums[0]), known[1].plus(sums[1])) if known else sums
        for z, width in self._state(a, b, block.bounces):
            channel, slot, y, x, joint = index_of_max(z)
            sensor = (block.rows.start + y, block.columns.start + x)
            self._note(float(z.max()), (self._laser, sensor, block.bounces[slot], channel), joint * width, width)

    def finish(self) -> None:
        """Take the last statements: about the last laser, and about bounces that one side lacks altogether."""
        self._finish_laser()
        light = [model.light for model in self.models]
        for channel, bounce in np.argwhere((light[0] > 0) != (light[1] > 0)).tolist():
            self.n_statements += 1
            self._note(math.inf, (None, None, bounce, channel), 0, self._n_bins)

    def _finish_laser(self) -> None:
        """Take the statements about the sums over the sensor points of the laser."""
        for bounce, (a, b) in self._sums.items():
            for z, width in self._state(a, b, (bounce,)):
                channel, _, joint = index_of_max(z)
                self._note(float(z.max()), (self._laser, None, bounce, channel), joint * width, width)
        self._sums = {}

    @property
    def limit(self) -> float:
        """The z that no statement may exceed."""
        return -NormalDist().inv_cdf(sidak(self.significance, self.n_statements) / 2)

    @property
    def z(self) -> float:
        """The largest deviation."""
        return self.worst.z if self.worst else 0.0

    def _state(self, a: Side, b: Side, bounces: tuple[int, ...]) -> Iterator[tuple[Float64, int]]:
        """Yield z of single bins, then of pairs, of fours and so on, and how many bins are joined."""
        after = (1,) * (a.value.ndim - 2)  # sums have no sensor axes
        per_light = [(light := model.per_light(bounces)).reshape(*light.shape, *after) for model in self.models]
        width = 1
        while True:
            z, stated = deviations(a, b, *per_light)
            self.n_statements += int(stated.sum())
            yield z, width
            if z.shape[-1] == 1:
                return
            a, b, width = a.joined(), b.joined(), 2 * width

    def _note(self, z: float, where: tuple[Place, Place, int, int], first_bin: int, width: int) -> None:
        if z > self.z:
            self.worst = Deviation(z, *where, first_bin, min(first_bin + width, self._n_bins) - 1)


def _pairs(part: Float64) -> Float64:
    """Add neighbours along the last axis; an odd last one stays alone."""
    length = part.shape[-1]
    joined = part[..., : length - length % 2].reshape(*part.shape[:-1], -1, 2).sum(axis=-1)
    return np.concatenate([joined, part[..., -1:]], axis=-1) if length % 2 else joined
