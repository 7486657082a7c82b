"""A file that never fails while HDF5 writes to it; the first error is raised when the writer asks for it.

HDF5 cannot recover from a failed write: objects it closes later try again, fail again, and the process ends with a
segmentation fault instead of a message about the full disk (seen with HDF5 2.0). So HDF5 writes through this
object; after the first error everything further is held in memory, where HDF5 finds it again, until the writer has
closed the file and reports the error.
"""

from __future__ import annotations

import io
import os
from pathlib import Path


class DeferredErrorFile(io.RawIOBase):
    """Read-write file for h5py's file-object driver.

    Parameters
    ----------
    path
        File to create; an existing one is emptied, a symbolic link is not followed.
    keep
        Open an existing file as it is instead.

    Attributes
    ----------
    writes
        Position and length of all writes, until someone clears the list.

    Raises
    ------
    OSError
        It cannot be created or opened.
    """

    def __init__(self, path: Path, keep: bool = False):
        self.error: OSError | None = None
        self.writes: list[tuple[int, int]] = []
        self._held: list[tuple[int, bytes]] = []  # (position, content) of failed writes, oldest first
        self._position = 0
        flags = os.O_RDWR | os.O_NOFOLLOW | (0 if keep else os.O_CREAT | os.O_TRUNC)
        self._descriptor: int | None = os.open(path, flags, 0o666)

    def raise_error(self) -> None:
        """Raise the OSError of the first write that the system refused, if there was one."""
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        """Close the file, HDF5 being done with it; once is enough."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        super().close()

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to ``offset``, as files do."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size()}[whence]
        self._position = start + offset
        return self._position

    def write(self, content: memoryview) -> int:  # type: ignore[override]  # h5py hands in memoryviews
        """Write all of ``content``; keep it in memory if the disk fails."""
        start = self._position
        self._position += len(content)
        self.writes.append((start, len(content)))
        try:
            if self.error is None:
                write_all(self._open_descriptor(), content, start)
                return len(content)
        except OSError as error:
            self.error = error
        self._held.append((start, bytes(content)))
        return len(content)

    def readinto(self, target: memoryview) -> int:  # type: ignore[override]
        """Fill all of ``target``; bytes that were never written are zero."""
        start, length = self._position, len(target)
        self._position += length
        content = bytearray(length)
        try:
            stored = os.pread(self._open_descriptor(), length, start)
            content[: len(stored)] = stored
        except OSError as error:
            self.error = self.error or error
        for position, held in self._held:
            first, last = max(position, start), min(position + len(held), start + length)
            if first < last:
                content[first - start : last - start] = held[first - position : last - position]
        target[:] = content
        return length

    def truncate(self, size: int | None = None) -> int:
        """Set the file's length."""
        length = self._position if size is None else size
        try:
            if self.error is None:
                os.ftruncate(self._open_descriptor(), length)
        except OSError as error:
            self.error = error
        return length

    def _open_descriptor(self) -> int:
        if self._descriptor is None:
            raise OSError("the file is closed already")
        return self._descriptor

    def _size(self) -> int:
        on_disk = os.fstat(self._open_descriptor()).st_size
        return max([on_disk, *(position + len(held) for position, held in self._held)])


def write_all(descriptor: int, content: bytes | memoryview, start: int) -> None:
    """Write all of ``content`` at ``start``: as the disk fills the system takes less than it is given (OSError)."""
    written = 0
    while written < len(content):
        written += os.pwrite(descriptor, content[written:], start + written)
