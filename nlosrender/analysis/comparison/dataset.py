"""``check_dataset``: every capture of a reference folder against its namesake in another; references replaced."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
from nlosrender.analysis.comparison.report import comparison_report
from nlosrender.analysis.comparison.tolerance_rules import ToleranceRule, refuse_idle_rules, tolerances_of
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import check_writable, replacing
from nlosrender.files.file_kinds import CAPTURE, CAPTURE_SUFFIXES, is_derived

Status = Literal["ok", "exceeds", "missing", "unreadable"]


@dataclass(frozen=True, eq=False)
class CheckedFile:
    """One capture of the reference, and what became of it; ``report`` is None unless both could be read."""

    name: str  # path relative to the folder
    status: Status
    message: str  # why it is not ok; empty when it is
    report: dict[str, Any] | None = None
    seconds: float = 0.0  # that the comparison took


@dataclass(frozen=True, eq=False)
class DatasetCheck:
    """The captures of a reference folder, and those that only the checked folder has."""

    files: tuple[CheckedFile, ...]
    extra: tuple[str, ...]

    def with_status(self, status: Status) -> tuple[CheckedFile, ...]:
        """Return the files that came out as ``status``."""
        return tuple(file for file in self.files if file.status == status)


def check_dataset(
    folder: Path,
    reference: Path,
    tolerances: Tolerances,
    done: Callable[[CheckedFile], None] = lambda file: None,
    rules: Sequence[ToleranceRule] = (),
) -> DatasetCheck:
    """Compare every capture below ``reference`` with that of the same relative path below ``folder``.

    Captures are files named .hdf5 or .h5, at any depth, hidden ones excepted.

    Parameters
    ----------
    folder, reference
        Folder with the captures to judge, and with those to judge them by.
    tolerances
        Of files that no rule is about.
    done
        Called after each file.
    rules
        Tolerances of single files; the first that applies decides.

    Raises
    ------
    FileError
        One of them is no folder, or the reference holds no capture: a check of nothing must not pass.
    ConfigError
        A rule decides about no file.
    """
    expected, present = captures_below(reference), captures_below(folder)
    if not expected:
        raise FileError(
            f"{reference}: holds no capture (files named {' or '.join(CAPTURE_SUFFIXES)}) to check against."
        )
    refuse_idle_rules(rules, expected, reference)
    files = []
    for name in expected:
        begun = time.perf_counter()
        file = _check(folder / name, reference / name, name, tolerances_of(name, rules, tolerances))
        file = replace(file, seconds=time.perf_counter() - begun)
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


def replace_references(files: Iterable[CheckedFile], folder: Path, reference: Path) -> None:
    """Copy captures over the references they were checked against: each whole or not at all.

    Raises
    ------
    FileError
        A reference is no capture of ours, or cannot be written; then none has been replaced, unless a disk failed.
    """
    names = [file.name for file in files]
    for name in names:
        check_writable(reference / name, CAPTURE, [folder / name])
    for name in names:
        with replacing(reference / name, CAPTURE, [folder / name]) as partial:
            shutil.copyfile(folder / name, partial)


def captures_below(folder: Path) -> list[str]:
    """Return the captures below a folder as sorted relative paths; volumes and exports beside them are left out.

    Raises
    ------
    FileError
        It is no folder, or one in it cannot be read.
    """
    if not folder.is_dir():
        raise FileError(f"{folder}: there is no such folder" if not folder.exists() else f"{folder}: is no folder")

    def refuse(error: OSError) -> None:  # a folder that is passed over would pass the check
        raise FileError(f"{error.filename}: cannot be read: {error.strerror}") from error

    found = []
    for parent, folders, files in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        names = (name for name in files if name.endswith(CAPTURE_SUFFIXES) and not name.startswith("."))
        paths = (Path(parent) / name for name in names)
        found += [path.relative_to(folder).as_posix() for path in paths if not is_derived(path)]
    return sorted(found)
