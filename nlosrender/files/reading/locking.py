"""Locks are a courtesy: file systems without them, as some network ones, hold captures like any other."""

from __future__ import annotations

import errno
import fcntl
from pathlib import Path

import h5py

# What locking a file answers there. Two renders into one file are then the user's to avoid.
NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)


def open_for_reading(path: Path) -> h5py.File:
    """Open an HDF5 file; where it can be locked, a program that has it open for writing is noticed.

    Raises
    ------
    OSError
        It cannot be read.
    """
    # found out here, not by trying: HDF5 opens a file a second time only with the same setting
    return h5py.File(path, "r", locking=_has_locks(path))


def _has_locks(path: Path) -> bool:
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            return error.errno not in NO_LOCKS
    return True
