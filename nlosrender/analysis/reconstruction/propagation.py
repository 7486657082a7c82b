"""Rayleigh-Sommerfeld propagation from the points of a lattice to a plane of voxels parallel to it, by FFT.

Liu, Bauer, Velten 2020 (Phasor field diffraction based reconstruction for fast non-line-of-sight imaging systems,
Nature Communications 11), Eq. 5: for one wavenumber k and one plane at distance z the field is the convolution

    U(v) = sum_s h(s) g(v - s),    g(d) = exp(i k |d|) / |d|,    |d|^2 = dx^2 + dy^2 + z^2.

The sum is over the measured points, exactly: the convolution is computed with zero padding, kernel samples in space.
Voxels need not lie on the points' lattice. The field is computed on a lattice m times as fine, one convolution for
each of the m^2 shifts of it against the points, and interpolated to the voxels: away from the wall it is band-limited,
its shortest period along the plane being the wavelength over the sine of the steepest angle. ``m`` follows from that,
plane by plane and wavenumber by wavenumber.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from nlosrender.analysis.reconstruction.lattice import (
    HALF_WIDTH,
    OVERSAMPLING,
    Axis,
    Lattice,
    covering,
    interpolation_matrix,
)
from nlosrender.errors import OptionError
from nlosrender.files.layout import Float64

Complex64 = NDArray[np.complex64]

MAX_FINE = 4096  # points of the fine lattice along an edge: 256 MiB for each array over it


@dataclass(frozen=True, eq=False)
class Refinement:
    """Everything that depends on the refinement m but not on wavenumber or depth; arrays over (shift y, shift x)."""

    factor: int
    squares: Float64  # (m, m, Ly, Lx) lateral distances squared of the kernel's samples [m^2]
    sizes: tuple[int, int]  # of the FFT
    valid: tuple[slice, slice]  # what of a convolution is the field
    to_y: NDArray[np.float32]  # (voxel row, fine row)
    to_x: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Propagator:
    """Propagates fields on ``lattice`` to the voxels of planes parallel to it."""

    lattice: Lattice  # of the points on the wall
    x: Float64  # of the voxels along the wall [m]
    y: Float64
    ways: int = 1  # times the distance counts in the phase; 2 for confocal captures: light goes forth and back
    refinements: dict[int, Refinement] = field(default_factory=dict)

    def fields(self, spectra: Complex64, wavenumbers: Float64, z: float) -> Iterator[tuple[int, Complex64]]:
        """Yield (index of the wavenumber, field (..., voxel y, voxel x)) in the plane at ``z`` [m].

        ``spectra`` (wavenumber, ..., Ny, Nx) at the lattice's points; ``wavenumbers`` [rad/m] ascend in equal steps.

        Raises
        ------
        OptionError
            The waves are too short for the lattice.
        """
        for refinement, index, kernel in self._kernels(wavenumbers, z):
            product = self._transformed(refinement, spectra[index]) * kernel
            yield index, self._to_voxels(refinement, product)

    def summed_field(self, spectra: Complex64, wavenumbers: Float64, z: float) -> Complex64:
        """Return the sum of ``fields`` over the wavenumbers; summing before transforming back halves the work."""
        total = np.zeros((*spectra.shape[1:-2], len(self.y), len(self.x)), dtype=np.complex64)
        pending: dict[int, Complex64] = {}
        for refinement, index, kernel in self._kernels(wavenumbers, z):
            product = self._transformed(refinement, spectra[index]) * kernel
            pending[refinement.factor] = pending.get(refinement.factor, 0) + product
        for factor, product in pending.items():
            total += self._to_voxels(self.refinements[factor], product)
        return total

    def _kernels(self, wavenumbers: Float64, z: float) -> Iterator[tuple[Refinement, int, Complex64]]:
        """Yield refinement, index of the wavenumber, and the FFT of its kernel (m, m, Ky, Kx)."""
        step = float(wavenumbers[1] - wavenumbers[0]) if len(wavenumbers) > 1 else 0.0
        depth = z - self.lattice.height
        factor, current, advance = 0, np.empty(0, np.complex64), np.empty(0, np.complex64)
        for index, wavenumber in enumerate(wavenumbers):
            needed = self._factor(wavenumber, depth)
            refinement = self._refinement(needed)
            if needed != factor:
                # float64: thousands of radians; from there on one wavenumber follows from the last by a factor
                distance = np.sqrt(refinement.squares + depth**2)
                current = (np.exp(1j * self.ways * wavenumber * distance) / distance).astype(np.complex64)
                advance = np.exp(1j * self.ways * step * distance).astype(np.complex64)
                factor = needed
            else:
                current *= advance
            yield refinement, index, fft.fft2(current, s=refinement.sizes)

    def _factor(self, wavenumber: float, depth: float) -> int:
        """Return how much finer than the points the lattice of the field has to be."""
        factor = 1
        for axis, voxels in ((self.lattice.x, self.x), (self.lattice.y, self.y)):
            ends = axis.coordinates()[[0, -1]]
            reach = max(abs(voxels[0] - ends[1]), abs(voxels[-1] - ends[0]))
            while True:
                fine = axis.step / factor
                # the phase is steepest where interpolation reaches farthest out; 1 / depth for the slope of 1/|d|
                out = reach + HALF_WIDTH * fine
                slope = self.ways * wavenumber * out / np.hypot(out, depth) + 1 / depth
                if fine * slope * OVERSAMPLING <= np.pi:
                    break
                factor += 1
        return factor

    def _refinement(self, factor: int) -> Refinement:
        if factor not in self.refinements:
            self.refinements[factor] = _refine(self.lattice, self.x, self.y, factor)
        return self.refinements[factor]

    @staticmethod
    def _transformed(refinement: Refinement, points: Complex64) -> Complex64:
        return fft.fft2(points, s=refinement.sizes)[..., None, None, :, :]

    @staticmethod
    def _to_voxels(refinement: Refinement, product: Complex64) -> Complex64:
        shifted = fft.ifft2(product)[(..., *refinement.valid)]  # (..., m, m, y, x)
        m, (rows, columns) = refinement.factor, shifted.shape[-2:]
        # real and imaginary part side by side: the matrices are real
        fine = np.empty((*shifted.shape[:-4], 2, rows, m, columns, m), dtype=np.float32)
        ordered = np.moveaxis(shifted, (-4, -3), (-3, -1))  # (..., y, m, x, m)
        fine[..., 0, :, :, :, :], fine[..., 1, :, :, :, :] = ordered.real, ordered.imag
        parts = refinement.to_y @ fine.reshape(*shifted.shape[:-4], 2, rows * m, columns * m) @ refinement.to_x.T
        voxels = np.empty((*parts.shape[:-3], *parts.shape[-2:]), dtype=np.complex64)
        voxels.real, voxels.imag = parts[..., 0, :, :], parts[..., 1, :, :]
        return voxels


def _refine(lattice: Lattice, x: Float64, y: Float64, factor: int) -> Refinement:
    finest = factor * max(lattice.x.count + np.ptp(x) / lattice.x.step, lattice.y.count + np.ptp(y) / lattice.y.step)
    if finest > MAX_FINE:
        raise OptionError(
            f"--wavelength: is too short for this volume: its waves would take a lattice of {finest:.3g} points on an "
            f"edge, need at most {MAX_FINE}. Take a longer one, or a smaller or farther volume."
        )
    ky, valid_y, to_y = _refine_axis(lattice.y, y, factor)
    kx, valid_x, to_x = _refine_axis(lattice.x, x, factor)
    squares = ky[:, None, :, None] ** 2 + kx[None, :, None, :] ** 2
    sizes = (fft.next_fast_len(ky.shape[1]), fft.next_fast_len(kx.shape[1]))
    return Refinement(factor, squares, sizes, (valid_y, valid_x), to_y, to_x)


def _refine_axis(axis: Axis, voxels: Float64, factor: int) -> tuple[Float64, slice, NDArray[np.float32]]:
    """Return kernel coordinates (shift, sample) [m], the valid part of a convolution, the way to the voxels."""
    fine = axis.step / factor
    start, stop = covering(voxels, axis.first, fine)
    first, last = start // factor, -(-stop // factor)  # in steps of the points: whole sets of shifts
    samples = np.arange(first - (axis.count - 1), last)
    kernel = (samples + np.arange(factor)[:, None] / factor) * axis.step
    matrix = interpolation_matrix(voxels, axis.first + first * axis.step, fine, (last - first) * factor)
    return kernel, slice(axis.count - 1, axis.count - 1 + last - first), matrix
