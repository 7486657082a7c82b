"""HDF5 files open for writing: a full disk or Ctrl-C ends in an error that can be explained, not in a crash of HDF5."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from nlosrender.files.deferred_error_file import DeferredErrorFile
from nlosrender.interruption import uninterrupted

# h5py's default of 1 MiB holds no second chunk: a chunk filled in parts would be packed and unpacked for each part
CHUNK_CACHE_BYTES = 64 * 2**20
# the oldest encoding: MATLAB and C++ loaders are linked against HDF5 libraries of many ages
LIBRARY_VERSIONS = ("earliest", "v110")


class HDF5Writer:
    """An HDF5 file open for writing; as a context manager it is closed, or abandoned where the block fails.

    Everything but opening raises OSError when the disk refuses something, or has refused something earlier.

    Parameters
    ----------
    path
        File to create; an existing one is emptied.
    reopen
        Go on with a file that was closed properly instead.
    userblock_size, cache_bytes
        Bytes before HDF5's own; bytes of unpacked chunks held in memory.

    Attributes
    ----------
    file
        For small datasets and attributes, inside ``writing``.

    Raises
    ------
    OSError, RuntimeError
        The file cannot be created or opened.
    """

    file: h5py.File

    def __init__(
        self, path: Path, *, reopen: bool = False, userblock_size: int = 0, cache_bytes: int = CHUNK_CACHE_BYTES
    ):
        options = {"libver": LIBRARY_VERSIONS, "rdcc_nbytes": cache_bytes}
        if userblock_size:
            options["userblock_size"] = userblock_size
        self._stream = DeferredErrorFile(path, keep=reopen)
        try:
            with self.writing():
                self.file = h5py.File(self._stream, "r+" if reopen else "w", **options)
        except BaseException:
            self.abandon()
            raise

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Let Ctrl-C wait for the block, and raise what the disk has refused: later writes would only fill memory."""
        with uninterrupted():
            self._stream.writes.clear()
            yield
            self._stream.raise_error()

    def put_chunk(self, dataset: h5py.Dataset, at: tuple[int, ...], content: bytes) -> int:
        """Store a packed chunk, instead of one that was there; return where its bytes lie in the file."""
        with self.writing():
            dataset.id.write_direct_chunk(at, content)
        # asking HDF5 takes a pass over all chunks
        found = [position for position, length in self._stream.writes if length == len(content)]
        if len(found) == 1:
            return found[0]
        offset: int = dataset.id.get_chunk_info_by_coord(at).byte_offset
        return offset

    def fill(self, dataset: h5py.Dataset, selection: Any, values: np.ndarray) -> None:
        """Write part of a dataset."""
        with self.writing():
            dataset[selection] = values

    def close(self) -> None:
        """Complete the file."""
        with self.writing():
            self.file.close()
        self._stream.close()

    def abandon(self) -> None:
        """Close the file whatever state it is in; nothing is raised, and once is enough."""
        with uninterrupted():
            with suppress(OSError, RuntimeError, AttributeError):  # AttributeError: it could not be opened
                self.file.close()
            self._stream.close()

    def __enter__(self) -> HDF5Writer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.abandon()
