"""The journal of an unfinished capture: an append-only list of records that survives a kill at any byte.

One line per record: CRC-32 of the rest, a space, JSON. A line that was cut off fails its checksum; it and everything
after it never happened. The same holds for a whole line that fails it, which is damage: ``lost_bytes`` tells. After a
power failure the last records may be gone: those that must not be are ``durable``. The journal lies in a folder beside
the output and is locked while it is open: one process at a time renders into an output, and the system drops the lock
with the process.
"""

from __future__ import annotations

import fcntl
import json
import os
import stat
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from nlosrender.errors import FileError
from nlosrender.files.atomic_write import explained_write, new_partial, partial_folder
from nlosrender.files.deferred_error_file import write_all
from nlosrender.files.reading.locking import locked

JOURNAL = "journal"
LOOKED_AT = 3  # attempts to lock a journal that is only being looked at
MAX_ATTEMPTS = 10  # attempts to open a folder that another render is just removing


class JournalInUseError(Exception):
    """Another process has the journal open."""


class Journal:
    """A journal open for appending.

    Parameters
    ----------
    path
        Its file; created when it is missing.

    Attributes
    ----------
    lost_bytes
        Of damaged records and those behind them; what a kill cut off does not count.

    Raises
    ------
    JournalInUseError
        Another process has it open.
    OSError
        The system refuses.
    """

    def __init__(self, path: Path):
        self.path = path
        self._descriptor = _open_locked(path)
        try:
            self._end, self.lost_bytes = _extent(path)
            os.ftruncate(self._descriptor, self._end)  # a record that was cut off must not run into the next one
        except BaseException:
            self.close()
            raise

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield the records from the oldest on, read anew: there may be more of them than memory."""
        return read_records(self.path)

    def append(self, record: Mapping[str, Any], *, durable: bool = False) -> None:
        """Add a record; with ``durable`` it has reached the disk on return, and a power failure leaves it.

        Raises
        ------
        OSError
            The disk is full, or gone; the record does not count.
        """
        line = line_of(record)
        write_all(self._descriptor, line, self._end)
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
    """Yield the records of a journal that may be in use, up to the first line that is not whole.

    Raises
    ------
    OSError
        It cannot be read.
    """
    with path.open("rb") as stream:
        for line in stream:
            if (record := record_of(line)) is None:
                return
            yield record


def is_in_use(path: Path) -> bool | None:
    """Return whether a process has a journal open; None: its file system has no locks, so nobody knows.

    Raises
    ------
    OSError
        It cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        return False if locked(descriptor, fcntl.LOCK_SH) else None
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)  # gives the lock back


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


def claimed_journal(path: Path, target: Path) -> Journal:
    """Open the journal of an output in the folder beside it, which is made where there is none.

    Parameters
    ----------
    path, target
        The output as it is called in messages, and with symbolic links resolved.

    Raises
    ------
    FileError
        Another process has it open, the folder is not one of ours, or the disk refuses.
    """
    folder = partial_folder(target)
    with explained_write(path):
        probe = new_partial(target)
        owner = probe.lstat().st_uid  # as this file system has it: network ones may map users
        probe.unlink()
        for attempt in range(MAX_ATTEMPTS):
            with suppress(FileExistsError):
                folder.mkdir()
            _refuse_foreign(path, folder, owner)
            try:
                return Journal(folder / JOURNAL)
            except JournalInUseError as error:
                if attempt < LOOKED_AT:  # `nlosrender status` holds the lock for microseconds
                    time.sleep(0.02)
                    continue
                message = f"{path}: another render is writing it now. Wait for it, or name another output."
                raise FileError(message) from error
            except FileNotFoundError:
                if attempt == MAX_ATTEMPTS - 1:
                    raise
    raise FileError(f"{path}: cannot be written: its folder {folder} vanishes.")


def _refuse_foreign(path: Path, folder: Path, owner: int) -> None:
    """Refuse a folder that is not our own or holds links: what is written there must not end up elsewhere."""
    hint = "Remove it, or name another output."
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise FileError(f"{path}: {folder} is a link or a file, need a folder of unfinished renders. {hint}")
    if found.st_uid != owner:
        raise FileError(f"{path}: {folder} belongs to another user, number {found.st_uid}. Name another output.")
    for entry in folder.iterdir():
        mode, links = entry.lstat().st_mode, entry.lstat().st_nlink
        if not stat.S_ISREG(mode) or links > 1:
            raise FileError(f"{path}: {entry} is a link or no file, which no render leaves there. {hint}")


def _open_locked(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            locked(descriptor, fcntl.LOCK_EX)
            # who held the lock may have finished and removed the file since it was opened here
            if os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return descriptor
        except FileNotFoundError:
            if not path.parent.is_dir():
                os.close(descriptor)
                raise
        except BlockingIOError as error:
            os.close(descriptor)
            raise JournalInUseError(str(path)) from error
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _extent(path: Path) -> tuple[int, int]:
    """Return the bytes of the whole records, and those behind them up to the end of the last line."""
    end = position = last_line = 0
    damaged = False
    with path.open("rb") as stream:
        for line in stream:
            position += len(line)
            damaged = damaged or record_of(line) is None
            end = end if damaged else position
            last_line = position if line.endswith(b"\n") else last_line
    return end, last_line - end
