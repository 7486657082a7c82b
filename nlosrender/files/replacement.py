"""Files appear whole or not at all: written under another name beside the target, then renamed onto it."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nlosrender.errors import FileError


def check_writable(path: str | Path, *, overwrite: bool = True, source: str | Path | None = None) -> Path:
    """Make sure a capture can be written to ``path``, before anything long is started.

    Parameters
    ----------
    path
        File to be written; a symbolic link stands for the file it points to.
    overwrite
        Whether an existing file may be replaced.
    source
        The capture that is read for it, which must not be replaced.

    Returns
    -------
    Path
        ``path`` with symbolic links resolved.

    Raises
    ------
    FileError
        The folder is missing, is not a folder or cannot be written to, or the path is taken by something that is
        not a file, by ``source``, or by a file when ``overwrite`` is off.
    """
    try:
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise FileError(f"{path}: is a folder. Name a file in it, such as {target / 'capture.hdf5'}")
        if target.exists() and not target.is_file():
            raise FileError(f"{path}: is not a regular file and cannot be replaced by a capture. Name another output.")
        if source is not None and target == Path(os.path.realpath(source)):
            raise FileError(f"{path}: is the capture itself. Name another output.")
        if target.exists() and not overwrite:
            raise FileError(f"{path}: exists already. Name another output, or allow it to be overwritten.")
        if not target.parent.is_dir():
            raise FileError(f"{path}: there is no folder {target.parent}. Create it (mkdir -p) or name another output.")
        with explained_write(path):
            partial = partial_path(target)
            # permissions, a read-only disk, a full one, a name that is too long: trying tells them all
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT))
            partial.unlink()
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise FileError(f"{path}: cannot be used as an output: {error}") from error
    return target


def refuse_sources(path: str | Path, sources: Iterable[str | Path]) -> None:
    """Make sure that what is written to ``path`` replaces nothing of what is read for it.

    Raises
    ------
    FileError
        It is one of ``sources``.
    """
    target = os.path.realpath(path)
    if any(os.path.realpath(source) == target for source in sources):
        raise FileError(f"{path}: is read for this and would be replaced. Name another output.")


def partial_path(target: Path) -> Path:
    """Return the name a file has until it is complete."""
    return target.with_name(f".{target.name}.{os.getpid()}.partial")


def partial_folder(target: Path) -> Path:
    """Return the folder that holds a capture until it is complete; found again by a later render."""
    return target.with_name(f".{target.name}.partial")


def publish(partial: Path, target: Path) -> None:
    """Rename the complete ``partial`` onto ``target`` once its content has reached the disk.

    Raises
    ------
    OSError
        The disk is full or the folder has become unusable.
    """
    synchronise(partial)
    os.replace(partial, target)
    with suppress(OSError):  # the new name itself; some network file systems cannot sync a folder
        synchronise(target.parent)


def synchronise(path: Path) -> None:
    """Wait until a file, or a folder's list of names, has reached the disk.

    Raises
    ------
    OSError
        The disk is full or gone.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def explained_write(path: str | Path) -> Iterator[None]:
    """Turn what the system or HDF5 says about a failed write to ``path`` into a FileError with advice.

    Raises
    ------
    FileError
        An OSError or RuntimeError (h5py's, when a file cannot be closed) left the block.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = _system_error(error)
        # HDF5's own text runs over several lines, with addresses in memory
        reason = os.strerror(number) if number is not None else str(error).partition("\n")[0][:200]
        raise FileError(f"{path}: cannot be written: {reason}. {_advice(number)}") from error


def _system_error(error: OSError | RuntimeError) -> int | None:
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return number
    found = re.search(r"errno = (\d+)", str(error))  # where h5py does not tell it otherwise
    return int(found.group(1)) if found else None


def _advice(number: int | None) -> str:
    if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "Free some space or name an output on another disk; `nlosrender plan` tells the size to expect."
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "Name an output in a folder you may write to."
    if number == errno.ENAMETOOLONG:
        return "Name a shorter output."
    return "Check the disk, or name an output elsewhere."
