"""``check_dataset``: every capture of a reference folder against its namesake in another."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
from nlosrender.analysis.comparison.report import comparison_report
from nlosrender.errors import FileError

SUFFIXES = (".hdf5", ".h5")  # names that captures have

Status = Literal["ok", "exceeds", "missing", "unreadable"]


@dataclass(frozen=True, eq=False)
class CheckedFile:
    """One capture of the reference, and what became of it; ``report`` is None unless both could be read."""

    name: str  # path relative to the folder
    status: Status
    message: str  # why it is not ok; empty when it is
    report: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class DatasetCheck:
    """The captures of a reference folder, and those that only the checked folder has."""

    files: tuple[CheckedFile, ...]
    extra: tuple[str, ...]

    def with_status(self, status: Status) -> tuple[CheckedFile, ...]:
        """Return the files that came out as ``status``."""
        return tuple(file for file in self.files if file.status == status)


def check_dataset(
    folder: Path, reference: Path, tolerances: Tolerances, done: Callable[[CheckedFile], None] = lambda file: None
) -> DatasetCheck:
    """Compare every capture below ``reference`` with that of the same relative path below ``folder``.

    Captures are files named .hdf5 or .h5, at any depth, hidden ones excepted; ``done`` is called after each.

    Raises
    ------
    FileError
        One of them is no folder, or the reference holds no capture: a check of nothing must not pass.
    """
    expected, present = _captures(reference), _captures(folder)
    if not expected:
        raise FileError(f"{reference}: holds no capture (files named {' or '.join(SUFFIXES)}) to check against.")
    files = []
    for name in expected:
        file = _check(folder / name, reference / name, name, tolerances)
        done(file)
        files.append(file)
    return DatasetCheck(tuple(files), tuple(sorted(set(present) - set(expected))))


def _check(path: Path, reference: Path, name: str, tolerances: Tolerances) -> CheckedFile:
    if not path.exists():
        return CheckedFile(name, "missing", f"there is no {path}")
    try:
        comparison = compare_captures(path, reference, tolerances)
    except FileError as error:  # the others are still worth checking
        return CheckedFile(name, "unreadable", str(error))
    failures = comparison.failures
    return CheckedFile(name, "exceeds" if failures else "ok", "; ".join(failures), comparison_report(comparison))


def _captures(folder: Path) -> list[str]:
    """Return the captures below a folder as sorted relative paths."""
    if not folder.is_dir():
        raise FileError(f"{folder}: there is no such folder" if not folder.exists() else f"{folder}: is no folder")

    def refuse(error: OSError) -> None:  # a folder that is passed over would pass the check
        raise FileError(f"{error.filename}: cannot be read: {error.strerror}") from error

    found = []
    for parent, folders, files in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        names = (name for name in files if name.endswith(SUFFIXES) and not name.startswith("."))
        found += [(Path(parent) / name).relative_to(folder).as_posix() for name in names]
    return sorted(found)
