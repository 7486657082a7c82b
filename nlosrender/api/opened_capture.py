"""A capture file as Python sees it: nothing of it is held, samples are read when they are asked for."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.laser_view import point_histograms, wall_frames
from nlosrender.analysis.summary import summarise
from nlosrender.api.progress_bar import Wanted, reported, warn_caller
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.config.mapping_load import Changes, change_texts
from nlosrender.constants import SPEED_OF_LIGHT, opl_to_seconds
from nlosrender.errors import OptionError
from nlosrender.files import layout
from nlosrender.files.attributes import json_object
from nlosrender.files.reading.reader import Part, StoredCapture, open_capture, read_header
from nlosrender.files.reading.scan import read_scan
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from xarray import DataArray

    from nlosrender.analysis.drawn_picture import Picture
    from nlosrender.analysis.reconstruction.reconstruct import Reconstruction
    from nlosrender.config.sensor import SensorConfig
    from nlosrender.rendering.render_report import RenderReport

Point = tuple[int, int]  # row, column
Dataset = Literal["data", "variance"]


def open_file(path: str | os.PathLike[str]) -> Capture:
    """Open a capture file by any writer; its metadata are read, its samples are not.

    Raises
    ------
    FileError
        The file is missing, damaged or not a capture.
    """
    return Capture(path)


class Capture:
    """A capture file; made by :func:`open` and :func:`render`.

    The file is opened for each call and closed after it, so that a render may replace it meanwhile. Errors of all
    methods: FileError, where the file cannot be read or is damaged; OptionError, where it has no such part.

    Attributes
    ----------
    path
        The file.
    report
        What the render reported; None for a file that was opened.
    """

    def __init__(self, path: str | os.PathLike[str], report: RenderReport | None = None):
        self.path = Path(path)
        self.report = report
        read_header(self.path)

    def __repr__(self) -> str:
        header = self.header
        rows, columns = header.sensor_grid
        return f"<nlosrender.Capture {str(self.path)!r}: {header.scan_type}, {columns} x {rows}, {header.n_bins} bins>"

    def _repr_html_(self) -> str:
        from nlosrender.analysis.capture_table import summary_rows

        rows = [[html.escape(text) for text in row] for row in summary_rows(self.summary())]
        cell = '<td style="text-align:left">'
        return f"<table>{''.join(f'<tr>{cell}{label}</td>{cell}{text}</td></tr>' for label, text in rows)}</table>"

    @property
    def header(self) -> StoredHeader:
        """Grids, time axis, bounces and attributes, as the file has them."""
        return read_header(self.path)

    def summary(self) -> dict[str, object]:
        """Return what ``nlosrender info --json`` prints: lengths in m, grids as (nx, ny)."""
        return summarise(self.path)

    # --- samples ---

    def opl(self) -> NDArray[np.float64]:
        """Return the optical path length in the middle of each bin, (bin,) [m]."""
        header = self.header
        middles: NDArray[np.float64] = np.arange(header.n_bins, dtype=np.float64) + 0.5
        return header.start_opl + middles * header.bin_width_opl

    def time(self) -> NDArray[np.float64]:
        """Return the time in the middle of each bin, (bin,) [s]: ``opl`` over the speed of light."""
        return self.opl() / SPEED_OF_LIGHT

    def numpy(
        self,
        lasers: tuple[Part, Part] | None = None,
        sensors: tuple[Part, Part] | None = None,
        bounces: int | Sequence[int] | None = None,
        dataset: Dataset = "data",
    ) -> NDArray[np.float32]:
        """Read samples: H [J m^-2 sr^-1], of a camera W m^-2 sr^-1, of a measured capture counts.

        Parameters
        ----------
        lasers, sensors
            (row, column), each an index, a slice or None for all; None for the whole grid.
        bounces
            Bounce numbers; None: all that hold light, 7 being 7 and above.
        dataset
            ``variance`` of H, where the file has it.

        Returns
        -------
        NDArray
            (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) float32; rows ascend in the wall's y, an index
            keeps its axis, and a confocal capture has one laser row and column.
        """
        with open_capture(self.path) as stored:
            return stored.read_block(lasers, sensors, _bounce_indices(stored.header, bounces), dataset)

    def xarray(
        self,
        lasers: tuple[Part, Part] | None = None,
        sensors: tuple[Part, Part] | None = None,
        bounces: int | Sequence[int] | None = None,
        dataset: Dataset = "data",
    ) -> DataArray:
        """Read samples as ``numpy`` does, with named dimensions and coordinates in metres and seconds.

        Needs the optional package ``xarray``. See ``api.named_samples`` for the coordinates.
        """
        from nlosrender.api.named_samples import named_samples

        with open_capture(self.path) as stored:
            indices = _bounce_indices(stored.header, bounces)
            return named_samples(stored, lasers, sensors, indices, dataset)

    def frame(self, t: float, *, laser: Point | None = None) -> NDArray[np.float64]:
        """Return the light on the wall in the bin that holds a time ``t`` [s], (sensor_y, sensor_x).

        Bounces are summed, colours averaged; ``laser`` as of ``plot``.
        """
        with open_capture(self.path) as stored:
            header = stored.header
            start, end = opl_to_seconds(header.start_opl), opl_to_seconds(header.end_opl)
            if not start <= t < end:
                raise OptionError(f"t: got {t!r}, need a time from {start:.6g} to below {end:.6g} s")
            position = (t * SPEED_OF_LIGHT - header.start_opl) / header.bin_width_opl
            index = min(max(int(position), 0), header.n_bins - 1)
            return wall_frames(stored, _laser(header, laser), [slice(index, index + 1)])[0]

    def histogram(
        self, x: float | None = None, y: float | None = None, *, pixel: Point | None = None, laser: Point | None = None
    ) -> NDArray[np.float64]:
        """Return the light of one sensor point over time, (bounce, bin); colours are averaged.

        Parameters
        ----------
        x, y
            Where on a flat wall [m], from its centre: the nearest sensor point is taken.
        pixel
            Or its (row, column); a curved wall and a camera have no x and y.
        laser
            As of ``plot``.
        """
        with open_capture(self.path) as stored:
            header = stored.header
            chosen = _nearest(stored, x, y) if pixel is None else pixel
            _check("pixel", chosen, header.sensor_grid)
            return point_histograms(stored, _laser(header, laser), chosen)

    def energy(self) -> dict[str, float]:
        """Return the sum of all samples by bounce, such as ``{"3": 0.36}``; colours add up, of Stokes vectors I.

        What the render has stored is returned; samples are read where the file does not say.
        """
        with open_capture(self.path) as stored:
            header = stored.header
            known = json_object(header.attributes.get("energy"))
            if known and all(isinstance(value, (int, float)) for value in known.values()):
                return {name: float(value) for name, value in known.items()}
            channels = 1 if header.attributes.get("channels") == layout.STOKES else header.sizes["channel"]
            total = np.zeros(len(header.bounce_indices))
            for laser in np.ndindex(header.sizes["laser_y"], header.sizes["laser_x"]):
                for _, band in stored.bands((laser[0], laser[1])):
                    total += band[:channels].sum(axis=(0, 2, 3, 4), dtype=np.float64)
            return {
                header.bounce_name(index): float(sum_) for index, sum_ in zip(header.bounce_indices, total, strict=True)
            }

    # --- what the commands of these names do ---

    def plot(
        self, laser: Point | None = None, pixel: Point | None = None, ideal: str | os.PathLike[str] | None = None
    ) -> Picture:
        """Draw the wall over time, one histogram, the light of each bounce, one row over time.

        Parameters
        ----------
        laser
            (row, column) of the laser point; None: the one in the middle.
        pixel
            (row, column) of the sensor point whose histogram is drawn; None: the brightest.
        ideal
            Of counts: the capture that they were measured from.
        """
        from nlosrender.analysis.plots import capture_picture

        return capture_picture(self.path, laser, pixel, None if ideal is None else Path(ideal))

    def measure(
        self,
        out: str | os.PathLike[str],
        sensor: str | os.PathLike[str] | Mapping[str, object] | None = None,
        changes: Changes | Iterable[str] = (),
        *,
        correct: Sequence[str] = (),
        overwrite: bool = False,
        progress: Wanted = False,
    ) -> Capture:
        """Count the photons of this capture as a detector does, into the file ``out``, and open that.

        Parameters
        ----------
        out
            File to write.
        sensor
            A profile such as ``spad-532``, a YAML file, or a mapping with the keys of a section ``sensor``; None: that
            of the capture's configuration.
        changes
            Values put over those of the sensor, as of :func:`load`: ``{"sensor.exposure_time": 1}``.
        correct
            ``pile_up`` and ``background``: undo them in the counts.
        overwrite
            Replace a capture that holds no counts.
        progress
            As of :func:`render`.

        Raises
        ------
        ConfigError
            The sensor has mistakes or does not fit the capture.
        FileError
            The file cannot be measured, or ``out`` not be written.
        """
        from nlosrender.files.measured import CORRECTABLE, measure_capture

        if unknown := [name for name in correct if name not in CORRECTABLE]:
            raise OptionError(f"correct: got {unknown[0]!r}, need some of {', '.join(CORRECTABLE)}")
        target, config = Path(out), sensor_for(self.path, sensor, change_texts(changes))
        with reported(progress, "measure") as told:
            measure_capture(
                self.path, target, config, told, warn_caller, corrections=tuple(correct), overwrite=overwrite
            )
        return Capture(target)

    def reconstruct(self, method: str = "phasor", *, progress: Wanted = False, **settings: Any) -> Reconstruction:
        """Reconstruct the hidden scene: ``phasor`` fields, or ``backprojection``.

        Parameters
        ----------
        method, settings
            Fields of ``ReconstructionSettings``: ``wavelength``, ``volume_center``, ``volume_size`` and ``voxel_size``
            in m, ``cycles``, ``voxels``, ``bounces``.
        progress
            As of :func:`render`.

        Returns
        -------
        Reconstruction
            ``volume`` (z, y, x), ``grid``, ``front_view()``, ``depth_map()``, ``plot()``, ``score()``.
        """
        from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture

        chosen = ReconstructionSettings(method, **settings)
        with reported(progress, "reconstruct") as told:
            return reconstruct_capture(self.path, chosen, told, warn_caller)


def sensor_for(
    path: Path, sensor: str | os.PathLike[str] | Mapping[str, object] | None, changes: Sequence[str]
) -> SensorConfig | None:
    """Return the sensor that is described; None: that of the capture file, as it is. Errors as of ``load_sensor``."""
    from nlosrender.config.sensor_load import load_sensor
    from nlosrender.files.measured import sensor_of

    if sensor is None and not changes:
        return None
    known = sensor_of(read_header(path)) if sensor is None else None
    return load_sensor(os.fspath(sensor) if isinstance(sensor, os.PathLike) else sensor, known, changes)


def _bounce_indices(header: StoredHeader, bounces: int | Sequence[int] | None) -> tuple[int, ...] | None:
    """Return the indices of bounce numbers on the file's bounce axis; None: all that hold light."""
    if bounces is None:
        return None
    wanted = [bounces] if isinstance(bounces, int) else list(bounces)
    if header.split_bounces is False:
        raise OptionError(f"bounces: got {wanted}, but {header.path} holds the sum of all; leave it away")
    known = [index + header.first_bounce for index in header.bounce_indices]
    if not wanted or (missing := [bounce for bounce in wanted if bounce not in known]):
        raise OptionError(f"bounces: got {missing if wanted else wanted}, need some of {', '.join(map(str, known))}")
    return tuple(bounce - header.first_bounce for bounce in wanted)


def _laser(header: StoredHeader, laser: Point | None) -> Point:
    """Return a laser point as ``plot`` chooses it."""
    grid = header.sizes["laser_y"], header.sizes["laser_x"]
    chosen = (grid[0] // 2, grid[1] // 2) if laser is None else laser
    _check("laser", chosen, grid)
    return chosen


def _check(name: str, point: Point, grid: Point) -> None:
    if not all(0 <= index < length for index, length in zip(point, grid, strict=True)):
        need = f"a row from 0 to {grid[0] - 1} and a column from 0 to {grid[1] - 1}"
        raise OptionError(f"{name}: got {point[0]},{point[1]}, need {need}")


def _nearest(stored: StoredCapture, x: float | None, y: float | None) -> Point:
    """Return row and column of the sensor point nearest to a place on a flat wall [m]."""
    if x is None or y is None:
        raise OptionError("histogram: need x and y [m], or pixel=(row, column)")
    scan = read_scan(stored) if stored.header.scan_type != LINE_OF_SIGHT else None
    if scan is None or not scan.planar:
        what = "a camera" if scan is None else "a curved wall"
        raise OptionError(f"x, y: {what} has no such coordinates; give pixel=(row, column)")
    points = scan.sensors[..., :2]
    rows, columns = points.shape[:2]
    size = stored.header.sensor_grid_size or tuple(np.ptp(points, axis=(0, 1)))
    half = np.array(size) / (2 * np.array([columns, rows]))  # of the cell around a point
    low, high = points.min(axis=(0, 1)) - half, points.max(axis=(0, 1)) + half
    if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
        need = f"x from {low[0]:.6g} to {high[0]:.6g} and y from {low[1]:.6g} to {high[1]:.6g} m"
        raise OptionError(f"x, y: got {x:g}, {y:g}, off the sensor grid; need {need}")
    row, column = np.unravel_index(int(((points - (x, y)) ** 2).sum(axis=-1).argmin()), (rows, columns))
    return int(row), int(column)
