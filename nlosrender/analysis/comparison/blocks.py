"""The samples of two captures side by side, a bounded block at a time; what neither file stores is skipped."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.alignment import GridTurn
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.reading.reader import StoredCapture, explained_read, open_hdf5
from nlosrender.files.reading.stored_header import samples_of

Float32 = NDArray[np.float32]
Samples = NDArray[np.float32] | NDArray[np.float64]  # as stored, or as rendered
BLOCK_SAMPLES = 2**21  # of one dataset at a time: 8 MiB as read, and about 20 times that in intermediate results
MAX_CHUNK_BLOCKS = 8  # of chunks that are read as a whole; larger ones, by other writers, are unpacked repeatedly
MAX_POINTS = 2**24  # of one grid; 4096 x 4096 is beyond any scan
MAX_PER_POINT = 2**26  # samples of one sensor point and laser: 11 million bins of six bounces
STORED = ("bounce", "sensor_y", "sensor_x", "laser_y", "laser_x")  # axes along which parts may never be written


@dataclass(frozen=True, eq=False)
class Block:
    """The same part of two captures: one laser, a tile of sensor points, the bounces that either file stores there.

    Samples and variances have the axes (channel, bounce, sensor_y, sensor_x, bin).
    """

    laser: tuple[int, int]
    rows: slice
    columns: slice
    bounces: tuple[int, ...]  # indices on the file's bounce axis
    a: Samples
    b: Samples
    variance_a: Samples | None  # None: not asked for, or not in the file
    variance_b: Samples | None


class OpenCapture:
    """A capture file and which of its chunks were ever written.

    Raises
    ------
    FileError
        The file is damaged, or claims grids that no capture has.
    """

    def __init__(self, file: h5py.File, path: Path):
        self.capture = StoredCapture(file, path)
        self.path, self.header = path, self.capture.header
        sizes = self.header.sizes
        grids_fit = max(prod(self.header.sensor_grid), prod(self.header.laser_grid)) <= MAX_POINTS
        if not grids_fit or sizes["channel"] * sizes["bounce"] * sizes["bin"] > MAX_PER_POINT:
            raise FileError(
                f"{path}: data has shape {self.header.data_shape}, more than a comparison takes. "
                "Check the file with `nlosrender info`."
            )
        samples = samples_of(file, path)
        # of one chunk along every axis; a file without chunks is one chunk, which counts as written
        chunk = zip(self.header.axes, samples.chunks or samples.shape, strict=False)
        self._steps = dict.fromkeys(STORED, 1) | dict(chunk)
        self._written = self._written_chunks(samples) if samples.chunks else {(0,) * len(STORED)}
        self._lasers = {chunk[-2:] for chunk in self._written}
        self.sensors, self.lasers = GridTurn(self.header.sensor_grid), GridTurn(self._laser_grid())
        self._lead, self._n_bins = 0, self.header.n_bins

    def align(self, sensors: GridTurn, lasers: GridTurn, lead: int, n_bins: int) -> None:
        """Take points in another order and time from ``lead`` bins earlier on, ``n_bins`` long, from now on."""
        self.sensors = sensors
        self.lasers = GridTurn(self._laser_grid()) if self.header.confocal else lasers
        self._lead, self._n_bins = lead, n_bins

    def _laser_grid(self) -> tuple[int, int]:
        return self.header.sizes["laser_y"], self.header.sizes["laser_x"]

    @property
    def tile(self) -> tuple[int, int]:
        """Rows and columns of sensor points in one chunk."""
        height, width = self._steps["sensor_y"], self._steps["sensor_x"]
        return (width, height) if self.sensors.transposed else (height, width)

    def stores_laser(self, laser: tuple[int, int]) -> bool:
        """Return whether any sample of a laser may differ from zero, without reading it."""
        return self._laser_chunk(laser) in self._lasers

    def stores(self, bounce: int, laser: tuple[int, int], rows: slice, columns: slice) -> bool:
        """Return whether any sample of the part may differ from zero, without reading it."""
        parts = zip(self.sensors.stored(rows, columns), ("sensor_y", "sensor_x"), strict=True)
        ys, xs = (range(part.start // self._steps[axis], -(-part.stop // self._steps[axis])) for part, axis in parts)
        first, last = bounce // self._steps["bounce"], self._laser_chunk(laser)
        return any((first, y, x, *last) in self._written for y in ys for x in xs)

    def _stored_laser(self, laser: tuple[int, int]) -> tuple[int, int]:
        row, column = self.lasers.stored(*(slice(index, index + 1) for index in laser))
        return row.start, column.start

    def _laser_chunk(self, laser: tuple[int, int]) -> tuple[int, int]:
        row, column = self._stored_laser(laser)
        return row // self._steps["laser_y"], column // self._steps["laser_x"]

    def _written_chunks(self, samples: h5py.Dataset) -> set[tuple[int, ...]]:
        """Return where, along ``STORED``, a chunk was written: numbers of chunks, not of samples."""
        written: set[tuple[int, ...]] = set()

        def note(chunk: h5py.h5d.StoreInfo) -> None:
            starts = dict(zip(self.header.axes, chunk.chunk_offset, strict=False))
            written.add(tuple(starts.get(axis, 0) // self._steps[axis] for axis in STORED))

        samples.id.chunk_iter(note)
        return written

    def read(
        self, dataset: str, bounces: tuple[int, ...], laser: tuple[int, int], rows: slice, columns: slice
    ) -> Float32:
        """Return samples (channel, bounce, sensor_y, sensor_x, bin) of one laser.

        Raises
        ------
        FileError
            The file is damaged, or holds a sample that is not finite or a negative variance.
        """
        laser = self._stored_laser(laser)
        stored = self.capture.read_block(laser, self.sensors.stored(rows, columns), bounces, dataset)[:, :, 0, 0]
        block = self._aligned(stored)
        if not np.isfinite(block).all():
            raise FileError(
                f"{self.capture.path}: {dataset} holds a value that is not finite (laser {laser[0]}, {laser[1]}); "
                "`nlosrender info --check` tells where. Render it again."
            )
        if dataset == layout.VARIANCE and (block < 0).any():
            raise FileError(
                f"{self.capture.path}: variance is negative (laser {laser[0]}, {laser[1]}). Render it again."
            )
        return block

    def _aligned(self, stored: Float32) -> Float32:
        """Return samples (channel, bounce, y, x, bin) in the order and on the time axis of the reference."""
        turned: Float32 = self.sensors.turned(stored, axis=2)
        if (self._lead, self._n_bins) == (0, self.header.n_bins):
            return turned
        after = self._n_bins - self._lead - self.header.n_bins
        return np.pad(turned, ((0, 0),) * 4 + ((self._lead, after),))


@contextmanager
def open_for_comparison(path: Path) -> Iterator[OpenCapture]:
    """Open a capture for :func:`blocks`.

    Raises
    ------
    FileError
        The file is missing, damaged or not a capture.
    """
    with open_hdf5(path) as file:
        with explained_read(path):
            capture = OpenCapture(file, path)
        yield capture


def blocks(
    a: OpenCapture,
    b: OpenCapture,
    with_variance: bool,
    block_samples: int = BLOCK_SAMPLES,
    only: tuple[int, int] | None = None,
) -> Iterator[Block]:
    """Yield all parts of two captures of the same structure that either of them stores, laser after laser.

    ``only`` is the one laser (row, column) that is read; None: all.

    Raises
    ------
    FileError
        A file is damaged.
    """
    lasers = b.lasers.turned_shape
    read_variance = [with_variance and capture.header.has_variance for capture in (a, b)]
    for laser in np.ndindex(lasers) if only is None else [only]:
        if not (a.stores_laser(laser) or b.stores_laser(laser)):
            continue
        for rows, columns in _tiles(a, block_samples):
            stored = tuple(
                bounce
                for bounce in range(a.header.sizes["bounce"])
                if a.stores(bounce, laser, rows, columns) or b.stores(bounce, laser, rows, columns)
            )
            if not stored:
                continue
            samples = [capture.read(layout.DATA, stored, laser, rows, columns) for capture in (a, b)]
            variances = [
                capture.read(layout.VARIANCE, stored, laser, rows, columns) if wanted else None
                for capture, wanted in zip((a, b), read_variance, strict=True)
            ]
            yield Block(laser, rows, columns, stored, *samples, *variances)


def _tiles(capture: OpenCapture, block_samples: int) -> Iterator[tuple[slice, slice]]:
    """Cut the sensor grid into tiles of about ``block_samples``, whole chunks unless these are far larger."""
    header = capture.header
    n_rows, n_columns = capture.sensors.turned_shape
    points = max(block_samples // (header.sizes["channel"] * len(header.bounce_indices) * header.n_bins), 1)
    height, width = capture.tile
    if height * width > MAX_CHUNK_BLOCKS * points:
        height, width = 1, 1
    chunks = max(points // (height * width), 1)
    across = min(chunks, -(-n_columns // width))
    rows, columns = height * (chunks // across), width * across
    for y in range(0, n_rows, rows):
        for x in range(0, n_columns, columns):
            yield slice(y, min(y + rows, n_rows)), slice(x, min(x + columns, n_columns))
