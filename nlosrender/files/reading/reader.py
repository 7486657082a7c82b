"""Reads capture files: metadata at once, samples lazily and back in the in-memory axis order."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import get_attributes
from nlosrender.files.reading.locking import open_for_reading
from nlosrender.files.reading.stored_axes import in_memory_order
from nlosrender.files.reading.stored_header import StoredHeader, header_of, samples_of
from nlosrender.files.reading.stored_points import dataset_in, plane_normal, stored_points

Part = int | slice | None  # of one axis; None: all of it
BAND_BYTES = 64 * 2**20  # of samples read at a time; a reader holds a few arrays of that size
TILE_AXES = ("channel", "sensor_y", "sensor_x", "bin")  # what one read of one laser and one bounce returns


@dataclass(frozen=True, eq=False)
class StoredPositions:
    """Points and unit normals of both grids, (rows, columns, 3) float64 [m], in the file's frame.

    Normals are None where the file has none and the points lie in no plane.
    """

    sensor_positions: NDArray[np.float64]
    sensor_normals: NDArray[np.float64] | None
    laser_positions: NDArray[np.float64]
    laser_normals: NDArray[np.float64] | None


class StoredCapture:
    """An open capture file; made by :func:`open_capture`."""

    def __init__(self, file: h5py.File, path: Path):
        self._file = file
        self._samples = layout.DATA
        self.path = path
        self.header: StoredHeader = header_of(file, path)

    def counts(self) -> StoredCapture | None:
        """Return the counts beside the ideal samples as a capture of their own; None: there are none.

        Raises
        ------
        FileError
            They are damaged.
        """
        with explained_read(self.path):
            dataset = dataset_in(self._file, self.path, layout.COUNTS)
            stated = {} if dataset is None else get_attributes(dataset)
            if stated.get("unit") != layout.COUNTS_UNIT:  # another program's may be anything
                return None
            samples = samples_of(self._file, self.path, layout.COUNTS)
            beside = StoredCapture(self._file, self.path)
            beside._samples = layout.COUNTS
            beside.header = replace(
                self.header,
                sizes=dict(zip(self.header.axes, samples.shape, strict=True)) | self._single_laser,
                data_shape=tuple(samples.shape),
                start_opl=float(str(stated["t0"])),
                bin_width_opl=float(str(stated["deltaT"])),
                bounce_indices=(layout.SUMMED_INDEX,),
                split_bounces=False,
                data_attributes=stated,
            )
            return beside

    @property
    def _single_laser(self) -> dict[str, int]:
        """Lengths of axes that the file does not have."""
        return {axis: length for axis, length in self.header.sizes.items() if axis not in self.header.axes}

    def copy_ground_truth(self, target: h5py.File) -> None:
        """Copy what the file has of the hidden scene's truth into another file."""
        with explained_read(self.path):
            for spec in layout.GROUND_TRUTH:
                if dataset_in(self._file, self.path, spec.name) is not None:
                    self._file.copy(spec.name, target)

    @property
    def laser_spots(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Positions (spots, 3) in the file's frame [m] and shares (spots,) of spots lit at once; None: there are none.

        Raises
        ------
        FileError
            The file says that there are, and does not have them.
        """
        if not self.header.is_multiplexed:
            return None
        with explained_read(self.path):
            found = [dataset_in(self._file, self.path, name) for name in (layout.SPOT_POSITIONS, layout.SPOT_SHARES)]
            points, shares = (None if each is None else np.asarray(each[()], dtype=np.float64) for each in found)
        if points is None or shares is None or points.shape != (layout.THREE, 1, shares.size) or shares.ndim != 1:
            raise FileError(f"{self.path}: has no usable {layout.SPOT_POSITIONS} and {layout.SPOT_SHARES} of its spots")
        return points[:, 0].T, shares

    @property
    def positions(self) -> StoredPositions:
        """Points and normals of both grids.

        Raises
        ------
        FileError
            The file does not have them, or not one per point.
        """
        with explained_read(self.path):
            sensors, lasers = (self._points(f"{grid}GridPositions") for grid in ("camera", "laser"))
            both = np.concatenate([sensors.reshape(-1, 3), lasers.reshape(-1, 3)])
            sensor_normals = self._normals("camera", sensors, both)
            return StoredPositions(sensors, sensor_normals, lasers, self._normals("laser", lasers, both))

    def _points(self, name: str, like: str | None = None) -> NDArray[np.float64]:
        sizes = layout.grid_sizes(self.header.sizes, self.header.confocal)
        return stored_points(self._file, self.path, name, sizes, self.header.row_major, like)

    def _normals(self, grid: str, points: NDArray[np.float64], wall: NDArray[np.float64]) -> NDArray[np.float64] | None:
        name = f"{grid}GridNormals"
        if dataset_in(self._file, self.path, name) is not None:
            return self._points(name, like=f"{grid}GridPositions")
        place = self.header.hidden_volume_position or self.header.sensor_position
        normal = plane_normal(wall, place if place is not None and len(place) == layout.THREE else None)
        return None if normal is None else np.broadcast_to(normal, points.shape)

    def read_block(
        self,
        lasers: tuple[Part, Part] | None = None,
        sensors: tuple[Part, Part] | None = None,
        bounces: Sequence[int] | None = None,
        dataset: str = layout.DATA,
    ) -> NDArray[np.float32]:
        """Read part of the samples.

        Parameters
        ----------
        lasers, sensors
            (row, column), each an index, a slice of step 1 or None for all; None for the whole grid.
        bounces
            Indices on the file's bounce axis; None for those that hold light (``header.bounce_indices``).
        dataset
            ``data`` or ``variance``.

        Returns
        -------
        NDArray
            (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) float32; an index keeps its axis.

        Raises
        ------
        FileError
            A part lies outside the capture, the file has no such dataset, or its content is damaged.
        """
        sizes = self.header.sizes
        parts = (*(lasers or (None, None)), *(sensors or (None, None)))
        axes = ("laser_y", "laser_x", "sensor_y", "sensor_x")
        where = {axis: self._range(part, axis) for axis, part in zip(axes, parts, strict=True)}
        chosen = self.header.bounce_indices if bounces is None else tuple(bounces)
        if any(not 0 <= bounce < sizes["bounce"] for bounce in chosen):
            raise FileError(f"{self.path}: no bounce index {chosen}, the file has 0 to {sizes['bounce'] - 1}")
        with explained_read(self.path):
            samples = samples_of(self._file, self.path, self._samples if dataset == layout.DATA else dataset)
            if samples.shape != self.header.data_shape:
                raise FileError(f"{self.path}: {dataset} has shape {samples.shape}, data {self.header.data_shape}")
            return self._gather(samples, where, chosen)

    def bands(
        self, laser: tuple[int, int], bounces: Sequence[int] | None = None, band_bytes: int = BAND_BYTES
    ) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Yield rows of sensor points and their samples (channel, bounce, row, sensor_x, bin) of one laser point.

        ``band_bytes`` bounds the samples of one band; a band has whole chunks where it has more than one.

        Raises
        ------
        FileError
            As ``read_block``; or a sample is not finite.
        """
        sizes = self.header.sizes
        n_bounces = len(self.header.bounce_indices if bounces is None else bounces)
        step = max(band_bytes // (4 * sizes["channel"] * n_bounces * sizes["sensor_x"] * sizes["bin"]), 1)
        chunk = dict(zip(self.header.axes, self.header.chunks or (), strict=False)).get("sensor_y", 1)
        step -= step % chunk if chunk <= step else 0  # or the chunks at its ends would be unpacked twice
        for start in range(0, sizes["sensor_y"], step):
            rows = slice(start, min(start + step, sizes["sensor_y"]))
            yield rows, finite(self.path, self.read_block(laser, (rows, None), bounces)[:, :, 0, 0])

    def _gather(self, samples: h5py.Dataset, where: dict[str, slice], bounces: tuple[int, ...]) -> NDArray[np.float32]:
        sizes = self.header.sizes
        lengths = {axis: part.stop - part.start for axis, part in where.items()}
        lengths |= {"channel": sizes["channel"], "bounce": len(bounces), "bin": sizes["bin"]}
        block = np.empty([lengths[axis] for axis in layout.MEMORY_AXES], dtype=np.float32)
        tile: dict[str, int | slice] = {"channel": slice(None), "bin": slice(None)}
        tile |= {axis: where[axis] for axis in ("sensor_y", "sensor_x")}
        read_axes = tuple(axis for axis in self.header.axes if axis in TILE_AXES)
        # laser by laser, bounce by bounce: chunks hold one of each, and HDF5 copies across them element by element
        for row, column in np.ndindex(lengths["laser_y"], lengths["laser_x"]):
            laser = {"laser_y": where["laser_y"].start + row, "laser_x": where["laser_x"].start + column}
            for slot, bounce in enumerate(bounces):
                where_stored = {**tile, **laser, "bounce": bounce}
                stored = samples[tuple(where_stored[axis] for axis in self.header.axes)]
                block[:, slot, row, column] = in_memory_order(stored, read_axes, TILE_AXES)
        return block

    def _range(self, part: Part, axis: str) -> slice:
        length = self.header.sizes[axis]
        if isinstance(part, slice) and part.step in (None, 1):
            start, stop, _ = part.indices(length)
            if start < stop:
                return slice(start, stop)
        elif part is None:
            return slice(0, length)
        elif isinstance(part, (int, np.integer)) and 0 <= part < length:
            return slice(int(part), int(part) + 1)
        raise FileError(f"{self.path}: {axis} {part} is outside the capture, which has 0 to {length - 1}")


def finite(path: Path, samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return samples as they are.

    Raises
    ------
    FileError
        One is not finite.
    """
    if not np.isfinite(samples).all():
        raise FileError(f"{path}: data holds numbers that are not finite; see `nlosrender info --check`")
    return samples


def read_header(path: str | Path) -> StoredHeader:
    """Read a capture's metadata; its samples are not touched, whatever their size.

    Raises
    ------
    FileError
        The file is missing, damaged or not a capture.
    """
    with open_capture(path) as capture:
        return capture.header


@contextmanager
def open_capture(path: str | Path) -> Iterator[StoredCapture]:
    """Open a capture for reading.

    Raises
    ------
    FileError
        The file is missing, damaged or not a capture.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        with explained_read(path):
            capture = StoredCapture(file, path)
        yield capture


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open any HDF5 file for reading.

    Raises
    ------
    FileError
        There is no such file, it cannot be read, or it is not an HDF5 file or cut short.
    """
    with explained_read(path):
        check_regular(path)
        if not h5py.is_hdf5(path):
            with path.open("rb") as stream:
                start = stream.read(16)
            content = f"it starts with {start!r}" if start else "it is empty"
            raise FileError(f"{path}: is not an HDF5 file ({content}). Captures are HDF5 files, usually named .hdf5")
        file = open_for_reading(path)
    try:
        yield file
    finally:
        file.close()


@contextmanager
def explained_read(path: Path) -> Iterator[None]:
    """Turn whatever a damaged file makes h5py raise into a FileError.

    Raises
    ------
    FileError
        An error of the system or of HDF5 left the block.
    """
    try:
        yield
    except MemoryError as error:
        raise FileError(
            f"{path}: claims to hold more than fits into memory. Read a part of it, or render it again."
        ) from error
    except PermissionError as error:
        reason = os.strerror(error.errno or errno.EACCES)  # h5py's own text runs over a line
        raise FileError(f"{path}: may not be read: {reason}. Ask for the right to read it, or copy it.") from error
    # h5py passes on HDF5's complaints about damaged content as any of these
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError) as error:
        raise FileError(f"{path}: cannot be read: {error}. {_advice(error)}") from error


def _advice(error: Exception) -> str:
    if "truncated" in str(error):
        return "The file is cut short: copy it again completely, or render it again."
    if "unable to lock file" in str(error):
        return "Another program has it open for writing: wait for it, or set HDF5_USE_FILE_LOCKING=FALSE."
    return "The file may be damaged: copy it again, or render it again."


def check_regular(path: Path) -> None:
    """Make sure that there is a file to read; a name for an output can be made of its name then.

    Raises
    ------
    FileError
        There is none, or it is a folder or a pipe.
    """
    with explained_read(path):
        try:
            mode = path.stat().st_mode
        except (FileNotFoundError, NotADirectoryError) as error:
            raise FileError(f"{path}: there is no such file") from error
    if stat.S_ISDIR(mode):
        raise FileError(f"{path}: is a folder. Name the capture file in it.")
    if not stat.S_ISREG(mode):  # a pipe would wait for its other end forever
        raise FileError(f"{path}: is not a regular file. Name a capture file.")
