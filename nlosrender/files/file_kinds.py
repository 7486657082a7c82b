"""Kinds of files that commands write, recognised by content: a file of another kind is never replaced.

The name says nothing: ``render -o thesis.tex`` must not end a thesis. An empty file may always be replaced.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from nlosrender.capture.part import WHOLE
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import get_attributes, json_object
from nlosrender.files.identity import SELECTION, comparable_config, differences, listed
from nlosrender.files.parts.shards import PART
from nlosrender.files.reading.reader import open_hdf5

CAPTURE_SUFFIXES = (".hdf5", ".h5")  # of the names that are looked at in folders
START_BYTES = 16_384  # of a file, in which its kind is looked for: the longest start is that of an SVG with comments


@dataclass(frozen=True)
class FileKind:
    """A kind of file, and what stands against replacing a file as one of this kind."""

    objection: Callable[[Path], str | None]  # a sentence after the file's name and a colon; None: it is one of them

    def refuse_others(self, path: str | Path, target: Path) -> None:
        """Make sure that the file at ``target``, called ``path`` in messages, may be replaced, if there is one.

        Raises
        ------
        FileError
            It is of another kind, or cannot be read.
        """
        try:
            if not target.is_file() or target.stat().st_size == 0:
                return
            text = self.objection(target)
        except OSError as error:
            text = _kept(f"cannot be read ({error.strerror})")
        if text is not None:
            raise FileError(f"{path}: {text}")


def _kept(what: str) -> str:
    return f"exists and {what}: it is not replaced. Name another output, or remove it."


def _starting(name: str, pattern: bytes) -> FileKind:
    """Return the kind of files called ``name`` whose start matches a pattern."""
    expression = re.compile(pattern, re.DOTALL)

    def objection(path: Path) -> str | None:
        with path.open("rb") as stream:
            start = stream.read(START_BYTES)
        return None if expression.match(start) else _kept(f"is not {name} (it starts with {start[:16]!r})")

    return FileKind(objection)


PNG = _starting("a PNG picture", rb"\x89PNG\r\n\x1a\n")
PDF = _starting("a PDF document", rb"%PDF-")
SVG = _starting("an SVG picture", rb"\s*(<\?xml.*)?<svg\b")
GIF = _starting("a GIF animation", rb"GIF8[79]a")
EXR = _starting("an OpenEXR picture", rb"\x76\x2f\x31\x01")
MAT = _starting("a MATLAB file", rb"MATLAB (5\.0|7\.3) MAT-file")
PLY = _starting("a PLY mesh", rb"ply\r?\n")
CONFIG = _starting("a configuration of nlosrender", rb"(.*\n)?scene:")
INDEX = _starting("an index of captures by nlosrender", rb'\{\s*"format_version"')
TABLES = {".csv": _starting("a table by nlosrender", rb"index,file,"), ".parquet": _starting("a table", rb"PAR1")}
REPORT = _starting("a report of nlosrender", rb'\{\s*"facts"')
PAGE = _starting("a page by nlosrender", rb"<!doctype html>.*<title>nlosrender")
JUNIT = _starting("a JUnit report by nlosrender", rb"<\?xml[^>]*\?>\s*<testsuites name=\"nlosrender")
PICTURES = {".png": PNG, ".pdf": PDF, ".svg": SVG, ".gif": GIF, ".exr": EXR}  # by suffix


def _hdf5(name: str, is_one: Callable[[h5py.File], bool]) -> FileKind:
    def objection(path: Path) -> str | None:
        try:
            with open_hdf5(path) as file:
                return None if is_one(file) else _kept(f"is not {name} (it holds {', '.join(sorted(file)[:6])})")
        except FileError as error:
            return _kept(f"is not {name} ({str(error).removeprefix(f'{path}: ').partition('. ')[0]})")

    return FileKind(objection)


_READABLE_CAPTURE = _hdf5(
    "a capture by nlosrender",
    lambda file: {layout.DATA} <= file.keys() and get_attributes(file).get("engine") == layout.ROOT_TEXT["engine"],
)
MEASURED = _hdf5(
    "a measured capture by nlosrender",
    lambda file: (
        get_attributes(file).get("engine") == layout.ROOT_TEXT["engine"]
        and layout.DATA in file
        and get_attributes(file[layout.DATA]).get("unit") == layout.COUNTS_UNIT
    ),
)
VOLUME = _hdf5("a reconstruction by nlosrender", lambda file: {"volume", *"xyz"} <= file.keys())
TAL = _hdf5("an HDF5_TAL file", lambda file: {"H", "H_format"} <= file.keys())


def is_derived(path: Path) -> bool:
    """Return whether a file was made of a capture and is none: what ``reconstruct`` and ``export`` write beside it."""
    return any(kind.objection(path) is None for kind in (VOLUME, TAL))


def _is_damaged_capture(path: Path) -> bool:
    """Return whether a file began as a capture of ours and can be read by nothing any more."""
    with path.open("rb") as stream:
        start = stream.read(START_BYTES)
    ours = start.startswith(b"\x89HDF\r\n\x1a\n") and layout.ROOT_TEXT["engine"].encode() in start
    if not ours:
        return False
    try:
        with open_hdf5(path):
            return False
    except FileError:
        return True


CAPTURE = FileKind(lambda path: None if _is_damaged_capture(path) else _READABLE_CAPTURE.objection(path))


def same_capture(capture_hash: str, selection: str, config: Mapping[str, Any]) -> FileKind:
    """Return the kind of files that hold the very capture, or part of one, that is about to be written.

    One of our captures that is damaged beyond reading is one, too: the same command mends it.

    Parameters
    ----------
    capture_hash, selection
        Of the capture; which part of it, in words.
    config
        The configuration, to list what differs.
    """

    def objection(path: Path) -> str | None:
        other_kind = CAPTURE.objection(path)
        if other_kind is not None or _is_damaged_capture(path):
            return other_kind
        with open_hdf5(path) as file:
            stored = get_attributes(file)
        part = str(stored.get(SELECTION, "a part of it" if PART in stored else WHOLE))
        if stored.get("capture_hash") == capture_hash and part == selection:
            return None
        theirs, ours = comparable_config(json_object(stored.get("config"))), comparable_config(config)
        found = [f"{key}: {old} there, {new} now" for key, old, new in differences(theirs, ours)]
        if part != selection:
            found.append(f"{part} there, {selection} now")
        reason = listed(found or ["a mesh or texture has changed"])
        return f"holds another capture ({reason}). Use --overwrite to replace it, or name another output."

    return FileKind(objection)
