"""The shift in time between two captures, from the cross-correlation of their histograms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.blocks import Block
from nlosrender.files.reading.stored_header import StoredHeader

Complex = NDArray[np.complex128]
ROUND_DIGITS = 6  # of a shift in bins: float32 spectra leave no more
MIN_SHARE = 1e-6  # of the brightest laser's light: below it a peak is not worth finding


class TimeShift:
    """Cross-correlations over time, summed over the sensor points of each laser.

    The histograms of the single sensor points are correlated, bounces and colours summed, and not their sum over the
    wall: that is blurred by the spread of the path lengths, while the correlations peak at a common shift.
    """

    def __init__(self, header: StoredHeader):
        self.n_bins = header.n_bins
        least = 2 * header.n_bins  # room for every shift: no light wraps around
        # of an even length with small prime factors, which FFTs like, at most a quarter longer than needed
        self._length = min(odd << max((-(-least // odd) - 1).bit_length(), 1) for odd in (1, 3, 5))
        self._whole: Complex = np.zeros(self._length // 2 + 1, np.complex128)
        self._current: Complex = np.zeros_like(self._whole)  # of one laser: a spectrum for each could fill the memory
        self._laser: tuple[int, int] | None = None
        self._light = 0.0
        self._shifts: list[tuple[float, tuple[int, int], float]] = []  # shift, laser, light

    def add(self, block: Block) -> None:
        """Take one block into the correlations; the blocks of a laser come one after the other."""
        if block.laser != self._laser:
            self._finish_laser()
            self._laser = block.laser
        b = block.b.sum(axis=(0, 1))
        spectrum_b = np.fft.rfft(b, n=self._length)
        if np.array_equal(block.a, block.b):
            spectrum_a = spectrum_b
        else:
            spectrum_a = np.fft.rfft(block.a.sum(axis=(0, 1)), n=self._length)
        self._current += np.einsum("yxf,yxf->f", spectrum_a, spectrum_b.conj(), dtype=np.complex128)
        self._light += float(b.sum(dtype=np.float64))

    def whole(self) -> float | None:
        """Return the shift of a against b over the whole capture [bins], > 0 when a is later; None without light."""
        self._finish_laser()
        return self._peak(self._whole)

    def worst(self) -> tuple[float, tuple[int, int]] | None:
        """Return the shift of the laser point that is shifted most [bins], and that point; None without light."""
        self._finish_laser()
        least = MIN_SHARE * max((light for _, _, light in self._shifts), default=0.0)
        shifts = [(shift, laser) for shift, laser, light in self._shifts if light > least]
        return max(shifts, key=lambda found: abs(found[0]), default=None)

    def _finish_laser(self) -> None:
        shift = self._peak(self._current)
        if self._laser is not None and shift is not None:
            self._shifts.append((shift, self._laser, self._light))
        self._whole += self._current
        self._current[:] = 0
        self._light, self._laser = 0.0, None

    def _peak(self, spectrum: Complex) -> float | None:
        correlation = np.fft.irfft(spectrum, n=self._length)
        peak = int(np.argmax(correlation))
        if correlation[peak] <= 0:
            return None
        before, at, after = (float(correlation[(peak + step) % self._length]) for step in (-1, 0, 1))
        curvature = before - 2 * at + after
        # the parabola through the peak and its neighbours: Smith 2011, Spectral Audio Signal Processing, eq. (5.11)
        offset = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
        whole = peak if peak < self.n_bins else peak - self._length
        return round(whole + offset, ROUND_DIGITS)
