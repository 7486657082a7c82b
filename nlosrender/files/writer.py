"""Writes a capture piece by piece into a Z-NLOS file that appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import RenderError
from nlosrender.files import layout
from nlosrender.files.attributes import set_attributes
from nlosrender.files.capture_file import CaptureHeader
from nlosrender.files.chunks import chunk_shape, cuts
from nlosrender.files.header_writer import root_attributes, sample_attributes, write_header
from nlosrender.files.interruption import uninterrupted
from nlosrender.files.replacement import check_writable, explained_write, partial_path, publish
from nlosrender.files.shielded_file import ShieldedFile

__all__ = ["CaptureWriter", "check_writable"]

COMPRESSIONS = ("gzip", "none")
GZIP_LEVEL = 4
# h5py's default of 1 MiB holds no second chunk: a chunk filled in parts would be packed and unpacked for each part
CHUNK_CACHE_BYTES = 64 * 2**20
TILE_AXES = ("sensor_y", "sensor_x", "bin")  # of a piece of one chunk, as it lies in memory


@dataclass
class _Samples:
    """``data`` or ``variance``, and the chunks of it that exist already."""

    dataset: h5py.Dataset
    chunk: dict[str, int]  # length of a chunk along the tile axes
    written: set[tuple[int, ...]] = field(default_factory=set)


class CaptureWriter:
    """Context manager that writes one capture file.

    Leaving the block normally puts the file in place under its name, replacing what was there; an exception
    (Ctrl-C too) removes what was written and leaves the earlier file as it was.

    Parameters
    ----------
    path
        File to write.
    header
        Description of the capture.
    attributes
        Further attributes of the file, such as its provenance. They must not repeat those of the layout.
    compression
        ``gzip`` (with shuffle: the one filter pair that every HDF5 build has) or ``none``.
    store_variance
        Also store the variance of every sample, in a dataset ``variance`` shaped as ``data``.
    overwrite
        Whether an existing file may be replaced.

    Raises
    ------
    ValueError
        ``compression`` is unknown.
    FileError
        On entering: the file cannot be created. On leaving: it cannot be completed.
    """

    def __init__(
        self,
        path: str | Path,
        header: CaptureHeader,
        *,
        attributes: Mapping[str, object] | None = None,
        compression: str = "gzip",
        store_variance: bool = False,
        overwrite: bool = True,
    ):
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression: got {compression!r}, need one of {', '.join(COMPRESSIONS)}")
        self.path = Path(path)
        self.header = header
        self._attributes = dict(attributes or {})
        self._compression = compression
        self._store_variance = store_variance
        self._overwrite = overwrite
        self._reserved = frozenset(root_attributes(header))
        self._file: h5py.File | None = None
        self._stream: ShieldedFile | None = None

    def __enter__(self) -> CaptureWriter:
        self._target = check_writable(self.path, overwrite=self._overwrite)
        self._partial = partial_path(self._target)
        try:
            with self._writing():
                # the oldest encoding: MATLAB and C++ loaders are linked against HDF5 libraries of many ages
                self._stream = ShieldedFile(self._partial)
                self._file = h5py.File(self._stream, "w", libver=("earliest", "v110"), rdcc_nbytes=CHUNK_CACHE_BYTES)
                write_header(self._file, self.header)
                self._data = self._create(layout.DATA)
                self._variance = self._create(layout.VARIANCE) if self._store_variance else None
                self.set_attributes(self._attributes)
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            with self._writing():
                self._open_file().close()
            with self._writing():
                self._close_stream()
                publish(self._partial, self._target)
        except BaseException:
            self._discard()
            raise

    def write(
        self,
        block: NDArray[np.floating],
        laser_at: tuple[int, int] = (0, 0),
        sensor_at: tuple[int, int] = (0, 0),
        variance: NDArray[np.floating] | None = None,
    ) -> None:
        """Write one block of the capture.

        Parameters
        ----------
        block
            (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) samples of H, float32 or float64
            [J m^-2 sr^-1]; channels, bounces and bins whole.
        laser_at, sensor_at
            (row, column) of the block's first laser and sensor point.
        variance
            Variance of the samples, shaped as ``block``; needed exactly when the file stores it.

        Raises
        ------
        ValueError
            The block does not fit, or ``variance`` is missing or superfluous.
        RenderError
            A sample is not finite (as float32).
        FileError
            The disk refuses.
        """
        self._check_fit(block, laser_at, sensor_at)
        if (variance is None) != (self._variance is None):
            raise ValueError("variance: needed exactly when the file stores it (store_variance)")
        self._write_samples(self._data, block, laser_at, sensor_at)
        if variance is not None and self._variance is not None:
            if variance.shape != block.shape:
                raise ValueError(f"variance: got shape {variance.shape}, need the block's {block.shape}")
            self._write_samples(self._variance, variance, laser_at, sensor_at)

    def set_attributes(self, attributes: Mapping[str, object]) -> None:
        """Add attributes to the file, such as results known at the end only.

        Raises
        ------
        ValueError
            One of them belongs to the layout.
        FileError
            The disk refuses.
        """
        taken = sorted(self._reserved & set(attributes))
        if taken:
            raise ValueError(f"attributes: {', '.join(taken)} already set by the layout, choose another name")
        with self._writing():
            set_attributes(self._open_file(), attributes)

    def _create(self, name: str) -> _Samples:
        shape = layout.data_shape(self.header.sizes, self.header.confocal)
        chunks = chunk_shape(self.header.sizes, self.header.confocal)
        filters = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True}
        dataset = self._open_file().create_dataset(
            name,
            shape=shape,
            dtype=layout.FLOAT,
            chunks=chunks,
            fillvalue=0.0,
            **(filters if self._compression == "gzip" else {}),
        )
        meaning = "H" if name == layout.DATA else "variance of each sample of data"
        attributes = sample_attributes(self.header) | {"meaning": meaning}
        if name == layout.VARIANCE:
            attributes["unit"] = f"({layout.DATA_UNIT})^2"
        set_attributes(dataset, attributes)
        by_axis = dict(zip(layout.file_axes(self.header.confocal), chunks, strict=True))
        return _Samples(dataset, {axis: by_axis[axis] for axis in TILE_AXES})

    def _check_fit(self, block: NDArray[np.floating], laser_at: tuple[int, int], sensor_at: tuple[int, int]) -> None:
        sizes = self.header.sizes
        if block.ndim != len(layout.MEMORY_AXES) or block.dtype.kind != "f":
            raise ValueError(f"block: got {block.dtype} {block.shape}, need floats over {layout.MEMORY_AXES}")
        starts = dict(zip(("laser_y", "laser_x", "sensor_y", "sensor_x"), (*laser_at, *sensor_at), strict=True))
        for axis, length in zip(layout.MEMORY_AXES, block.shape, strict=True):
            start = starts.get(axis, 0)
            whole = axis in starts or length == sizes[axis]
            if start < 0 or start + length > sizes[axis] or not whole:
                raise ValueError(f"block: {length} from {start} along {axis} does not fit, its length is {sizes[axis]}")

    def _write_samples(
        self,
        samples: _Samples,
        block: NDArray[np.floating],
        laser_at: tuple[int, int],
        sensor_at: tuple[int, int],
    ) -> None:
        # one laser at a time: the copies made on the way stay small beside the block
        for row in range(block.shape[2]):
            for column in range(block.shape[3]):
                laser = (laser_at[0] + row, laser_at[1] + column)
                with np.errstate(over="ignore"):  # what overflows float32 is found and named right below
                    histograms = block[:, :, row, column].astype(np.float32, copy=False)
                self._refuse_non_finite(samples.dataset.name, histograms, laser, sensor_at)
                with self._writing():
                    self._write_laser(samples, histograms, laser, sensor_at)

    def _write_laser(
        self, samples: _Samples, histograms: NDArray[np.float32], laser: tuple[int, int], sensor_at: tuple[int, int]
    ) -> None:
        """Write (channel, bounce, sensor_y, sensor_x, bin) of one laser, except for chunks without any light."""
        confocal = self.header.confocal
        for tile in self._tiles(samples, histograms.shape[2:], sensor_at):
            inside = tuple(
                slice(tile[axis].start - start, tile[axis].stop - start)
                for axis, start in zip(TILE_AXES, (*sensor_at, 0), strict=True)
            )
            for channel, slot in np.ndindex(histograms.shape[:2]):
                piece = histograms[(channel, slot, *inside)]
                bounce = self.header.bounce_indices[slot]
                chunk = (channel, bounce, *laser, *(tile[axis].start // samples.chunk[axis] for axis in TILE_AXES))
                # a chunk that exists may hold light of an earlier write, which zeros must replace
                if chunk not in samples.written and not piece.any():
                    continue
                samples.written.add(chunk)
                where = {"channel": channel, "bounce": bounce, "laser_y": laser[0], "laser_x": laser[1], **tile}
                selection = layout.in_file_order(where, confocal)
                samples.dataset[selection] = layout.to_file_order(piece, TILE_AXES, confocal)

    def _tiles(
        self, samples: _Samples, shape: tuple[int, ...], sensor_at: tuple[int, int]
    ) -> Iterator[dict[str, slice]]:
        """Yield the parts of the chunks that a block of ``shape`` (rows, columns, bins) at ``sensor_at`` touches."""
        rows, columns, bins = (samples.chunk[axis] for axis in TILE_AXES)
        for y0, y1 in cuts(sensor_at[0], sensor_at[0] + shape[0], rows):
            for x0, x1 in cuts(sensor_at[1], sensor_at[1] + shape[1], columns):
                for t0, t1 in cuts(0, shape[2], bins):
                    yield {"sensor_y": slice(y0, y1), "sensor_x": slice(x0, x1), "bin": slice(t0, t1)}

    def _refuse_non_finite(
        self, name: str, histograms: NDArray[np.float32], laser: tuple[int, int], sensor_at: tuple[int, int]
    ) -> None:
        finite = np.isfinite(histograms)
        if finite.all():
            return
        channel, slot, row, column, time_bin = (int(index[0]) for index in np.nonzero(~finite))
        raise RenderError(
            f"{self.path}: {name.strip('/')} is {histograms[channel, slot, row, column, time_bin]} at laser "
            f"({laser[0]}, {laser[1]}), sensor ({sensor_at[0] + row}, {sensor_at[1] + column}), bin {time_bin}, "
            f"{self.header.bounce_name(slot)}, channel {channel}. Nothing that is not finite is written. "
            "Look for a reflectance, a texture or a length in the scene that is out of all proportion."
        )

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Explain what goes wrong inside, at once or in what HDF5 writes on the way; let Ctrl-C wait."""
        with uninterrupted(), explained_write(self.path):
            yield
            if self._stream is not None:
                self._stream.raise_error()

    def _close_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()

    def _open_file(self) -> h5py.File:
        if self._file is None:
            raise ValueError(f"{self.path}: the writer is not open; use it in a with block")
        return self._file

    def _discard(self) -> None:
        # a second Ctrl-C waits until everything is removed
        with uninterrupted():
            # the error on its way out is the one to report
            with suppress(OSError, RuntimeError):
                if self._file is not None:
                    self._file.close()
            self._close_stream()
            with suppress(OSError):
                self._partial.unlink(missing_ok=True)
