"""An append-only list of records that survives the process being killed at any byte.

One line per record: CRC-32 of the rest, a space, JSON. A line that was cut off fails its checksum; it and everything
after it never happened. The same holds for a whole line that fails it, which is damage: ``lost_bytes`` tells. After a
power failure the last records may be gone: those that must not be are ``durable``. The file is locked while it is open;
the system drops the lock with the process.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from nlosrender.files.reading.locking import NO_LOCKS


class JournalInUseError(Exception):
    """Another process has the journal open."""


class Journal:
    """A journal open for appending.

    Parameters
    ----------
    path
        Its file; created when it is missing.

    Raises
    ------
    JournalInUseError
        Another process has it open.
    OSError
        The system refuses.
    """

    def __init__(self, path: Path):
        self.path = path
        self.lost_bytes = 0  # of damaged records and those behind them; what a kill cut off does not count
        self._descriptor = _locked(path)
        try:
            self._end = sum(length for _, length in _lines(path))
            self.lost_bytes = _up_to_last_line(path, self._end)
            os.ftruncate(self._descriptor, self._end)  # a record that was cut off must not run into the next one
        except BaseException:
            self.close()
            raise

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield the records from the oldest on, read anew: there may be more of them than memory."""
        for record, _ in _lines(self.path):
            yield record

    def append(self, record: Mapping[str, Any], *, durable: bool = False) -> None:
        """Add a record; with ``durable`` it has reached the disk on return, and a power failure leaves it.

        Raises
        ------
        OSError
            The disk is full, or gone; the record does not count.
        """
        line = line_of(record)
        written = 0
        while written < len(line):  # the system may take less than it is given, as the disk fills
            written += os.pwrite(self._descriptor, line[written:], self._end + written)
        self._end += len(line)
        if durable:
            os.fsync(self._descriptor)

    def clear(self) -> None:
        """Forget all records, on the disk too.

        Raises
        ------
        OSError
            The system refuses.
        """
        os.ftruncate(self._descriptor, 0)
        if self._end:
            os.fsync(self._descriptor)  # or old records might come back after a power failure
        self._end = 0

    def close(self) -> None:
        """Give the lock back; once is enough."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def read_records(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of a journal that may be in use.

    Raises
    ------
    OSError
        It cannot be read.
    """
    for record, _ in _lines(path):
        yield record


def _locked(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in NO_LOCKS:
                os.close(descriptor)
                if isinstance(error, BlockingIOError):
                    raise JournalInUseError(str(path)) from error
                raise
        # who held the lock may have finished and removed the file since it was opened here
        try:
            if os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return descriptor
        except FileNotFoundError:
            if not path.parent.is_dir():
                os.close(descriptor)
                raise
        os.close(descriptor)


def line_of(record: Mapping[str, Any]) -> bytes:
    """Return a record as a line."""
    text = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def record_of(line: bytes) -> dict[str, Any] | None:
    """Undo ``line_of``; None: the line is not whole."""
    checksum, _, text = line.partition(b" ")
    if not text.endswith(b"\n") or checksum != b"%08x" % zlib.crc32(text[:-1]):
        return None
    record: dict[str, Any] = json.loads(text)
    return record


def _up_to_last_line(path: Path, start: int) -> int:
    """Return how many bytes from ``start`` on belong to lines with an end."""
    whole = length = 0
    with path.open("rb") as stream:
        stream.seek(start)
        for line in stream:
            length += len(line)
            whole = length if line.endswith(b"\n") else whole
    return whole


def _lines(path: Path) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield (record, length of its line) up to the first line that is not whole."""
    with path.open("rb") as stream:
        for line in stream:
            if (record := record_of(line)) is None:
                return
            yield record, len(line)
