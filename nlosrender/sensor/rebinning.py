"""From the bins of a capture to those of a detector: response, gate and the laser's period in one linear map.

The map is a matrix over (detector bin, source bin) that is zero but for a band as wide as the response. It is kept, and
applied, in blocks of detector bins: the time is that of the band, not of the whole matrix.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nlosrender.sensor.response import Response

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
# Detector bins per block. The map of 512 bins by a response of 50: 64, 128 and 256 bins a block take 0.26, 0.23 and
# 0.31 s per 65,536 points on one core.
BLOCK_BINS = 128
NO_LIGHT = 1e-13  # shares of a source bin below it are rounding: without response equal bins are the identity


@dataclass(frozen=True)
class TimeBins:
    """Bins of one width, in metres of optical path."""

    start: float
    width: float
    count: int

    @property
    def end(self) -> float:
        """Where the last bin ends [m]."""
        return self.start + self.count * self.width

    @property
    def edges(self) -> Float64:
        """(count + 1,) where bins start and end [m]."""
        return np.arange(self.count + 1, dtype=np.float64) * self.width + self.start


@dataclass(frozen=True, eq=False)
class Rebinning:
    """The map from source bins to detector bins.

    Attributes
    ----------
    source, detector
        The bins.
    response
        What delays the light on its way.
    period
        From one laser pulse to the next [m]: later light is measured with the next pulse. Infinite: a single pulse.
    gate
        From when to when the detector is on [m].
    """

    source: TimeBins
    detector: TimeBins
    response: Response
    period: float = math.inf
    gate: tuple[float, float] = (-math.inf, math.inf)

    @cached_property
    def open_share(self) -> Float64:
        """(bins,) share of each detector bin in which the gate is open."""
        edges = np.clip(self.detector.edges, *self.gate)
        return np.diff(edges) / self.detector.width

    @cached_property
    def _blocks(self) -> list[tuple[slice, slice, Float32]]:
        """(detector bins, source bins, matrix), all that is not zero."""
        return [*self._all_blocks()]

    def _all_blocks(self) -> Iterator[tuple[slice, slice, Float32]]:
        source, edges = self.source, np.clip(self.detector.edges, *self.gate)
        low, high = self.response.support
        first, last = 0, 0
        if math.isfinite(self.period):  # pulses whose light arrives with this one
            first = math.floor((source.start + low - self.detector.end) / self.period)
            last = math.ceil((source.end + high - self.detector.start) / self.period)
        for begin in range(0, self.detector.count, BLOCK_BINS):
            bins = slice(begin, min(begin + BLOCK_BINS, self.detector.count))
            for pulse in range(first, last + 1):
                at = edges[bins.start : bins.stop + 1] + (pulse * self.period if pulse else 0.0)
                lowest = math.floor((at[0] - high - source.start) / source.width) - 1
                highest = math.ceil((at[-1] - low - source.start) / source.width) + 1
                rows = slice(max(lowest, 0), min(highest, source.count))
                if rows.start >= rows.stop:
                    continue
                # from the bin itself, not from path 0: a difference of large numbers would not be exactly 0
                begins = source.start + np.arange(rows.start, rows.stop + 1) * source.width
                twice = np.diff(np.diff(self.response.second_integral(at[:, None] - begins), axis=0), axis=1)
                shares = -twice / source.width
                shares[np.abs(shares) < NO_LIGHT] = 0.0
                if shares.any():
                    yield bins, rows, shares.astype(np.float32)

    def apply(self, light: Float32) -> Float32:
        """Return (detector bins, points) from the light of points, (source bins, points)."""
        rebinned = np.zeros((self.detector.count, light.shape[1]), np.float32)
        for bins, rows, shares in self._blocks:
            rebinned[bins] += shares @ light[rows]
        return rebinned

    def of_moment(self, opl: float) -> Float64:
        """Return the shares (bins,) of light of one moment, such as crosstalk."""
        moment = Rebinning(
            TimeBins(opl - self.detector.width / 2e6, self.detector.width / 1e6, 1),
            self.detector,
            self.response,
            self.period,
            self.gate,
        )
        return moment.apply(np.ones((1, 1), np.float32))[:, 0].astype(np.float64)
