"""The index of a dataset: which capture holds what, as one JSON file beside the captures."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from nlosrender.errors import FileError
from nlosrender.files.atomic_write import replacing
from nlosrender.files.attributes import json_object, text_list
from nlosrender.files.capture_results import UNSAMPLED
from nlosrender.files.file_kinds import INDEX
from nlosrender.files.parts.shards import PART
from nlosrender.files.reading.reader import read_header

FORMAT_VERSION = 1

Status = Literal["done", "pending", "failed"]


@dataclass(frozen=True)
class IndexEntry:
    """One capture of a dataset; what only a finished one can tell is None before."""

    index: int
    file: str  # relative to the index's folder
    values: Mapping[str, Any]  # of the keys that differ between the captures
    status: Status
    capture_hash: str | None = None  # of the configuration, without where and on what it is rendered
    config_hash: str | None = None
    energy: Mapping[str, float] | None = None  # H summed over the capture, by bounce [J m^-2 sr^-1]
    error_estimate: float | None = None  # relative L2 of H; None: not known
    seconds: float | None = None  # of the run that finished it
    message: str | None = None  # why it failed
    unsampled_paths: Sequence[str] = ()  # classes of paths whose light is missing
    files: Mapping[str, Any] = field(default_factory=dict)  # drawn ones by key: {"file": name, "sha256": digest}


def stored_entry(entry: IndexEntry, path: Path) -> IndexEntry:
    """Return a pending entry completed by what its file says; as it is, unless the file holds all of this capture."""
    try:
        attributes = read_header(path).attributes
    except FileError:  # missing, or no capture: to be rendered
        return entry
    if attributes.get("capture_hash") != entry.capture_hash or PART in attributes:
        return entry
    error, stored = attributes.get("error_estimate"), attributes.get("config_hash")
    return replace(
        entry,
        status="done",
        config_hash=stored if isinstance(stored, str) else None,
        energy=json_object(attributes.get("energy")),
        error_estimate=error if isinstance(error, float) and math.isfinite(error) else None,
        unsampled_paths=text_list(attributes, UNSAMPLED),
        seconds=json_object(attributes.get("seconds")).get("total"),
    )


def relative_name(path: Path, folder: Path) -> str:
    """Return a file's name as the index has it."""
    return Path(os.path.relpath(path.absolute(), folder)).as_posix()


def write_index(path: Path, source: str, keys: Sequence[str], entries: Sequence[IndexEntry]) -> None:
    """Write the index at ``path``; it appears whole or not at all.

    Parameters
    ----------
    source
        What the captures were made from.
    keys
        The keys that differ between them.
    entries
        All captures, in their order.

    Raises
    ------
    FileError
        It cannot be written.
    """
    content = {
        "format_version": FORMAT_VERSION,
        "source": source,
        "keys": list(keys),
        "captures": [asdict(entry) for entry in entries],
    }
    with replacing(path, INDEX) as partial:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
