"""Sums over the samples of a capture: exact, so that neither cuts nor the order of the work show in the results."""

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

CONTRAST_BITS = 32  # mantissa bits of a contrast: journals store it as text, and an error estimate needs no more
STATED_DIGITS = 4  # digits of errors computed from contrasts: further ones depend on how the work is cut


@dataclass(frozen=True)
class Sums:
    """Sums over part of a capture; parts are added with ``+``."""

    slot_noise: tuple[Fraction, ...] = ()  # sum of variances per bounce slot
    slot_squares: tuple[Fraction, ...] = ()  # sum of squared estimates per bounce slot
    outside: Fraction = Fraction(0)  # H outside the time window [J m^-2 sr^-1]
    energy: tuple[Fraction, ...] = ()  # H per bounce slot [J m^-2 sr^-1]
    samples: int | None = None  # paths per sensor point, the least of all work items
    seconds: float = 0.0  # spent rendering
    contrasts: tuple[tuple[Fraction, ...], ...] = ()  # of the energy per bounce slot [J m^-2 sr^-1]

    def __add__(self, other: Sums) -> Sums:
        known = [samples for samples in (self.samples, other.samples) if samples is not None]
        return Sums(
            slot_noise=_added(self.slot_noise, other.slot_noise),
            slot_squares=_added(self.slot_squares, other.slot_squares),
            outside=self.outside + other.outside,
            energy=_added(self.energy, other.energy),
            samples=min(known) if known else None,
            seconds=self.seconds + other.seconds,
            contrasts=tuple(_added(a, b) for a, b in zip_longest(self.contrasts, other.contrasts, fillvalue=())),
        )

    @property
    def noise(self) -> Fraction:
        """Sum of variances."""
        return sum(self.slot_noise, Fraction(0))

    @property
    def squares(self) -> Fraction:
        """Sum of squared estimates."""
        return sum(self.slot_squares, Fraction(0))

    @property
    def error_estimate(self) -> float:
        """Relative L2 error of H over everything summed; NaN where H is zero everywhere, which has none."""
        return _relative_error(self.noise, self.squares)

    def errors_per_bounce(self, bounces: BounceAxis) -> dict[str, float]:
        """Return the relative L2 error of H by bounce number; NaN where a bounce has no light."""
        pairs = zip(self.slot_noise, self.slot_squares, strict=True)
        return {bounces.name(slot): _relative_error(*pair) for slot, pair in enumerate(pairs)}

    def energy_errors(self, bounces: BounceAxis) -> dict[str, float]:
        """Return the standard error of ``energy_per_bounce`` by bounce number, NaN where it is not known."""
        columns = zip(*self.contrasts, strict=True) if self.contrasts else [()] * len(self.energy)
        return {bounces.name(slot): _root_mean_square(column) for slot, column in enumerate(columns)}

    @property
    def energy_error(self) -> float:
        """Standard error of the energy of all bounces together [J m^-2 sr^-1]; NaN: not known."""
        return _root_mean_square([sum(contrast, Fraction(0)) for contrast in self.contrasts])

    def energy_per_bounce(self, bounces: BounceAxis) -> dict[str, float]:
        """Return the energy by bounce number, or under ``all`` when bounces are not split."""
        return {bounces.name(slot): float(energy) for slot, energy in enumerate(self.energy)}

    def as_json(self) -> dict[str, Any]:
        """Return plain values; sums as text ``numerator/denominator``, exact."""
        return {
            "noise": _texts(self.slot_noise),
            "squares": _texts(self.slot_squares),
            "outside": str(self.outside),
            "energy": _texts(self.energy),
            "samples": self.samples,
            "seconds": self.seconds,
            "contrasts": [_texts(contrast) for contrast in self.contrasts],
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
                slot_noise=_fractions(stored["noise"]),
                slot_squares=_fractions(stored["squares"]),
                outside=Fraction(stored["outside"]),
                energy=_fractions(stored["energy"]),
                samples=None if stored["samples"] is None else int(stored["samples"]),
                seconds=float(stored["seconds"]),
                contrasts=tuple(_fractions(contrast) for contrast in stored["contrasts"]),
            )
        except (KeyError, TypeError, ZeroDivisionError) as error:
            raise ValueError(f"no sums of a capture: {error!r}") from error


def sums_of(
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    outside: NDArray[np.float64],
    samples: int,
    seconds: float,
    contrasts: NDArray[np.float64] | None = None,
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
    contrasts
        (contrast, bounce) of the energy, see ``engine.launch.energy_contrasts``; None: not known.
    """
    slots = range(mean.shape[1])
    noise, squares, energy = ([Fraction(0) for _ in slots] for _ in range(3))
    # Over the bins of one histogram numpy's order depends on their number alone; the sums over histograms are exact.
    for laser in range(mean.shape[2]):  # one at a time: squaring makes a copy
        part = mean[:, :, laser]
        of_rows = np.square(part).sum(axis=-1), variance[:, :, laser].sum(axis=-1), part.sum(axis=-1)
        for sums, values in zip((squares, noise, energy), of_rows, strict=True):
            for slot in slots:
                sums[slot] += exact_sum(values[:, slot])
    kept = () if contrasts is None else tuple(tuple(map(_rounded, row)) for row in contrasts.tolist())
    return Sums(tuple(noise), tuple(squares), exact_sum(outside), tuple(energy), samples, seconds, kept)


def exact_sum(values: NDArray[np.float64] | Sequence[float]) -> Fraction:
    """Return the sum of finite float64 numbers without any rounding: ``math.fsum`` rounds once, the rest is summed on.

    Raises
    ------
    OverflowError, ValueError
        A number, or the sum, is not finite in float64.
    """
    rest, total = np.ravel(values).tolist(), Fraction(0)
    while part := math.fsum(rest):
        total += Fraction(part)
        rest.append(-part)
    return total


def _relative_error(noise: Fraction, squares: Fraction) -> float:
    return relative_l2_error(float(noise), float(squares)) if squares else math.nan


def _root_mean_square(values: Sequence[Fraction]) -> float:
    if not values:
        return math.nan
    root = math.hypot(*map(float, values)) / math.sqrt(len(values))
    return float(f"{root:.{STATED_DIGITS}g}")


def _added(one: Sequence[Fraction], other: Sequence[Fraction]) -> tuple[Fraction, ...]:
    return tuple(a + b for a, b in zip_longest(one, other, fillvalue=Fraction(0)))


def _rounded(value: float) -> Fraction:
    mantissa, exponent = math.frexp(value)
    return Fraction(round(mantissa * 2**CONTRAST_BITS)) * Fraction(2) ** (exponent - CONTRAST_BITS)


def _texts(sums: Sequence[Fraction]) -> list[str]:
    return [str(value) for value in sums]


def _fractions(stored: Sequence[str]) -> tuple[Fraction, ...]:
    if isinstance(stored, str):
        raise TypeError(f"got {stored!r}, need one number per bounce slot")
    return tuple(Fraction(value) for value in stored)
