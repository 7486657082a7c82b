"""How far renders have come: finished captures, parts and partial files of a folder, and which shards are missing."""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from nlosrender.analysis.partial_summary import UnfinishedState, is_unfinished, read_unfinished
from nlosrender.capture.part import WHOLE
from nlosrender.config.canonical import tree_hash
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import partial_folder
from nlosrender.files.dataset_index import has_index, read_index
from nlosrender.files.file_kinds import CAPTURE_SUFFIXES, is_derived
from nlosrender.files.identity import SELECTION
from nlosrender.files.reading.reader import read_header

State = Literal[UnfinishedState, "done", "failed", "pending"]
STATES: tuple[State, ...] = ("running", "stale", "stopped", "failed", "pending", "done")  # in the order of a table
_PARTIAL = re.compile(r"\.(.+)\.partial")
_SHARD = re.compile(r"--shard (\d+)/(\d+)")


@dataclass(frozen=True)
class RenderStatus:
    """How far the render of one file has come.

    Attributes
    ----------
    state
        ``done``: it is there; ``running``: a process has it open; ``stale``: it has, and writes nothing; ``stopped``:
        no process has, the same command goes on; ``failed``: it cannot be read, or its index says so; ``pending``: its
        render has not begun.
    """

    file: str
    state: State
    part: str | None = None  # the option that selects it; None: the whole capture, or not known
    capture: str | None = None  # hash that all parts of a capture share
    finished_units: int | None = None
    units: int | None = None  # None: not known, or no longer
    seconds_left: float | None = None  # of rendering
    silent_seconds: float | None = None  # since anything was written
    run_by: str = ""
    message: str = ""  # why it failed


def status_of(paths: Iterable[Path], stale_after: float) -> list[RenderStatus]:
    """Return the status of files, and of all captures that are in folders at any depth, each once.

    Parameters
    ----------
    paths
        Captures, finished or not, their folders ``.NAME.partial``, or folders of captures.
    stale_after
        Seconds without a byte written after which a render that a process has open is ``stale``.

    Raises
    ------
    FileError
        A folder cannot be read, or there is nothing of that name.
    """
    found: dict[str, RenderStatus] = {}
    for path in paths:
        name = path.resolve().name if path.name in ("", "..") else path.name
        if partial := _PARTIAL.fullmatch(name):
            statuses: Iterable[RenderStatus] = [_status(path.with_name(partial[1]), stale_after)]
        elif path.is_dir():
            statuses = _in_folder(path, stale_after)
        elif not (os.path.lexists(path) or partial_folder(path).is_dir()):
            raise FileError(f"{path}: there is no such file, finished or not. Name a folder to see what is in it.")
        else:
            statuses = [_status(path, stale_after)]
        for status in statuses:
            found.setdefault(os.path.realpath(status.file), status)
    return list(found.values())


def _in_folder(folder: Path, stale_after: float) -> Iterator[RenderStatus]:
    def refuse(error: OSError) -> None:
        raise FileError(f"{error.filename}: cannot be read: {error.strerror}") from error

    for parent, folders, files in os.walk(folder, onerror=refuse):
        partials = {match[1] for name in folders if (match := _PARTIAL.fullmatch(name))}
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        captures = {name for name in files if name.endswith(CAPTURE_SUFFIXES) and not name.startswith(".")}
        for status in (_status(Path(parent) / name, stale_after) for name in sorted(captures | partials)):
            if status.state != "failed" or not is_derived(Path(status.file)):
                yield status
        if has_index(Path(parent)):
            yield from _only_in_index(Path(parent))


def _only_in_index(folder: Path) -> Iterator[RenderStatus]:
    """Yield the captures of an index that have no file, finished or not."""
    for entry in read_index(folder)["captures"]:
        path = folder / entry["file"]
        if os.path.lexists(path) or partial_folder(path).is_dir():
            continue
        if entry["status"] == "failed":
            yield RenderStatus(str(path), "failed", message=entry["message"] or "")
        else:
            yield RenderStatus(str(path), "pending")


def _status(path: Path, stale_after: float) -> RenderStatus:
    """Return the status of an output; a render that replaces a finished file counts, and not that file."""
    folder = partial_folder(Path(os.path.realpath(path)))
    try:
        return _unfinished(path, folder, stale_after) if is_unfinished(folder) else _finished(path)
    except FileError as error:
        if not folder.exists() and is_capture(path):  # published between two looks
            return _finished(path)
        return RenderStatus(str(path), "failed", message=str(error))


def is_capture(path: Path) -> bool:
    """Return whether a capture can be read."""
    try:
        read_header(path)
    except FileError:
        return False
    return True


def _finished(path: Path) -> RenderStatus:
    attributes = read_header(path).attributes
    part, capture = (
        value if isinstance(value := attributes.get(name), str) else None for name in (SELECTION, "capture_hash")
    )
    return RenderStatus(str(path), "done", part, capture)


def _unfinished(path: Path, folder: Path, stale_after: float) -> RenderStatus:
    found = read_unfinished(folder)
    state = found.state(stale_after)
    status = RenderStatus(
        str(path),
        state,
        finished_units=found.finished_units,
        units=found.units,
        seconds_left=found.seconds_left if state == "running" else None,
        silent_seconds=found.silent_seconds,
        run_by=found.run_by,
    )
    identity = found.journal.first.get("identity")
    if not isinstance(identity, dict) or "config" not in identity:  # it still sets up the scene
        return status
    part = str(identity.get("part"))
    return replace(status, part=None if part == str(WHOLE) else part, capture=tree_hash(identity["config"]))


def missing_shards(statuses: Sequence[RenderStatus]) -> list[str]:
    """Return what is missing of captures that are rendered in shards, in words: shards without any file."""
    shards: dict[tuple[str, int], dict[int, str]] = defaultdict(dict)
    for status in statuses:
        if status.part is not None and status.capture is not None and (match := _SHARD.fullmatch(status.part)):
            shards[status.capture, int(match[2])][int(match[1])] = status.file
    found = []
    for (_, count), files in shards.items():
        missing = [number for number in range(1, count + 1) if number not in files]
        if missing:
            listed = ", ".join(map(str, missing[:20])) + (", ..." if len(missing) > 20 else "")
            which = f"the capture of {min(files.values())}: --shard I/{count} with I = {listed}"
            found.append(f"{len(missing)} of {count} shards of {which}")
    return found


def status_report(statuses: Sequence[RenderStatus]) -> dict[str, Any]:
    """Return everything as plain values, with what it adds up to.

    ``seconds_left`` is that of the slowest render, None where one of those that run has no pace yet; ``complete``: all
    files are done and no shard is missing.
    """
    running = [status for status in statuses if status.state == "running"]
    left = [status.seconds_left for status in running]
    known = [seconds for seconds in left if seconds is not None]
    missing = missing_shards(statuses)
    counts = Counter(status.state for status in statuses)
    return {
        "complete": bool(statuses) and counts["done"] == len(statuses) and not missing,
        "files": len(statuses),
        "states": {state: counts[state] for state in STATES if counts[state]},
        "finished_units": sum(status.finished_units or 0 for status in statuses if status.units is not None),
        "units": sum(status.units or 0 for status in statuses),
        "seconds_left": max(known) if known and len(known) == len(left) else None,
        "missing": missing,
        "renders": [asdict(status) for status in sorted(statuses, key=lambda status: STATES.index(status.state))],
    }
