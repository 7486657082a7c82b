"""Atomic writes: files appear whole or not at all, and replace nothing but files of their own kind.

Every command writes through ``replacing``, or through what it is made of: a new file beside the target that nobody
else has (``new_partial``), renamed onto it once it has reached the disk (``publish``).
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nlosrender.errors import DiskError, FileError
from nlosrender.files.file_kinds import PICTURES, FileKind
from nlosrender.files.path_argument import path_argument
from nlosrender.interruption import uninterrupted
from nlosrender.readable import readable_size

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def check_writable(path: str | Path, kind: FileKind, sources: Iterable[str | Path] = ()) -> Path:
    """Make sure a file can be written, before anything long is started; return ``path`` with symbolic links resolved.

    Parameters
    ----------
    path
        File to be written; a symbolic link stands for the file it points to.
    kind
        What it will be: only a file of this kind is replaced.
    sources
        Files that are read for it, which must not be replaced.

    Raises
    ------
    FileError
        The folder is missing, is not a folder or cannot be written to, or the path is taken by something that is
        not a file, by one of ``sources``, or by a file of another kind.
    """
    path = path_argument("path", path)
    try:
        target = Path(os.path.realpath(path))
        if target.is_dir():
            raise FileError(f"{path}: is a folder. Name a file in it, such as {target / 'capture.hdf5'}")
        if target.exists() and not target.is_file():
            raise FileError(f"{path}: is not a regular file and cannot be replaced. Name another output.")
        refuse_sources(path, sources)
        if not target.parent.is_dir():
            raise FileError(f"{path}: there is no folder {target.parent}. Create it (mkdir -p) or name another output.")
        kind.refuse_others(path, target)
        with explained_write(path):
            # finds missing permissions, a read-only or full disk, a name that is too long
            new_partial(target).unlink()
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise FileError(f"{path}: cannot be used as an output: {error}") from error
    return target


@contextmanager
def replacing(path: str | Path, kind: FileKind, sources: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Give the block an empty file that replaces ``path`` when the block ends well, and is removed otherwise.

    Parameters are those of ``check_writable``.

    Raises
    ------
    FileError
        As ``check_writable``; or an OSError left the block.
    """
    target = check_writable(path, kind, sources)
    with explained_write(path):
        partial = new_partial(target)
        try:
            yield partial
            publish(path, partial, target, kind)
        finally:
            with uninterrupted(), suppress(OSError):
                partial.unlink(missing_ok=True)


def refuse_sources(path: str | Path, sources: Iterable[str | Path]) -> None:
    """Raise FileError where writing to ``path`` would replace one of ``sources``, which are read for it."""
    target = os.path.realpath(path)
    if any(os.path.realpath(source) == target for source in sources):
        raise FileError(f"{path}: is read for this and would be replaced. Name another output.")


def new_partial(target: Path) -> Path:
    """Create the empty file that ``target`` is until it is complete, under a name nobody else has (OSError)."""
    # not the process id, which a process in another container may have
    partial = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
    return partial


def partial_folder(target: Path) -> Path:
    """Return the folder that holds a capture until it is complete; a later render finds it again."""
    return target.with_name(f".{target.name}.partial")


def publish(path: str | Path, partial: Path, target: Path, kind: FileKind) -> None:
    """Rename the complete ``partial`` onto ``target``, called ``path`` in messages, once it has reached the disk.

    Raises
    ------
    OSError
        The disk is full or the folder has become unusable.
    FileError
        A file of another kind has come to lie there.
    """
    synchronise(partial)
    kind.refuse_others(path, target)
    os.replace(partial, target)
    with suppress(OSError):  # makes the new name durable; some network file systems cannot sync a folder
        synchronise(target.parent)


def synchronise(path: Path) -> None:
    """Wait until a file, or a folder's list of names, has reached the disk; OSError where it is full or gone."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def filled_folder(folder: str | Path) -> Iterator[Path]:
    """Give the block an empty folder; the pictures it leaves there move to ``folder``, over those of the same names.

    A block that fails or is interrupted leaves no file behind, nor a folder that was not there before.

    Raises
    ------
    FileError
        ``folder`` is a file or cannot be written to, a file of another kind has the name of a picture, or an OSError
        left the block.
    """
    with explained_write(folder):
        target = Path(os.path.realpath(folder))
        if target.exists() and not target.is_dir():
            raise FileError(f"{folder}: is a file. Name a folder, which may be a new one.")
        is_new = not target.exists()
        target.mkdir(parents=True, exist_ok=True)
        # inside the folder, so on the same disk
        unfinished = Path(tempfile.mkdtemp(prefix=".", suffix=".partial", dir=target))
        try:
            yield unfinished
            with uninterrupted():
                files = sorted(unfinished.iterdir())
                for file in files:  # checked before the first is replaced: all or none
                    PICTURES[file.suffix].refuse_others(Path(folder) / file.name, target / file.name)
                for file in files:
                    os.replace(file, target / file.name)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # not empty: the block ended well
                    target.rmdir()


@contextmanager
def explained_write(path: str | Path) -> Iterator[None]:
    """Turn a failed write to ``path`` inside the block into a FileError with advice.

    Raises
    ------
    FileError
        An OSError or RuntimeError (h5py's, when a file cannot be closed) left the block; a DiskError when the disk is
        full or fails.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = _system_error(error)
        # HDF5's own text runs over several lines, with addresses in memory
        reason = os.strerror(number) if number is not None else str(error).partition("\n")[0][:200]
        message = f"{path}: cannot be written: {reason}. {_advice(number, path)}"
        raise (DiskError if number in DISK_ERRORS else FileError)(message) from error


def _system_error(error: OSError | RuntimeError) -> int | None:
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return number
    found = re.search(r"errno = (\d+)", str(error))  # where h5py does not tell it otherwise
    return int(found.group(1)) if found else None


def _advice(number: int | None, path: str | Path) -> str:
    if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        size = "`nlosrender plan` tells the size of a capture to expect."
        return f"Free some space on {_disk_of(path)} or name an output on another disk; {size}"
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "Name an output in a folder you may write to."
    if number == errno.ENAMETOOLONG:
        return "Name a shorter output."
    return "Check the disk, or name an output elsewhere."


def _disk_of(path: str | Path) -> str:
    """Return where the disk is mounted that ``path`` lies on, and what is left on it, in words."""
    folder = Path(os.path.realpath(path)).parent
    with suppress(OSError):
        while not os.path.ismount(folder):
            folder = folder.parent
        return f"the disk {folder} ({readable_size(shutil.disk_usage(folder).free)} left)"
    return f"the disk of {folder}"
