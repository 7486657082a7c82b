"""The virtual illumination of phasor fields: a wave of one wavelength under a Gaussian envelope.

Liu et al. 2019 (Non-line-of-sight imaging using phasor-field virtual wave optics, Nature 572), Eq. 5:
P(t) = exp(i k0 t) exp(-t^2 / (2 sigma^2)), with t in metres of optical path and k0 = 2 pi / wavelength.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from nlosrender.errors import OptionError
from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Scan
from nlosrender.scene.bounding_box import Bounds

DEFAULT_CYCLES = 5.0
CUTOFF = 3.0  # standard deviations at which the pulse is cut, in time and in frequency: exp(-9 / 2) = 1.1 % there
MIN_BINS = 4  # bins in a default wavelength: a box that long passes 90 % of it


@dataclass(frozen=True)
class Pulse:
    """A virtual pulse.

    Raises
    ------
    OptionError
        A parameter is not a positive number.
    """

    wavelength: float  # of the carrier [m]
    cycles: float = DEFAULT_CYCLES  # wavelengths within ``CUTOFF`` standard deviations of the envelope on both sides

    def __post_init__(self) -> None:
        for name in ("wavelength", "cycles"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise OptionError(f"--{name}: got {value:g}, need a number > 0{' [m]' if name == 'wavelength' else ''}")

    @property
    def sigma(self) -> float:
        """Standard deviation of the envelope [m of optical path]."""
        return self.cycles * self.wavelength / (2 * CUTOFF)

    @property
    def half_length(self) -> float:
        """Half of what is kept of the pulse [m of optical path]."""
        return CUTOFF * self.sigma

    def wavenumbers(self, period: float) -> Float64:
        """Return wavenumbers (n,) [rad/m] over the pulse's band, dense enough for signals of length ``period`` [m]."""
        center, half = 2 * np.pi / self.wavelength, CUTOFF / self.sigma
        step = 2 * np.pi / period
        low = max(center - half, step)
        return low + step * np.arange(int(np.ceil((center + half - low) / step)) + 1, dtype=np.float64)

    def weights(self, wavenumbers: Float64) -> Float64:
        """Return the pulse's spectrum at ``wavenumbers``, 1 at the carrier."""
        offset = (wavenumbers - 2 * np.pi / self.wavelength) * self.sigma
        return np.exp(-(offset**2) / 2)


def sampling_limit(scan: Scan, box: Bounds | None) -> float:
    """Return the shortest wavelength [m] whose ghosts (grating lobes) stay out of a box.

    A point's ghost appears where the way from neighbouring sensor points, ``spacing`` apart, differs from the way to
    the point by a whole wavelength: ways * spacing * (difference of the sines) = wavelength. The box bounds the sines;
    without one, or before a curved wall, they lie between -1 and 1. Confocal captures go both ways.
    """
    limit = 0.0
    for axis, spacing in enumerate(_spacings(scan)):
        spread = 2.0
        if box is not None and scan.planar:
            (low, high), depth = (box[0][axis], box[1][axis]), float(box[0][2])
            ends = scan.sensors[..., axis].min(), scan.sensors[..., axis].max()
            seen_from = np.clip((low + high) / 2, *ends)  # where the box takes up the widest angle
            sines = [(end - seen_from) / np.hypot(end - seen_from, depth) for end in (low, high)]
            spread = float(sines[1] - sines[0])
        limit = max(limit, (2 if scan.confocal else 1) * spacing * spread)
    return limit


def default_wavelength(scan: Scan, box: Bounds | None) -> float:
    """Return the shortest wavelength for what is in a box that neither the sensor grid nor the bins alias [m].

    No shorter than two spacings: a flat object is a mirror to waves, and shows its edges only, if they are short.
    """
    return max(sampling_limit(scan, box), 2 * max(_spacings(scan)), MIN_BINS * scan.bin_width_opl)


def pulse_warnings(scan: Scan, pulse: Pulse, box: Bounds) -> list[str]:
    """Return what is wrong with the wavelength for this capture and volume, in words."""
    warnings = []
    limit, bins = sampling_limit(scan, box), MIN_BINS * scan.bin_width_opl
    if pulse.wavelength < limit * (1 - 1e-6):
        warnings.append(
            f"a wavelength of {1000 * pulse.wavelength:.3g} mm is too short for sensor points "
            f"{1000 * max(_spacings(scan)):.3g} mm apart: ghosts (aliasing) can appear in this volume. "
            f"Take --wavelength {limit:.3g} or longer, or a denser sensor grid."
        )
    if pulse.wavelength < bins * (1 - 1e-6):
        warnings.append(
            f"a wavelength of {1000 * pulse.wavelength:.3g} mm is less than {MIN_BINS} bins of "
            f"{1000 * scan.bin_width_opl:.3g} mm: the bins blur it away. Take --wavelength {bins:.3g} or longer, or "
            "narrower bins."
        )
    return warnings


def _spacings(scan: Scan) -> tuple[float, float]:
    """Return the distance between neighbouring sensor points along columns (x) and rows (y) [m]; 0 for a single one.

    Of a list it is that to the second nearest point, in both directions: on a grid and on a curve that is the spacing.
    """
    if scan.has_sensor_list:
        points = scan.sensors.reshape(-1, 3)
        apart = cKDTree(points).query(points, k=[min(3, len(points))])[0]  # the first is the point itself
        return float(np.median(apart)), float(np.median(apart))
    steps = [np.linalg.norm(np.diff(scan.sensors, axis=axis), axis=-1) for axis in (1, 0)]
    along_x, along_y = (float(np.median(step)) if step.size else 0.0 for step in steps)
    return along_x, along_y
