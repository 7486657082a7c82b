"""The bytes of an unfinished capture's samples: read back, and held against the checksums of the journal.

Chunks have a checksum each. Everything else in the file, the header and HDF5's tables, has one checksum that is taken
when the file is closed: together they cover every byte. ISA-L computes the same CRC-32 as zlib, 8 times as fast.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from isal import isal_zlib

from nlosrender.files.partial.work_item_log import Closing, StoredChunk

READ_BYTES = 2**20  # of what is no chunk, at a time


class StoredChunks:
    """A file of samples open for reading; made by ``stored_chunks``. Its methods raise OSError from the disk."""

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        self.size = os.fstat(descriptor).st_size

    def content(self, chunk: StoredChunk) -> bytes | None:
        """Return the bytes of a chunk as they were written; None where the file has other ones."""
        if chunk.offset < 0 or not 0 <= chunk.length <= self.size - chunk.offset:
            return None
        content = os.pread(self._descriptor, chunk.length, chunk.offset)
        return content if isal_zlib.crc32(content) == chunk.checksum else None

    def has(self, chunks: Iterable[StoredChunk]) -> bool:
        """Return whether all of these chunks are as they were written."""
        return all(self.content(chunk) is not None for chunk in chunks)

    def closing(self, chunks: Iterable[StoredChunk]) -> Closing:
        """Return what tells whether anything but ``chunks`` has changed since: size, and checksum of the rest."""
        checksum = 0
        for start, stop in self._gaps(chunks):
            for position in range(start, stop, READ_BYTES):
                content = os.pread(self._descriptor, min(READ_BYTES, stop - position), position)
                checksum = isal_zlib.crc32(content, checksum)
        return Closing(self.size, checksum)

    def _gaps(self, chunks: Iterable[StoredChunk]) -> Iterator[tuple[int, int]]:
        """Yield (start, stop) of the ranges between the chunks."""
        # two numbers for each: there may be millions
        ranges = np.fromiter(((chunk.offset, chunk.length) for chunk in chunks), np.dtype((np.int64, 2)))
        end = 0
        for start, length in ranges[np.argsort(ranges[:, 0])]:
            if start > end:
                yield end, int(start)
            end = max(end, int(start + length))
        if end < self.size:
            yield end, self.size


@contextmanager
def stored_chunks(path: Path) -> Iterator[StoredChunks]:
    """Open a file of samples for reading; OSError where there is none, or a symbolic link."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        yield StoredChunks(descriptor)
    finally:
        os.close(descriptor)
