"""The folder of an unfinished capture: ours alone, claimed by one render at a time."""

from __future__ import annotations

import stat
from contextlib import suppress
from pathlib import Path

from nlosrender.errors import FileError
from nlosrender.files.atomic_write import explained_write, new_partial, partial_folder
from nlosrender.files.partial.journal import Journal, JournalInUseError

JOURNAL = "journal"
ATTEMPTS = 10  # to open a folder that another render is just removing


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
        owner = probe.lstat().st_uid  # of what this process makes there: network file systems have their own idea of it
        probe.unlink()
        for attempt in range(ATTEMPTS):
            with suppress(FileExistsError):
                folder.mkdir()
            _refuse_foreign(path, folder, owner)
            try:
                return Journal(folder / JOURNAL)
            except JournalInUseError as error:
                message = f"{path}: another render is writing it now. Wait for it, or name another output."
                raise FileError(message) from error
            except FileNotFoundError:
                if attempt == ATTEMPTS - 1:
                    raise
    raise FileError(f"{path}: cannot be written: its folder {folder} vanishes.")


def _refuse_foreign(path: Path, folder: Path, owner: int) -> None:
    """Make sure that the folder is our own and holds no links: what is written there must not end up elsewhere.

    Raises
    ------
    FileError
        It is not, or does.
    """
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
