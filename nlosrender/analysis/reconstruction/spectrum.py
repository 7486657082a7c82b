"""Histograms -> their spectra at the pulse's wavenumbers, legs taken off, light from outside the volume left out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.reconstruction.pulse import Pulse
from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Float32, Scan
from nlosrender.scene.bounding_box import Bounds, box_corners

Complex64 = NDArray[np.complex64]


def path_lengths(scan: Scan, box: Bounds, laser: tuple[int, int]) -> tuple[Float64, Float64]:
    """Return bounds (Ny, Nx) on laser point -> voxel -> sensor point over all voxels of a box [m]."""
    near, far = _distances(scan.sensors, box)
    if scan.confocal:
        return 2 * near, 2 * far
    laser_near, laser_far = _distances(scan.lasers[laser], box)
    return near + laser_near, far + laser_far


def unambiguous_period(scan: Scan, box: Bounds, pulse: Pulse) -> float:
    """Return the period [m] of discrete spectra within which no light can wrap around onto a voxel it did not meet.

    Light is kept when it can reach any voxel, so it misses one by the spread of path lengths at most; the pulse adds
    its half length twice, once for light kept because of it and once for its own reach.
    """
    near, far = _distances(scan.sensors, box)
    spread = float((far - near).max())
    if scan.confocal:
        spread *= 2
    else:
        near, far = _distances(scan.lasers, box)
        spread += float((far - near).max())
    return spread + 2 * pulse.half_length


def spectra(
    scan: Scan, light: Float32, rows: slice, laser: tuple[int, int], box: Bounds, pulse: Pulse, wavenumbers: Float64
) -> Complex64:
    """Return sum_i H_i exp(-i k (t_i - legs)) of some rows of sensor points, weighted with the pulse's spectrum.

    Parameters
    ----------
    light, rows, laser
        (row, Nx, bin) histograms of some rows of the sensor grid, of one laser point; (0, 0) for confocal captures.
    box
        Of the volume; light that no voxel in it can send is left out.
    wavenumbers
        (n,) [rad/m].

    Returns
    -------
    NDArray
        (n, row, Nx).
    """
    centres = scan.bin_centres()
    legs = scan.sensor_legs[rows] + (scan.laser_legs[rows] if scan.confocal else scan.laser_legs[laser])
    near, far = (length[rows] + legs for length in path_lengths(scan, box, laser))
    reach = pulse.half_length
    first, last = np.searchsorted(centres, [near.min() - reach, far.max() + reach])
    kept = centres[first:last]
    seen = (kept >= near[..., None] - reach) & (kept <= far[..., None] + reach)
    windowed = np.where(seen, light[..., first:last], np.float32(0)).reshape(legs.size, len(kept))
    # float64: hundreds of periods; a common offset keeps the numbers small
    offset = float(kept[0]) if len(kept) else 0.0
    phase = np.outer(kept - offset, wavenumbers)
    found = np.empty((len(windowed), len(wavenumbers)), dtype=np.complex64)
    found.real = windowed @ np.cos(phase).astype(np.float32)
    found.imag = -(windowed @ np.sin(phase).astype(np.float32))
    legs_phase = np.exp(1j * np.outer(wavenumbers, legs.ravel() - offset)) * pulse.weights(wavenumbers)[:, None]
    return (found.T * legs_phase.astype(np.complex64)).reshape(len(wavenumbers), *legs.shape)


def _distances(points: Float64, box: Bounds) -> tuple[Float64, Float64]:
    """Return the shortest and longest distance (...) from points (..., 3) to a box [m]."""
    outside = np.maximum(np.maximum(box[0] - points, points - box[1]), 0)
    corners = np.linalg.norm(points[..., None, :] - box_corners(box), axis=-1)
    return np.linalg.norm(outside, axis=-1), corners.max(axis=-1)
