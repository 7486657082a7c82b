"""MAT files of version 7.3: HDF5 behind 512 bytes of MATLAB's, dimensions in reverse order, classes in attributes.

Written in parts, so that no size of capture has to fit into memory; a version 7 file ends at 2 GiB.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import isqrt
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike

from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.layout import CHUNK_SAMPLES
from nlosrender.files.reading.scan import Float32

USER_BLOCK = 512  # bytes before HDF5's own
# text, no subsystem data, version 2.0, and "MI" as a little-endian machine writes it
HEADER = (b"MATLAB 7.3 MAT-file, Platform: nlosrender, HDF5 schema 1.00 .".ljust(116) + bytes(8) + b"\x00\x02IM").ljust(
    USER_BLOCK, b"\0"
)
MAX_CHUNK_ROWS = 32  # rows of one chunk


class Mat73:
    """A version 7.3 file open for writing; made by :func:`new_mat73`."""

    def __init__(self, hdf5: HDF5Writer):
        self._hdf5 = hdf5

    def put(self, name: str, values: ArrayLike) -> None:
        """Add a variable of few numbers, as double; a number becomes 1 x 1, a list of them a row."""
        stored = np.atleast_2d(np.asarray(values, dtype=np.float64)).T
        self._hdf5.file.create_dataset(name, data=stored).attrs["MATLAB_class"] = np.bytes_("double")

    def samples(self, name: str, shape: tuple[int, int, int]) -> h5py.Dataset:
        """Add a variable of class single, (row, column, bin) in MATLAB, zero until it is filled."""
        rows, columns, bins = shape
        depth = min(bins, CHUNK_SAMPLES)
        height = chunk_rows(shape)
        width = max(min(columns, CHUNK_SAMPLES // (depth * height)), 1)
        dataset = self._hdf5.file.create_dataset(
            name,
            (bins, columns, rows),
            "<f4",
            chunks=(depth, width, height),
            compression="gzip",
            compression_opts=1,
            shuffle=True,
        )
        dataset.attrs["MATLAB_class"] = np.bytes_("single")
        return dataset

    def fill(self, samples: h5py.Dataset, rows: slice, light: Float32, first_bin: int = 0) -> None:
        """Write (row, column, bin) of some rows from a bin on.

        Raises
        ------
        OSError
            The disk refuses.
        """
        if light.any():  # chunks that are never written cost nothing
            bins = slice(first_bin, first_bin + light.shape[2])
            self._hdf5.fill(samples, (bins, slice(None), rows), light.transpose(2, 1, 0))


def chunk_rows(shape: tuple[int, int, int]) -> int:
    """Return how many rows of samples (row, column, bin) one chunk holds."""
    rows, _, bins = shape
    return max(min(rows, MAX_CHUNK_ROWS, isqrt(CHUNK_SAMPLES // min(bins, CHUNK_SAMPLES))), 1)


@contextmanager
def new_mat73(path: Path) -> Iterator[Mat73]:
    """Create a version 7.3 file.

    Raises
    ------
    OSError
        The disk refuses.
    """
    with HDF5Writer(path, userblock_size=USER_BLOCK) as hdf5:
        yield Mat73(hdf5)
    with path.open("r+b") as stream:
        stream.write(HEADER)
