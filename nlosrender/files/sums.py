"""What is known of a whole capture as sums over its samples, exact, so that no order of the work shows in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.relative_error import relative_l2_error

MANTISSA_BITS = 53  # of float64
HALF = 26  # bits of the lower half of a mantissa: sums of 2^36 halves stay within 64-bit integers


@dataclass(frozen=True)
class Sums:
    """Sums over part of a capture; parts are added with ``+``."""

    noise: Fraction = Fraction(0)  # sum of variances
    squares: Fraction = Fraction(0)  # sum of squared estimates
    outside: Fraction = Fraction(0)  # H outside the time window [J m^-2 sr^-1]
    energy: tuple[Fraction, ...] = ()  # H per bounce slot [J m^-2 sr^-1]
    samples: int | None = None  # paths per sensor point, the least of all units
    seconds: float = 0.0  # spent rendering

    def __add__(self, other: Sums) -> Sums:
        known = [samples for samples in (self.samples, other.samples) if samples is not None]
        return Sums(
            noise=self.noise + other.noise,
            squares=self.squares + other.squares,
            outside=self.outside + other.outside,
            energy=tuple(a + b for a, b in zip_longest(self.energy, other.energy, fillvalue=Fraction(0))),
            samples=min(known) if known else None,
            seconds=self.seconds + other.seconds,
        )

    @property
    def error_estimate(self) -> float:
        """Relative L2 error of H over everything summed; NaN where H is zero everywhere, which has none."""
        return relative_l2_error(float(self.noise), float(self.squares)) if self.squares else math.nan

    def stated_error(self, unsampled: Sequence[str]) -> float:
        """Return ``error_estimate``, or NaN where light is missing: ``unsampled`` lists the paths not sampled."""
        return math.nan if unsampled else self.error_estimate

    def energy_per_bounce(self, bounces: BounceAxis) -> dict[str, float]:
        """Return the energy by bounce number, or under ``all`` when bounces are not split."""
        return {bounces.name(slot): float(energy) for slot, energy in enumerate(self.energy)}

    def as_json(self) -> dict[str, Any]:
        """Return plain values; sums as text ``numerator/denominator``, exact."""
        return {
            "noise": str(self.noise),
            "squares": str(self.squares),
            "outside": str(self.outside),
            "energy": [str(energy) for energy in self.energy],
            "samples": self.samples,
            "seconds": self.seconds,
        }

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Sums:
        """Undo ``as_json``.

        Raises
        ------
        ValueError
            It is not what ``as_json`` returns.
        """
        try:
            return cls(
                noise=Fraction(stored["noise"]),
                squares=Fraction(stored["squares"]),
                outside=Fraction(stored["outside"]),
                energy=tuple(Fraction(energy) for energy in stored["energy"]),
                samples=None if stored["samples"] is None else int(stored["samples"]),
                seconds=float(stored["seconds"]),
            )
        except (KeyError, TypeError, ZeroDivisionError) as error:
            raise ValueError(f"no sums of a capture: {error!r}") from error


def sums_of(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    outside: NDArray[np.float64],
    samples: int,
    seconds: float,
) -> Sums:
    """Return the sums over a block.

    Parameters
    ----------
    mean, variance
        (channel, bounce, laser, sensor, bin) estimate of H [J m^-2 sr^-1] and its variance.
    outside
        (channel, bounce, laser, sensor) H outside the time window.
    samples, seconds
        Paths per sensor point; time spent rendering.
    """
    noise, squares = Fraction(0), Fraction(0)
    energy = [Fraction(0)] * mean.shape[1]
    # Over the bins of one histogram numpy's order depends on their number alone; the sums over histograms are exact.
    for laser in range(mean.shape[2]):  # one at a time: squaring makes a copy
        part = mean[:, :, laser]
        squares += exact_sum(np.square(part).sum(axis=-1))
        noise += exact_sum(variance[:, :, laser].sum(axis=-1))
        totals = part.sum(axis=-1)
        for slot in range(mean.shape[1]):
            energy[slot] += exact_sum(totals[:, slot])
    return Sums(noise, squares, exact_sum(outside), tuple(energy), samples, seconds)


def exact_sum(values: NDArray[np.float64] | Sequence[float]) -> Fraction:
    """Return the sum of finite float64 numbers without any rounding.

    Raises
    ------
    OverflowError, ValueError
        A number is not finite.
    """
    flat = np.ravel(np.asarray(values, dtype=np.float64))
    if not np.isfinite(flat).all():
        raise ValueError("a number that is not finite")
    flat = flat[flat != 0]
    if flat.size == 0:
        return Fraction(0)
    mantissa, exponent = np.frexp(flat)
    integers = np.ldexp(mantissa, MANTISSA_BITS).astype(np.int64)  # exact: 53 bits
    lowest = int(exponent.min())
    place = exponent - lowest
    upper, lower = np.zeros((2, int(place.max()) + 1), dtype=np.int64)
    np.add.at(upper, place, integers >> HALF)
    np.add.at(lower, place, integers & (2**HALF - 1))
    total = sum(((int(u) << HALF) + int(v)) << index for index, (u, v) in enumerate(zip(upper, lower, strict=True)))
    shift = lowest - MANTISSA_BITS
    return Fraction(total << shift) if shift >= 0 else Fraction(total, 1 << -shift)
