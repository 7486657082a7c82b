"""A capture file as Python sees it: nothing of it is held, samples are read when they are asked for."""

from __future__ import annotations

import html
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.laser_view import Point, check_point, laser_energies, point_histograms, wall_frames
from nlosrender.analysis.summary import summarise
from nlosrender.api.arguments import bounce_indices, check_parts, laser_point, nearest_point, sensor_for
from nlosrender.api.progress_bar import Wanted, reported, warn_caller
from nlosrender.config.mapping_load import Changes, change_texts
from nlosrender.constants import SPEED_OF_LIGHT, opl_to_seconds
from nlosrender.errors import OptionError
from nlosrender.files.attributes import json_object
from nlosrender.files.path_argument import path_argument
from nlosrender.files.reading.reader import Part, open_capture, read_header
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from xarray import DataArray

    from nlosrender.analysis.drawn_picture import Picture
    from nlosrender.analysis.reconstruction.reconstruct import Reconstruction
    from nlosrender.rendering.render_report import RenderReport

Dataset = Literal["data", "variance"]


class Capture:
    """A capture file by any writer; ``nlosrender.open(path)`` is ``Capture(path)``, and :func:`render` returns one.

    The file is opened for each call and closed after it, so that a render may replace it meanwhile.

    Parameters
    ----------
    path
        The file; its metadata are read, its samples are not.
    report
        What the render reported; None for a file that was opened.

    Raises
    ------
    FileError
        Here and in all methods: the file is missing, damaged or not a capture.
    OptionError
        It has no such part, or an argument is of another type.
    """

    def __init__(self, path: str | os.PathLike[str], report: RenderReport | None = None):
        self.path = path_argument("path", path)
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
        return self.header.bin_centres()

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
        check_parts("lasers", lasers)
        check_parts("sensors", sensors)
        with open_capture(self.path) as stored:
            return stored.read_block(lasers, sensors, bounce_indices(stored.header, bounces), dataset)

    def xarray(
        self,
        lasers: tuple[Part, Part] | None = None,
        sensors: tuple[Part, Part] | None = None,
        bounces: int | Sequence[int] | None = None,
        dataset: Dataset = "data",
    ) -> DataArray:
        """Read samples as ``numpy`` does, with named dimensions and coordinates in metres and seconds.

        Needs the optional package ``xarray``; ``api.named_samples`` has the coordinates.
        """
        from nlosrender.api.named_samples import named_samples

        check_parts("lasers", lasers)
        check_parts("sensors", sensors)
        with open_capture(self.path) as stored:
            indices = bounce_indices(stored.header, bounces)
            return named_samples(stored, lasers, sensors, indices, dataset)

    def frame(self, t: float, *, laser: Point | None = None) -> NDArray[np.float64]:
        """Return the light on the wall in the bin that holds a time ``t`` [s], (sensor_y, sensor_x).

        Bounces are summed, colours averaged; ``laser`` as of ``plot``.
        """
        with open_capture(self.path) as stored:
            header = stored.header
            start, end = opl_to_seconds(header.start_opl), opl_to_seconds(header.end_opl)
            if not (isinstance(t, Real) and start <= t < end):
                raise OptionError(f"t: got {t!r}, need a time from {start:.6g} to below {end:.6g} s")
            position = (t * SPEED_OF_LIGHT - header.start_opl) / header.bin_width_opl
            index = min(max(int(position), 0), header.n_bins - 1)
            return wall_frames(stored, laser_point(header, laser), [slice(index, index + 1)])[0]

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
            chosen = check_point("pixel", pixel, *header.sensor_grid) or nearest_point(stored, x, y)
            return point_histograms(stored, laser_point(header, laser), chosen)

    def energy(self) -> dict[str, float]:
        """Return the sum of all samples by bounce, such as ``{"3": 0.36}``; colours add up, of Stokes vectors I.

        What the render has stored is returned; samples are read where the file does not say.
        """
        with open_capture(self.path) as stored:
            header = stored.header
            known = json_object(header.attributes.get("energy"))
            if known and all(isinstance(value, (int, float)) for value in known.values()):
                return {name: float(value) for name, value in known.items()}
            sums = [
                laser_energies(stored, laser) for laser in np.ndindex(header.sizes["laser_y"], header.sizes["laser_x"])
            ]
            return dict(zip(map(header.bounce_name, header.bounce_indices), np.sum(sums, axis=0).tolist(), strict=True))

    # --- what the commands of these names do ---

    def plot(
        self,
        *,
        laser: Point | None = None,
        pixel: Point | None = None,
        ideal: str | os.PathLike[str] | None = None,
        theme: str = "dark",
        size: tuple[float, float] = (14.0, 7.6),
        dpi: float = 130.0,
        shared_scale: bool = False,
    ) -> Picture:
        """Draw the wall over time, one histogram, light per bounce, one row over time; ``save(path)`` writes it.

        Parameters
        ----------
        laser
            (row, column) of the laser point; None: the one in the middle.
        pixel
            (row, column) of the sensor point whose histogram is drawn; None: the brightest.
        ideal
            Of counts: the capture that they were measured from.
        theme
            ``dark`` or ``light``.
        size, dpi
            Width and height in inches, and pixels per inch where the picture is saved.
        shared_scale
            Draw the wall's frames on one colour scale; else each has its own.
        """
        from nlosrender.analysis.picture_style import PictureStyle
        from nlosrender.analysis.plots import capture_picture

        look = PictureStyle(theme, size, dpi, shared_scale)
        source = None if ideal is None else path_argument("ideal", ideal)
        return capture_picture(self.path, laser, pixel, source, look)

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
        ConfigError, FileError
            The sensor has mistakes or does not fit the capture; the file cannot be measured, or ``out`` not be written.
        """
        from nlosrender.files.measured import CORRECTABLE, measure_capture

        if not isinstance(correct, Collection) or any(name not in CORRECTABLE for name in correct):
            raise OptionError(f"correct: got {correct!r:.60}, need a list of some of {', '.join(CORRECTABLE)}")
        target, config = path_argument("out", out), sensor_for(self.path, sensor, change_texts(changes))
        with reported(progress, "measure") as told:
            measure_capture(
                self.path, target, config, told, warn_caller, corrections=tuple(correct), overwrite=overwrite
            )
        return Capture(target)

    def reconstruct(
        self,
        method: str = "phasor",
        *,
        wavelength: float | None = None,
        cycles: float = 5.0,
        volume_center: tuple[float, float, float] | None = None,
        volume_size: tuple[float, ...] | None = None,
        voxels: int | None = None,
        voxel_size: float | None = None,
        bounces: int | str | None = None,
        progress: Wanted = False,
    ) -> Reconstruction:
        """Reconstruct the hidden scene by ``method``: ``phasor`` fields, or ``backprojection``.

        Parameters
        ----------
        wavelength, cycles
            Of the virtual wave [m] and in its pulse; None: the shortest without aliasing.
        volume_center, volume_size
            Middle and edges of the volume [m]: along the wall, up, away from it; one edge counts for all. None: where
            the file says that the hidden scene is.
        voxels, voxel_size
            Along the longest edge, or the edge of one [m]; None: 128.
        bounces
            3 or ``all``; None: 3 where the file has it apart.
        progress
            As of :func:`render`.

        Returns
        -------
        Reconstruction
            ``volume`` (z, y, x), ``grid``, ``front_view()``, ``depth_map()``, ``plot()``, ``score()``.
        """
        from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture

        light = None if bounces is None else str(bounces)
        chosen = ReconstructionSettings(
            method, wavelength, cycles, volume_center, volume_size, voxels, voxel_size, light
        )
        with reported(progress, "reconstruct") as told:
            return reconstruct_capture(self.path, chosen, told, warn_caller)
