"""Filtered backprojection: every histogram smeared over the voxels its light may come from, then sharpened.

Velten et al. 2012 (Recovering three-dimensional shape around a corner using ultrafast time-of-flight imaging, Nature
Communications 3): a voxel collects H(l, s) at the path length l -> voxel -> s from all pairs, and the sum is filtered
with a Laplacian; here with that of a Gaussian, whose width keeps noise down. Any relay wall will do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from nlosrender.analysis.reconstruction.spectrum import path_lengths
from nlosrender.analysis.reconstruction.threads import in_threads, portion
from nlosrender.analysis.reconstruction.voxel_grid import VoxelGrid
from nlosrender.files.layout import Float64
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.scan import Float32, Scan, light_bands
from nlosrender.rendering.render_report import Progress

SAMPLES_PER_BIN = 4  # of the interpolated histograms; the nearest is taken, at most 1/8 bin off
SLAB_VOXELS = 2**16  # voxels at a time: their distances stay in the cache


def backproject(
    capture: StoredCapture,
    scan: Scan,
    grid: VoxelGrid,
    bounces: tuple[int, ...],
    progress: Progress = lambda share: None,
) -> Float32:
    """Return the sum over all pairs of H at the voxel's path length, (z, y, x).

    H counts per metre of optical path, linear between the middles of bins; light from outside the window is zero.

    Raises
    ------
    FileError
        The file is damaged.
    """
    total = np.zeros(grid.shape, dtype=np.float32)
    lasers = [(0, 0)] if scan.confocal else list(np.ndindex(*scan.lasers.shape[:2]))
    done, row = 0.0, 1 / (len(lasers) * len(scan.sensors))  # share of the work
    for laser in lasers:
        for rows, light in light_bands(capture, laser, bounces):
            share = (rows.stop - rows.start) * row
            _add_band(total, scan, grid, light, rows, laser, portion(progress, done, share))
            done += share
    return total


def laplacian_filtered(volume: Float32, voxel_size: float, sigma: float) -> Float32:
    """Return minus the Laplacian of a Gaussian of standard deviation ``sigma`` [m] of a volume, its negative part 0."""
    sharpened = -ndimage.gaussian_laplace(volume, sigma / voxel_size, mode="nearest")
    return np.maximum(sharpened, 0, out=sharpened)


def _add_band(
    total: Float32, scan: Scan, grid: VoxelGrid, light: Float32, rows: slice, laser: tuple[int, int], progress: Progress
) -> None:
    sensors = scan.sensors[rows].reshape(-1, 3)
    legs = scan.sensor_legs[rows] + (scan.laser_legs[rows] if scan.confocal else scan.laser_legs[laser])
    near, far = (length[rows] + legs for length in path_lengths(scan, grid.bounds, laser))
    width, centres = scan.bin_width_opl, scan.bin_centres()
    first, last = np.searchsorted(centres, [near.min() - width, far.max() + width])
    if first == last:
        return
    fine = _interpolated(light[..., first:last].reshape(len(sensors), -1)) / np.float32(width)
    scale = SAMPLES_PER_BIN / width  # samples per metre
    starts = (legs.ravel() - centres[first]) * scale + SAMPLES_PER_BIN  # of path length 0; zeros come first
    planes = max(SLAB_VOXELS // (len(grid.y) * len(grid.x)), 1)

    def slab(number: int) -> None:
        """Add the sum over sensor points for some planes of voxels."""
        part = slice(number * planes, (number + 1) * planes)
        z, single = grid.z[part], np.float32
        light = np.zeros((len(z), len(grid.y), len(grid.x)), dtype=single)
        samples, own = np.empty(light.shape, dtype=np.intp), np.empty_like(light)
        to_laser = 0.0 if scan.confocal else _distances(grid, z, scan.lasers[laser]) * single(scale)
        factor = single(2 * scale if scan.confocal else scale)
        for sensor, histogram, start in zip(sensors, fine, starts, strict=True):
            place = _distances(grid, z, sensor)
            place *= factor
            place += to_laser
            place += single(start + 0.5)
            np.copyto(samples, place, casting="unsafe")
            np.take(histogram, samples, out=own, mode="clip")  # both ends are zeros
            light += own
        total[part] += light

    in_threads(slab, -(-len(grid.z) // planes), progress)


def _distances(grid: VoxelGrid, z: Float64, point: Float64) -> Float32:
    """Return distances (z, y, x) of the voxels from a point [m]."""
    dx, dy, dz = (((axis - at) ** 2).astype(np.float32) for axis, at in zip((grid.x, grid.y, z), point, strict=True))
    squares = dz[:, None, None] + (dy[:, None] + dx)
    return np.sqrt(squares, out=squares)


def _interpolated(light: Float32) -> NDArray[np.float32]:
    """Interpolate histograms (row, bin) linearly to SAMPLES_PER_BIN samples per bin, with zeros before and after."""
    padded = np.pad(light, ((0, 0), (1, 1)))
    steps = np.arange(SAMPLES_PER_BIN, dtype=np.float32) / SAMPLES_PER_BIN
    between = padded[:, :-1, None] * (1 - steps) + padded[:, 1:, None] * steps
    return np.pad(between.reshape(len(light), -1), ((0, 0), (0, 1)))
