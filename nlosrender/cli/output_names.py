"""Names of the files that commands write when they are told none."""

from __future__ import annotations

from pathlib import Path


def beside(file: Path, ending: str) -> Path:
    """Return a name beside ``file``: its own without suffix, then ``ending``.

    Raises
    ------
    FileError
        ``file`` is missing or a folder, whose name may be none, such as ``.``
    """
    from nlosrender.files.reading.reader import check_regular

    check_regular(file)
    return file.with_name(file.stem + ending)
