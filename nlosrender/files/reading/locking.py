"""Locks are a courtesy: file systems without them, as some network ones, hold captures like any other."""

from __future__ import annotations

import errno
import fcntl
from contextlib import suppress
from pathlib import Path

import h5py

# errno of flock on a file system without locks; there nothing notices two renders into one file.
NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)


def locked(descriptor: int, kind: int) -> bool:
    """Lock an open file with ``LOCK_SH`` or ``LOCK_EX``, without waiting; False: its file system has no locks.

    Raises
    ------
    OSError
        It cannot be locked; BlockingIOError where another process has the lock.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return False
    return True


def open_for_reading(path: Path) -> h5py.File:
    """Open an HDF5 file; where it can be locked, a program that has it open for writing is noticed.

    Raises
    ------
    OSError
        It cannot be read.
    """
    has_locks = True
    with path.open("rb") as stream, suppress(OSError):  # a lock that another program holds: HDF5 reports it
        has_locks = locked(stream.fileno(), fcntl.LOCK_SH)
    # asked for explicitly: HDF5 opens a file a second time only with the same setting
    return h5py.File(path, "r", locking=has_locks)
