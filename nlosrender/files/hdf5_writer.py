"""New HDF5 files that a full disk or Ctrl-C leaves with an explained error instead of a segmentation fault."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from nlosrender.files.deferred_error_file import DeferredErrorFile
from nlosrender.interruption import uninterrupted


class HDF5Writer:
    """An HDF5 file open for writing; made by :func:`hdf5_writer`.

    Attributes
    ----------
    file
        For small datasets and attributes; samples go through ``fill``, which notices a full disk at once.
    """

    def __init__(self, file: h5py.File, stream: DeferredErrorFile):
        self.file = file
        self._stream = stream

    def fill(self, dataset: h5py.Dataset, selection: Any, values: np.ndarray) -> None:
        """Write part of a dataset.

        Raises
        ------
        OSError
            The disk refuses, now or earlier.
        """
        with uninterrupted():
            dataset[selection] = values
        self._stream.raise_error()  # what comes after it would be held in memory


@contextmanager
def hdf5_writer(path: Path, **options: Any) -> Iterator[HDF5Writer]:
    """Create an HDF5 file and close it, whatever happens to the disk in between.

    Parameters
    ----------
    path
        File to create; an existing one is emptied.
    options
        For ``h5py.File``.

    Raises
    ------
    OSError
        The file cannot be created, or the disk took not all of it.
    """
    stream = DeferredErrorFile(path)
    try:
        with uninterrupted():
            file = h5py.File(stream, "w", **options)
        try:
            yield HDF5Writer(file, stream)
        finally:
            with uninterrupted():
                file.close()
        stream.raise_error()
    finally:
        stream.close()
