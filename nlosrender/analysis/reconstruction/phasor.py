"""Phasor fields: the image a virtual camera would take of the hidden scene, lit by a virtual pulse from the wall.

Liu et al. 2019, Eq. 6 and 7, as a confocal camera: illumination and detection are both focused on the voxel v and the
field is taken at the moment at which the pulse is there,

    I(v) = | sum_k P_k sum_l exp(i k |v - l|) / |v - l|  sum_s exp(i k |v - s|) / |v - s|  H_k(l, s) |

with H_k the histograms' spectra and P_k the pulse's. Confocal captures have l = s and one factor exp(2 i k r) / r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.reconstruction.lattice import Lattice, lattice_of
from nlosrender.analysis.reconstruction.propagation import Complex64, Propagator
from nlosrender.analysis.reconstruction.pulse import Pulse
from nlosrender.analysis.reconstruction.spectrum import spectra, unambiguous_period
from nlosrender.analysis.reconstruction.threads import in_threads, portion
from nlosrender.analysis.reconstruction.voxel_grid import VoxelGrid
from nlosrender.errors import FileError, OptionError
from nlosrender.files.layout import Float64
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.scan import Scan, light_bands
from nlosrender.rendering.render_report import Progress

SPECTRA_BYTES = 2**29  # of the laser points that are propagated together, sharing the kernels
MAX_WAVENUMBERS = 20_000  # their spectra at 64 x 64 points take 0.66 GB
MAX_LASERS_TOGETHER = 32  # that share the kernels, which are a small part of the work by then


def refuse_curved(scan: Scan) -> None:
    """Refuse walls that phasor fields by convolution cannot do.

    Raises
    ------
    FileError
        The points do not lie in a plane.
    """
    if not scan.planar:
        raise FileError(
            "the points do not lie in one plane along the wall (it is curved, or they are the pixels of a camera that "
            "sees several surfaces): phasor fields go from plane to plane. Use --method backprojection, which takes "
            "any points."
        )


def phasor_field(
    capture: StoredCapture,
    scan: Scan,
    grid: VoxelGrid,
    pulse: Pulse,
    bounces: tuple[int, ...],
    progress: Progress = lambda share: None,
) -> Complex64:
    """Return the field at every voxel (z, y, x) at the moment the pulse is there.

    Raises
    ------
    FileError
        The wall is curved, the grid irregular, or the file damaged.
    OptionError
        The wavelength is too short for the volume.
    """
    refuse_curved(scan)
    camera = _Camera(capture, scan, grid, pulse, bounces, _wavenumbers(scan, grid, pulse), lattice_of(scan.sensors))
    lasers = [(0, 0)] if scan.confocal else list(np.ndindex(*scan.lasers.shape[:2]))
    fitting = SPECTRA_BYTES // (8 * len(camera.wavenumbers) * camera.lattice.x.count * camera.lattice.y.count)
    together = min(max(fitting, 1), MAX_LASERS_TOGETHER)
    total = np.zeros(grid.shape, dtype=np.complex64)
    for start in range(0, len(lasers), together):
        chosen = lasers[start : start + together]
        camera.expose(total, chosen, portion(progress, start / len(lasers), len(chosen) / len(lasers)))
    return total


def _wavenumbers(scan: Scan, grid: VoxelGrid, pulse: Pulse) -> Float64:
    period = unambiguous_period(scan, grid.bounds, pulse)
    expected = period / pulse.half_length  # of either half of the band
    if not expected < MAX_WAVENUMBERS / 2:
        raise OptionError(
            f"--wavelength: {pulse.wavelength:.3g} m is too short for path lengths that differ by {period:.3g} m over "
            f"the volume: {2 * expected:.3g} wavenumbers, need at most {MAX_WAVENUMBERS}. Take a longer one, more "
            "cycles or a smaller volume."
        )
    return pulse.wavenumbers(period)


@dataclass(frozen=True, eq=False)
class _Camera:
    """What the field of a few laser points is computed from."""

    capture: StoredCapture
    scan: Scan
    grid: VoxelGrid
    pulse: Pulse
    bounces: tuple[int, ...]
    wavenumbers: Float64
    lattice: Lattice

    def expose(self, total: Complex64, lasers: list[tuple[int, int]], progress: Progress) -> None:
        """Add the field of some laser points to ``total``."""
        scan, grid, wavenumbers = self.scan, self.grid, self.wavenumbers
        spectra_at_points = self._spectra(lasers)
        propagator = Propagator(self.lattice, grid.x, grid.y, ways=2 if scan.confocal else 1)

        def plane(number: int) -> None:
            z = float(grid.z[number])
            if scan.confocal:  # each sensor point is its own laser
                total[number] = propagator.summed_field(spectra_at_points, wavenumbers, z)[0]
                return
            lighting = _Lighting(np.array([scan.lasers[laser] for laser in lasers]), grid, z, wavenumbers)
            for index, field in propagator.fields(spectra_at_points, wavenumbers, z):
                total[number] += lighting.at(index, field)

        in_threads(plane, len(grid.z), progress)

    def _spectra(self, lasers: list[tuple[int, int]]) -> Complex64:
        """Return (wavenumber, laser, Ny, Nx), points ascending."""
        found = np.empty((len(self.wavenumbers), len(lasers), *self.scan.sensors.shape[:2]), dtype=np.complex64)
        for number, laser in enumerate(lasers):
            for rows, light in light_bands(self.capture, laser, self.bounces):
                found[:, number, rows] = spectra(
                    self.scan, light, rows, laser, self.grid.bounds, self.pulse, self.wavenumbers
                )
        return np.flip(found, axis=tuple(axis + 2 for axis in self.lattice.flips))


class _Lighting:
    """The way from the laser points to one plane of voxels, wavenumber after wavenumber."""

    def __init__(self, lasers: Float64, grid: VoxelGrid, z: float, wavenumbers: Float64):
        dx = grid.x - lasers[:, 0, None]
        dy = grid.y - lasers[:, 1, None]
        dz = z - lasers[:, 2]
        distance = np.sqrt(dx[:, None, :] ** 2 + dy[:, :, None] ** 2 + dz[:, None, None] ** 2)
        step = wavenumbers[1] - wavenumbers[0] if len(wavenumbers) > 1 else 0.0
        self._current = (np.exp(1j * wavenumbers[0] * distance) / distance).astype(np.complex64)
        self._advance = np.exp(1j * step * distance).astype(np.complex64)
        self._index = 0

    def at(self, index: int, field: NDArray[np.complex64]) -> Complex64:
        """Return the sum over lasers of ``field`` (laser, y, x) times this factor; ``index`` never descends."""
        while self._index < index:
            self._current *= self._advance
            self._index += 1
        return np.einsum("lyx,lyx->yx", self._current, field)
