"""Rectification: legs taken off the time axis, so that bin 0 is the moment at which light is at the wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Float32, Scan


@dataclass(frozen=True, eq=False)
class Rectification:
    """How far the histograms of a capture are moved.

    Each bin is shared by the two that it covers: energy is kept, and light before 0 is not expected on a plane.

    Attributes
    ----------
    n_bins
        As many as reach the last light of the whole capture.
    """

    shift: Float64  # bins, (Ny, Nx) of the sensor points: from start and sensor leg
    laser_shift: Float64  # bins, (Ly, Lx); added to it. Zero for a confocal capture, whose two legs are in ``shift``
    n_bins: int

    @property
    def is_identity(self) -> bool:
        """Whether nothing moves."""
        return not self.shift.any() and not self.laser_shift.any()

    def apply(self, light: Float32, rows: slice, laser: tuple[int, int] = (0, 0)) -> Float32:
        """Return (row, Nx, n_bins): histograms (row, Nx, bin) of some rows of sensor points, moved."""
        if self.is_identity:
            return light
        shift = self.shift[rows] + self.laser_shift[laser]
        whole = np.floor(shift).astype(int)
        later = (shift - whole).astype(np.float32)[..., None]
        moved = np.zeros((*light.shape[:2], self.n_bins), dtype=np.float32)
        for row, column in np.ndindex(*light.shape[:2]):
            if not light[row, column].any():
                continue
            for share, start in ((1 - later, whole), (later, whole + 1)):
                first = int(start[row, column])
                part = light[row, column, max(-first, 0) :] * share[row, column]
                begin = max(first, 0)
                length = max(min(len(part), self.n_bins - begin), 0)
                moved[row, column, begin : begin + length] += part[:length]
        return moved


def rectification(scan: Scan) -> Rectification:
    """Return how to count the time of a capture from the wall."""
    if scan.confocal:
        shift, laser_shift = scan.start_opl - (scan.sensor_legs + scan.laser_legs), np.zeros((1, 1))
    elif scan.laser_legs.size == 1:
        shift, laser_shift = scan.start_opl - (scan.sensor_legs + scan.laser_legs[0, 0]), np.zeros((1, 1))
    else:
        shift, laser_shift = scan.start_opl - scan.sensor_legs, -scan.laser_legs
    in_bins, laser_in_bins = shift / scan.bin_width_opl, laser_shift / scan.bin_width_opl
    latest = in_bins.max() + laser_in_bins.max()
    moves = bool(in_bins.any() or laser_in_bins.any())
    n_bins = max(scan.n_bins + int(np.floor(latest)) + 1, 1) if moves else scan.n_bins
    return Rectification(in_bins, laser_in_bins, n_bins)
