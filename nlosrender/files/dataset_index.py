"""The index of a dataset: which capture holds what, as one JSON file beside the captures."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import TypeAdapter

from nlosrender.errors import FileError
from nlosrender.files.atomic_write import replacing
from nlosrender.files.attributes import json_object, text_list
from nlosrender.files.capture_results import MISSED, UNSAMPLED
from nlosrender.files.file_kinds import INDEX, TABLES
from nlosrender.files.identity import file_digest
from nlosrender.files.parts.shards import PART
from nlosrender.files.reading.reader import read_header

if TYPE_CHECKING:
    from nlosrender.config.sweep_load import CaptureFacts, Sweep

INDEX_NAME = "index.json"
SHARD_INDICES = "index-*-of-*.json"
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
    split: str | None = None  # train, val or test
    label: Any = None  # what it shows
    target_missed: bool = False  # whether the stated error is above render.target_error


def entry_of(index: int, file: str, facts: CaptureFacts, folder: Path | None = None) -> IndexEntry:
    """Return the entry of a capture that is still to be rendered, or looked at.

    Parameters
    ----------
    index, file
        As in the entry.
    facts
        What the sweep says of it.
    folder
        Where names of drawn files start; None: their digests are left for later.
    """
    files = {
        key: {"file": name, "sha256": None if folder is None else file_digest(folder / name)}
        for key, name in facts.files.items()
    }
    return IndexEntry(index, file, facts.values, "pending", files=files, split=facts.split, label=facts.label)


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
        target_missed=MISSED in attributes,
        seconds=json_object(attributes.get("seconds")).get("total"),
    )


def relative_name(path: Path, folder: Path) -> str:
    """Return a file's name as the index has it."""
    return Path(os.path.relpath(path.absolute(), folder)).as_posix()


def write_index(path: Path, sweep: Sweep, entries: Sequence[IndexEntry]) -> None:
    """Write the index at ``path`` (.json), and the same as a table beside it; each appears whole or not at all.

    Parameters
    ----------
    sweep
        What the captures were made from.
    entries
        All captures, in their order.

    Raises
    ------
    FileError
        It cannot be written.
    """
    content = {
        "format_version": FORMAT_VERSION,
        "source": sweep.source,
        "keys": list(sweep.keys),
        "dataset": sweep.dataset.model_dump(mode="json"),
        "captures": [asdict(entry) for entry in entries],
    }
    with replacing(path, INDEX) as partial:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_table(path.with_suffix(f".{sweep.dataset.index}"), [asdict(entry) for entry in entries])


def write_table(path: Path, captures: Sequence[Mapping[str, Any]], shards: Mapping[int, str] | None = None) -> None:
    """Write captures of an index as a table, .csv or .parquet: a row each, a column for every drawn value.

    Parameters
    ----------
    shards
        Name of the shard of a package that holds a capture, by its index.

    Raises
    ------
    FileError
        It cannot be written, or the package pyarrow is missing.
    """
    keys = list(dict.fromkeys(key for capture in captures for key in capture["values"]))
    plain = ("index", "file", "status", "split", "label", "error_estimate", "target_missed", "seconds", "message")
    rows = []
    for capture in captures:
        row = {name: capture.get(name) for name in plain} | {"shard": (shards or {}).get(capture["index"])}
        row["energy"] = sum(capture["energy"].values()) if capture["energy"] else None
        row |= {f"sha256 {key}": file["sha256"] for key, file in capture["files"].items()}
        rows.append(row | {key: _cell(capture["values"].get(key)) for key in keys})
    columns = list(dict.fromkeys([*plain, "shard", "energy", *(name for row in rows for name in row)]))
    with replacing(path, TABLES[path.suffix]) as partial:
        if path.suffix == ".csv":
            with partial.open("w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, columns, lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
        else:
            table = {name: _alike([row.get(name) for row in rows]) for name in columns}
            pyarrow().parquet.write_table(pyarrow().table(table), partial)


def _alike(column: list[Any]) -> list[Any]:
    """Return a column of values of one type: as text, where they are of several."""
    numbers = {float if kind is int else kind for kind in (type(value) for value in column if value is not None)}
    return column if len(numbers) < 2 else [None if value is None else str(value) for value in column]


def pyarrow() -> Any:
    """Return the package that writes .parquet files, an optional one (FileError)."""
    try:
        import pyarrow.parquet
    except ImportError as error:
        message = "dataset.index: parquet needs the package pyarrow: pip install 'nlosrender[parquet]', or index: csv."
        raise FileError(message) from error
    return pyarrow


def has_index(folder: Path) -> bool:
    """Return whether a folder has an index of its captures, or those of shards."""
    return (folder / INDEX_NAME).is_file() or any(folder.glob(SHARD_INDICES))


def read_index(folder: str | Path) -> dict[str, Any]:
    """Return the index of a dataset's folder; where only those of shards are there, what they say together.

    Raises
    ------
    FileError
        There is none, or it is damaged.
    """
    folder = Path(folder)
    whole = folder / INDEX_NAME
    paths = [whole] if whole.is_file() else sorted(folder.glob(SHARD_INDICES))
    if not paths:
        raise FileError(f"{folder}: holds no {INDEX_NAME}. Name the folder that a sweep was rendered into.")
    contents = []
    for path in paths:
        try:
            contents.append(json.loads(path.read_text(encoding="utf-8")))
            contents[-1]["captures"] = [asdict(_checked(IndexEntry(**entry))) for entry in contents[-1]["captures"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = "; ".join(str(error).splitlines()[:3])  # pydantic's own text runs over several
            raise FileError(f"{path}: is no index of captures: {reason}") from error
    captures = sorted(
        (entry for content in contents for entry in content["captures"]), key=lambda entry: entry["index"]
    )
    return {**contents[0], "captures": captures}


def _checked(entry: IndexEntry) -> IndexEntry:
    """Return an entry of a file as it is; ValueError where a value is of another type."""
    return _adapter().validate_python(asdict(entry))


@cache
def _adapter() -> TypeAdapter[IndexEntry]:
    return TypeAdapter(IndexEntry)


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, (str, int, float, bool)) else json.dumps(value)
