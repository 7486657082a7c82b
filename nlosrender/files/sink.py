"""A capture file while it is filled, chunk by chunk."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.files import layout
from nlosrender.files.atomic_write import explained_write
from nlosrender.files.attributes import set_attributes
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.chunking import PackedChunk
from nlosrender.files.chunks import chunk_shape
from nlosrender.files.deferred_error_file import DeferredErrorFile
from nlosrender.files.header_writer import root_attributes, sample_attributes, write_header
from nlosrender.files.partial.work_item_log import StoredChunk
from nlosrender.interruption import uninterrupted

GZIP_LEVEL = 4  # told to HDF5, which packs only chunks that are filled in parts
# h5py's default of 1 MiB holds no second chunk: a chunk filled in parts would be packed and unpacked for each part
CHUNK_CACHE_BYTES = 64 * 2**20
# the oldest encoding: MATLAB and C++ loaders are linked against HDF5 libraries of many ages
LIBRARY_VERSIONS = ("earliest", "v110")


class CaptureSink:
    """A capture file open for writing.

    Parameters
    ----------
    path
        The file.
    target
        What to call it in messages.
    names
        Its datasets of samples.
    create
        Fills a new file with everything but samples; None: go on with a file that was closed properly.
    reserved
        Attributes that belong to the layout.

    Raises
    ------
    FileError
        The file cannot be created or opened.
    """

    def __init__(
        self,
        path: Path,
        target: Path,
        names: Sequence[str],
        create: Callable[[h5py.File], None] | None = None,
        reserved: Iterable[str] = (),
    ):
        self.path, self.target = path, target
        self._reserved = frozenset(reserved)
        self._file: h5py.File | None = None
        self._stream: DeferredErrorFile | None = None
        try:
            with self._writing():
                self._stream = DeferredErrorFile(path, keep=create is None)
                mode = "r+" if create is None else "w"
                self._file = h5py.File(self._stream, mode, libver=LIBRARY_VERSIONS, rdcc_nbytes=CHUNK_CACHE_BYTES)
                if create is not None:
                    create(self._file)
                self._samples = {name: self._file[name] for name in names}
        except BaseException:
            self.abandon()
            raise

    def put(self, chunk: PackedChunk) -> StoredChunk:
        """Store a packed chunk; it replaces what was there.

        Raises
        ------
        FileError
            The disk refuses.
        """
        stream = self._open_stream()
        with self._writing():
            stream.writes.clear()
            self._samples[chunk.dataset].id.write_direct_chunk(chunk.at, chunk.content)
        return StoredChunk(
            chunk.dataset, chunk.at, self._offset_of(chunk, stream), len(chunk.content), zlib.crc32(chunk.content)
        )

    def fill(self, name: str, selection: tuple[int | slice, ...], samples: NDArray[np.float32]) -> None:
        """Write part of a chunk, selected and ordered as in the file, and leave the rest of it as it is.

        Raises
        ------
        FileError
            The disk refuses.
        """
        self._open_stream().writes.clear()
        with self._writing():
            self._samples[name][selection] = samples

    def set_attributes(self, attributes: Mapping[str, object]) -> None:
        """Add attributes to the file.

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

    def remove_attributes(self, names: Iterable[str]) -> None:
        """Remove attributes of the file, as far as it has them.

        Raises
        ------
        FileError
            The disk refuses.
        """
        with self._writing():
            for name in names:
                self._open_file().attrs.pop(name, None)

    def close(self) -> None:
        """Complete the file.

        Raises
        ------
        FileError
            The disk refuses.
        """
        with self._writing():
            self._open_file().close()
        with self._writing():
            self._close_stream()

    def abandon(self) -> None:
        """Close the file whatever state it is in; nothing is raised."""
        with suppress(OSError, RuntimeError):  # the error on its way out is the one to report
            if self._file is not None:
                self._file.close()
        self._close_stream()

    def _offset_of(self, chunk: PackedChunk, stream: DeferredErrorFile) -> int:
        """Return where in the file the chunk was written just now."""
        # HDF5 can tell, but goes through all chunks for it
        found = [position for position, length in stream.writes if length == len(chunk.content)]
        if len(found) == 1:
            return found[0]
        offset: int = self._samples[chunk.dataset].id.get_chunk_info_by_coord(chunk.at).byte_offset
        return offset

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Explain what goes wrong inside, at once or in what HDF5 writes on the way; let Ctrl-C wait."""
        with uninterrupted(), explained_write(self.target):
            yield
            if self._stream is not None:
                self._stream.raise_error()

    def _close_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()

    def _open_stream(self) -> DeferredErrorFile:
        if self._stream is None:
            raise ValueError(f"{self.target}: is not open")
        return self._stream

    def _open_file(self) -> h5py.File:
        if self._file is None:
            raise ValueError(f"{self.target}: is not open")
        return self._file


def new_capture(path: Path, target: Path, header: CaptureHeader, compression: str, store_variance: bool) -> CaptureSink:
    """Create a capture file without samples.

    Parameters
    ----------
    path, target
        The file, and what to call it in messages.
    header, compression, store_variance
        As for ``CaptureWriter``.

    Raises
    ------
    FileError
        The file cannot be created.
    """
    names = sample_names(store_variance)

    def create(file: h5py.File) -> None:
        write_header(file, header)
        for name in names:
            _create_samples(file, name, header, compression)

    return CaptureSink(path, target, names, create, reserved=root_attributes(header))


def sample_names(store_variance: bool) -> tuple[str, ...]:
    """Return the datasets of samples of a capture."""
    return (layout.DATA, layout.VARIANCE) if store_variance else (layout.DATA,)


def _create_samples(file: h5py.File, name: str, header: CaptureHeader, compression: str) -> None:
    filters = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True}
    dataset = file.create_dataset(
        name,
        shape=layout.data_shape(header.sizes, header.confocal),
        dtype=layout.FLOAT,
        chunks=chunk_shape(header.sizes, header.confocal),
        fillvalue=0.0,
        **(filters if compression == "gzip" else {}),
    )
    meaning = "H" if name == layout.DATA else "variance of each sample of data"
    attributes = sample_attributes(header) | {"meaning": meaning}
    if name == layout.VARIANCE:
        attributes["unit"] = f"({layout.DATA_UNIT})^2"
        if header.shared_samples:
            attributes["not_to_be_summed"] = header.shared_samples
    set_attributes(dataset, attributes)
