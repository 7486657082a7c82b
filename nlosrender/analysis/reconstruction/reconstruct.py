"""From a capture file to a volume: read, choose wavelength and voxels, compute."""

from __future__ import annotations

import time
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.analysis.reconstruction.backprojection import backproject, laplacian_filtered
from nlosrender.analysis.reconstruction.phasor import phasor_field, refuse_curved
from nlosrender.analysis.reconstruction.pulse import DEFAULT_CYCLES, Pulse, default_wavelength, pulse_warnings
from nlosrender.analysis.reconstruction.voxel_grid import VoxelGrid, expected_box, voxel_grid
from nlosrender.config.fields import MAX_LENGTH
from nlosrender.errors import FileError, OptionError
from nlosrender.files.layout import Float64
from nlosrender.files.measured import few_counts
from nlosrender.files.reading.reader import open_capture
from nlosrender.files.reading.scan import Float32, chosen_bounces, read_scan
from nlosrender.rendering.render_report import Progress, Warn, Warnings

if TYPE_CHECKING:
    from nlosrender.analysis.drawn_picture import Picture
    from nlosrender.analysis.reconstruction.score import Score

METHODS = ("phasor", "backprojection")
FILTER_WAVELENGTHS = 1 / 8  # width of the backprojection's filter: about the depth resolution of phasor fields
SEPARATOR = "  ·  "  # between parts of ``settings_text``
MIN_FILTER_VOXELS = 1.0  # width of the filter at least, or it responds to single voxels


@dataclass(frozen=True)
class ReconstructionSettings:
    """How to reconstruct; None: chosen from the capture.

    Raises
    ------
    OptionError
        A value is out of range, or two contradict each other.
    """

    method: str = "phasor"
    wavelength: float | None = None  # m
    cycles: float = DEFAULT_CYCLES
    volume_center: tuple[float, ...] | None = None  # (3,) m, wall's frame
    volume_size: tuple[float, ...] | None = None  # (1,) or (3,) m
    voxels: int | None = None  # along the longest edge
    voxel_size: float | None = None  # m
    bounces: str | None = None  # 3 or all

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise OptionError(f"--method: got {self.method!r}, need one of {', '.join(METHODS)}")
        if self.bounces not in (None, "3", "all"):
            raise OptionError(f"--bounces: got {self.bounces!r}, need 3 or all")
        if self.voxels is not None and self.voxel_size is not None:
            raise OptionError("--voxels and --voxel-size: give one of them, the other follows from the volume")
        if self.voxels is not None and not (isinstance(self.voxels, Integral) and self.voxels >= 1):
            raise OptionError(f"--voxels: got {self.voxels!r}, need an integer >= 1")
        for option, lengths, counts in (
            ("voxel-size", None if self.voxel_size is None else (self.voxel_size,), (1,)),
            ("volume-size", self.volume_size, (1, 3)),
        ):
            if lengths is not None and not (len(lengths) in counts and all(0 < x <= MAX_LENGTH for x in lengths)):
                need = f"{' or '.join(map(str, counts))} length > 0, at most {MAX_LENGTH:g} [m]"
                raise OptionError(f"--{option}: got {_listed(lengths)}, need {need}")
        center = self.volume_center
        if center is not None and not (len(center) == 3 and all(abs(x) <= MAX_LENGTH for x in center)):
            raise OptionError(f"--volume-center: got {_listed(center)}, need x, y, z of at most {MAX_LENGTH:g} [m]")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed volume and where it came from."""

    volume: Float32  # (z, y, x) magnitude of the field, or filtered backprojection; arbitrary unit, >= 0
    grid: VoxelGrid
    method: str
    wavelength: float  # m
    cycles: float
    bounces: tuple[int, ...]  # bounce numbers it was made from
    source: Path
    source_attributes: dict[str, object]  # of the capture file
    wall_to_file: Float64  # (4, 4)
    wall_to_scene: Float64 | None  # (4, 4)
    seconds: float  # of reading and computing
    warnings: tuple[str, ...]

    def front_view(self) -> Float32:
        """Return the largest value along z, (y, x)."""
        return self.volume.max(axis=0)

    def depth_map(self) -> Float64:
        """Return z of the largest value, (y, x) [m]; between voxels by a parabola through its neighbours."""
        peak = self.volume.argmax(axis=0)
        if len(self.grid.z) < 3:
            return self.grid.z[peak]
        inner = np.clip(peak, 1, len(self.grid.z) - 2)
        before, top, after = (
            np.take_along_axis(self.volume, (inner + step)[None], axis=0)[0].astype(np.float64) for step in (-1, 0, 1)
        )
        bend = before - 2 * top + after
        shift = np.divide(before - after, 2 * bend, out=np.zeros_like(top), where=(bend < 0) & (peak == inner))
        return self.grid.z[peak] + shift * self.grid.voxel_size

    def silhouette(self) -> Float64:
        """Return the share of each front pixel (y, x) that the true hidden geometry covers.

        Raises
        ------
        FileError
            The capture does not carry its scene, or a shape's outline is not known without a renderer.
        """
        from nlosrender.analysis.reconstruction.silhouette import true_silhouette

        return true_silhouette(self.source, self.source_attributes, self.grid)

    def score(self) -> Score:
        """Return how well the front view matches the true silhouette.

        Raises
        ------
        FileError, NlosError
            As ``silhouette``; or nothing can be compared.
        """
        from nlosrender.analysis.reconstruction.score import score_front_view

        return score_front_view(self.front_view(), self.silhouette())

    def plot(self) -> Picture:
        """Draw the front view, the depth, and the views from above and from the side."""
        from nlosrender.analysis.reconstruction.picture import reconstruction_picture

        return reconstruction_picture(self)

    def save(self, path: str | Path) -> Path:
        """Write the volume as an HDF5 file and return ``path``; FileError where that cannot be done."""
        from nlosrender.analysis.reconstruction.volume_file import write_volume

        return write_volume(self, path)


def reconstruct_capture(
    path: str | Path,
    settings: ReconstructionSettings,
    progress: Progress = lambda share: None,
    warn: Warn = lambda text: None,
) -> Reconstruction:
    """Reconstruct the hidden scene of a capture; ``warn`` is called before the work begins where possible.

    Raises
    ------
    FileError
        The capture cannot be read, or does not suit the method: a curved wall or irregular points for phasor fields,
        no third bounce of its own, no word about where the hidden scene is.
    OptionError
        The settings are impossible for this capture.
    """
    begun = time.perf_counter()
    warnings = Warnings(warn)
    with open_capture(path) as capture:
        capture.header.refuse_spots("reconstruction")
        scan = read_scan(capture)
        warnings.emit(few_counts(capture.header))
        phasor = settings.method == "phasor"
        if phasor:
            refuse_curved(scan)
        indices = chosen_bounces(capture.header, settings.bounces)
        wavelength = settings.wavelength
        if wavelength is None:
            wavelength = default_wavelength(scan, expected_box(scan, settings.volume_center, settings.volume_size))
        pulse = Pulse(wavelength, settings.cycles)
        grid = voxel_grid(
            scan, wavelength, settings.volume_center, settings.volume_size, settings.voxels, settings.voxel_size
        )
        if phasor:
            if settings.wavelength is not None:
                warnings.emit(pulse_warnings(scan, pulse, grid.bounds))
            volume = np.abs(phasor_field(capture, scan, grid, pulse, indices, progress))
        else:
            width = max(wavelength * FILTER_WAVELENGTHS, grid.voxel_size * MIN_FILTER_VOXELS)
            volume = laplacian_filtered(backproject(capture, scan, grid, indices, progress), grid.voxel_size, width)
        header = capture.header
    if not np.isfinite(volume).all():
        raise FileError(f"{path}: data holds numbers so large that the volume is not finite; scale them down")
    if not volume.any():
        warnings.emit(
            ["no light of this capture comes from the volume: look elsewhere (--volume-center, --volume-size)"]
        )
    return Reconstruction(
        volume=volume,
        grid=grid,
        method=settings.method,
        wavelength=wavelength,
        cycles=settings.cycles,
        bounces=tuple(index + header.first_bounce for index in indices),
        source=Path(path),
        source_attributes=dict(header.attributes),
        wall_to_file=scan.wall_to_file,
        wall_to_scene=scan.wall_to_scene,
        seconds=time.perf_counter() - begun,
        warnings=tuple(warnings.emitted),
    )


def settings_text(reconstruction: Reconstruction) -> str:
    """Return method, wavelength and voxels in words."""
    grid = reconstruction.grid
    nz, ny, nx = grid.shape
    parts = ["phasor fields" if reconstruction.method == "phasor" else "filtered backprojection"]
    if reconstruction.method == "phasor":
        parts.append(f"wavelength {1000 * reconstruction.wavelength:.4g} mm, {reconstruction.cycles:g} cycles")
    parts.append(f"{nx} x {ny} x {nz} voxels of {1000 * grid.voxel_size:.4g} mm")
    return SEPARATOR.join(parts)


def _listed(lengths: tuple[float, ...]) -> str:
    return ",".join(f"{length:g}" for length in lengths)
