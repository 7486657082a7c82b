"""The time response of laser pulse and detector: how the photons of one moment spread over time.

What is integrated over bins needs only the second integral G of the response, the integral of its distribution function
from the left up to x: of light that is uniform over a source bin [s, s + w] the share

    (G(b - s) - G(b - s - w) - G(a - s) + G(a - s - w)) / w

arrives in [a, b], whatever the widths. Right of the response G(x) = x - mean: area and first moment are kept to
rounding. Delays are metres of optical path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, ndtr, ndtri

Float64 = NDArray[np.float64]
FWHM_OF_SIGMA = 2 * math.sqrt(2 * math.log(2))  # of a Gaussian
CUT = 1e-12  # share of the light beyond either end of the table: below one photon of any exposure
OUTSIDE_SPREAD = 1e-3  # share of the light
# Cells per standard deviation or decay length. A density that is constant in cells of width h has h^2 / 12 too much
# variance: 1e-5 of a Gaussian's, 5e-6 of its width.
CELLS_PER_WIDTH = 100
LONGEST_TABLE = 2**22  # cells: a tail 10^4 times as long as the Gaussian is wide


@dataclass(frozen=True, eq=False)
class Response:
    """A density over delays, constant in cells of one width; no cells: everything arrives at delay 0."""

    shares: Float64  # (cells,) of the light, they add up to 1
    cell: float  # m
    start: float  # m, where the first cell begins
    zero: float  # m, what of the response is delay 0, in the coordinate of ``start``

    @property
    def support(self) -> tuple[float, float]:
        """First and last delay [m]."""
        return self.start - self.zero, self.start - self.zero + len(self.shares) * self.cell

    @property
    def spread(self) -> float:
        """Time between which all but ``OUTSIDE_SPREAD`` of the light arrives [m]."""
        if not len(self.shares):
            return 0.0
        first, last = np.searchsorted(np.cumsum(self.shares), [OUTSIDE_SPREAD / 2, 1 - OUTSIDE_SPREAD / 2])
        return float(last - first + 1) * self.cell

    @property
    def mean_delay(self) -> float:
        """By how much the response moves the light's first moment [m]."""
        return _mean(self.shares, self.cell, self.start) - self.zero if len(self.shares) else 0.0

    @property
    def fwhm(self) -> float:
        """Full width at half maximum [m]: between the first and the last crossing, linear in between."""
        if not len(self.shares):
            return 0.0
        level = np.concatenate([[0.0], self.shares, [0.0]]) / self.shares.max() - 0.5
        above = np.flatnonzero(level >= 0)
        first, last = above[0], above[-1]
        left = first - level[first] / (level[first] - level[first - 1])
        right = last + level[last] / (level[last] - level[last + 1])
        return float(right - left) * self.cell

    def second_integral(self, delay: Float64) -> Float64:
        """Return G of delays [m], in m."""
        if not len(self.shares):
            return np.maximum(delay, 0.0)
        x = (np.asarray(delay, dtype=np.float64) + (self.zero - self.start)) / self.cell
        n = len(self.shares)
        distribution = np.concatenate([[0.0], np.cumsum(self.shares)])
        integral = np.concatenate([[0.0], np.cumsum((distribution[:-1] + distribution[1:]) / 2)])
        at = np.clip(x.astype(np.int64), 0, n - 1)
        within = np.clip(x - at, 0.0, 1.0)
        value = integral[at] + within * (distribution[at] + within * self.shares[at] / 2)
        return self.cell * np.where(x >= n, integral[-1] + (x - n) * distribution[-1], value)

    def density(self, delay: Float64) -> Float64:
        """Return the density at delays [m], per metre; for drawing."""
        if not len(self.shares):
            return np.zeros_like(delay)
        at = np.floor((np.asarray(delay) + self.zero - self.start) / self.cell).astype(np.int64)
        return (
            np.where((at >= 0) & (at < len(self.shares)), self.shares[at.clip(0, len(self.shares) - 1)], 0) / self.cell
        )


def parametric_response(sigma: float, tail: float = 0.0, tail_share: float = 0.0, zero_delay: str = "peak") -> Response:
    """Return a Gaussian with an exponential tail.

    Parameters
    ----------
    sigma
        Standard deviation of laser pulse and jitter together [m]: independent ones add in quadrature.
    tail, tail_share
        Decay length [m], and share of the light that it delays: an exponentially modified Gaussian.
    zero_delay
        Which delay is 0: that of the ``peak`` or the ``mean``.

    Raises
    ------
    ValueError
        The tail is so much longer than the Gaussian that the table would not fit the memory.
    """
    tail = tail if tail_share else 0.0
    widths = [width for width in (sigma, tail) if width > 0]
    if not widths:
        return Response(np.zeros(0), 1.0, 0.0, 0.0)
    cell, reach = min(widths) / CELLS_PER_WIDTH, -float(ndtri(CUT)) * sigma
    cells = math.ceil((2 * reach - math.log(CUT) * tail) / cell)
    if cells > LONGEST_TABLE:
        raise ValueError(f"a tail of {tail:g} m is too long beside a Gaussian of {sigma:g} m standard deviation")
    nodes = np.arange(cells + 1, dtype=np.float64) * cell - reach
    distribution = ndtr(nodes / sigma) if sigma else (nodes > 0).astype(np.float64)
    if tail:
        distribution -= tail_share * tail * _modified_density(nodes, sigma, tail)
    return _normalised(np.diff(distribution), cell, -reach, zero_delay)


def measured_response(light: Float64, cell: float, sigma: float = 0.0, zero_delay: str = "peak") -> Response:
    """Return a measured curve, spread by a Gaussian of standard deviation ``sigma`` [m].

    Parameters
    ----------
    light, cell
        (cells,) light per cell, cells of one width [m].

    Raises
    ------
    ValueError
        There is no light, less than none, or some that is not finite; or the table would not fit the memory.
    """
    light = np.asarray(light, dtype=np.float64).ravel()
    if not len(light) or not np.isfinite(light).all() or light.min() < 0 or light.sum() <= 0:
        bad = [value for value in light.tolist() if not (math.isfinite(value) and value >= 0)]
        raise ValueError(f"holds {bad[0]}" if bad else "holds no light")
    finer = math.ceil(cell * CELLS_PER_WIDTH / sigma) if sigma else 1
    if len(light) * finer > LONGEST_TABLE:
        raise ValueError(f"has {len(light)} cells, too many beside a pulse of {sigma:g} m standard deviation")
    shares, cell = np.repeat(light, finer), cell / finer
    reach = math.ceil(-float(ndtri(CUT)) * sigma / cell)
    if sigma:
        edges = (np.arange(2 * reach + 2) - reach - 0.5) * cell
        shares = np.maximum(convolved(shares, np.diff(ndtr(edges / sigma))), 0.0)
    return _normalised(shares, cell, -reach * cell, zero_delay)


def convolved(values: Float64, kernel: Float64) -> Float64:
    """Return the convolution of values (n, ...) along their first axis with a kernel (m,), (n + m - 1, ...)."""
    length = len(values) + len(kernel) - 1
    size = 2 ** math.ceil(math.log2(length))
    spectrum = np.fft.rfft(kernel, size).reshape(-1, *[1] * (values.ndim - 1))
    return np.fft.irfft(spectrum * np.fft.rfft(values, size, axis=0), size, axis=0)[:length]


def _normalised(shares: Float64, cell: float, start: float, zero_delay: str) -> Response:
    shares = np.maximum(shares, 0.0) / shares.sum()
    if zero_delay == "mean":
        return Response(shares, cell, start, _mean(shares, cell, start))
    at = int(np.argmax(shares))
    left, top, right = np.pad(shares, 1)[at : at + 3]
    vertex = (
        0.5 * (left - right) / (left - 2 * top + right)
    )  # of the parabola through the highest cell and its neighbours
    return Response(shares, cell, start, start + (at + 0.5 + vertex) * cell)


def _mean(shares: Float64, cell: float, start: float) -> float:
    return start + cell * float((np.arange(len(shares)) + 0.5) @ shares)


def _modified_density(x: Float64, sigma: float, tail: float) -> Float64:
    """Return the density of a Gaussian delayed by an exponential (Grushka 1972), per metre.

    Its distribution function is the Gaussian's less tail x this density.
    """
    if not sigma:
        return np.where(x > 0, np.exp(-np.maximum(x, 0) / tail), 0.0) / tail
    z = (sigma / tail - x / sigma) / math.sqrt(2)
    # erfcx(z) = exp(z^2) erfc(z) overflows left of z = -26, where erfc is 2
    early = np.exp(-((x / sigma) ** 2) / 2) * erfcx(np.maximum(z, -20))
    late = 2 * np.exp(np.minimum((sigma / tail) ** 2 / 2 - x / tail, 700))
    return np.where(z > -20, early, late) / (2 * tail)
