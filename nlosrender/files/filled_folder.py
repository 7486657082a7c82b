"""Folders of many files that appear together: written into a folder inside, then moved out of it."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nlosrender.errors import FileError
from nlosrender.files.atomic_write import explained_write
from nlosrender.files.file_kinds import PICTURES
from nlosrender.interruption import uninterrupted


@contextmanager
def filled_folder(folder: str | Path) -> Iterator[Path]:
    """Give the block an empty folder; the pictures it leaves there move to ``folder``, over those of the same names.

    A block that fails or is interrupted leaves no file behind, nor a folder that was not there before.

    Parameters
    ----------
    folder
        Where the files go; made where there is none.

    Raises
    ------
    FileError
        It is a file or cannot be written to, a file of another kind has the name of a picture, or an OSError left the
        block.
    """
    with explained_write(folder):
        target = Path(os.path.realpath(folder))
        if target.exists() and not target.is_dir():
            raise FileError(f"{folder}: is a file. Name a folder, which may be a new one.")
        is_new = not target.exists()
        target.mkdir(parents=True, exist_ok=True)
        # inside: beside it may be another disk
        unfinished = Path(tempfile.mkdtemp(prefix=".", suffix=".partial", dir=target))
        try:
            yield unfinished
            with uninterrupted():
                files = sorted(unfinished.iterdir())
                for file in files:  # all of them first: none is replaced where one may not be
                    PICTURES[file.suffix].refuse_others(Path(folder) / file.name, target / file.name)
                for file in files:
                    os.replace(file, target / file.name)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # not empty: all went well
                    target.rmdir()
