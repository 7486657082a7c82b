"""Packages of a data set: its finished captures once more, as training programs read them, in a folder beside them.

- ``webdataset``: tar shards of ``key.npz`` and ``key.json``, what the package webdataset reads;
- ``lfe``: the folders of learned feature embeddings (Chen et al. 2020): Radiance pictures;
- ``nlos3d``: the folder of that program (Mu et al. 2022): .mat files and lists of them.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nlosrender.errors import FileError, OptionError
from nlosrender.files.atomic_write import explained_write
from nlosrender.files.dataset_index import read_index, write_table
from nlosrender.interruption import uninterrupted

DESCRIPTION = "package.json"  # of a package; a folder without it is not replaced
FORMATS = ("webdataset", "lfe", "nlos3d")
WHOLE_SET = "all"  # in place of a split where there are none
Progress = Callable[[float], None]


@dataclass
class Packing:
    """A package that is being written."""

    source: Path  # the data set's folder
    folder: Path  # to be filled
    dataset: Mapping[str, Any]  # section of the configuration
    name: str  # of the data set
    shards: dict[int, str] = field(default_factory=dict)  # where each capture is, by index
    stated_errors: dict[int, float | None] = field(default_factory=dict)  # of what is stored, by index
    largest_rounding: float = 0.0  # relative L2 error that storing has added
    notes: dict[str, int] = field(default_factory=dict)  # what the format cannot hold, and of how many captures

    def note(self, text: str) -> None:
        """Add a note about one capture."""
        self.notes[text] = self.notes.get(text, 0) + 1

    def stated_error(self, entry: Mapping[str, Any], added: float) -> float | None:
        """Return the error of a stored capture, and note it: that of the render and of the rounding at their worst."""
        self.largest_rounding = max(self.largest_rounding, added)
        error = entry["error_estimate"]
        self.stated_errors[entry["index"]] = None if error is None else float(error) + added
        return self.stated_errors[entry["index"]]


def pack(folder: str | Path, file_format: str | None = None, progress: Progress = lambda share: None) -> dict[str, Any]:
    """Write a package of the finished captures of a data set; return what its ``package.json`` says.

    Parameters
    ----------
    folder
        Of the captures and their index.
    file_format
        One of ``FORMATS``; None: what the configuration says.
    progress
        Told the share that is done.

    Raises
    ------
    FileError
        There is no index or no finished capture, one does not fit the format, or the disk refuses.
    OptionError
        There is no such format.
    """
    from nlosrender.files.packages.lfe_folders import write_lfe
    from nlosrender.files.packages.nlos3d_folder import write_nlos3d
    from nlosrender.files.packages.tar_shards import write_shards

    folder = Path(folder)
    index = read_index(folder)
    wanted = file_format or index["dataset"]["format"]
    if wanted not in FORMATS:
        raise OptionError(f"--format: got {wanted!r}, need one of {', '.join(FORMATS)}")
    done = [entry for entry in index["captures"] if entry["status"] == "done"]
    if not done:
        raise FileError(f"{folder}: no capture is finished yet.")
    write = {"webdataset": write_shards, "lfe": write_lfe, "nlos3d": write_nlos3d}[wanted]
    with _replaced(folder / wanted) as filled:
        packing = Packing(folder, filled, index["dataset"], Path(index["source"]).stem)
        write(packing, done, progress)
        described = {
            "format": wanted,
            "source": index["source"],
            "captures": len(done),
            "left_out": len(index["captures"]) - len(done),
            "largest_rounding": packing.largest_rounding,
            "notes": [f"{text} ({count} captures)" for text, count in packing.notes.items()],
        }
        packed = [entry | {"error_estimate": packing.stated_errors[entry["index"]]} for entry in done]
        write_table(filled / "index.csv", packed, packing.shards)
        (filled / DESCRIPTION).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    return {"path": str(folder / wanted), **described}


def splits_of(entries: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return captures by split, ``all`` of them where there are none."""
    found: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        found.setdefault(entry["split"] or WHOLE_SET, []).append(entry)
    return found


@contextmanager
def _replaced(target: Path) -> Iterator[Path]:
    """Give the block an empty folder that takes the place of ``target`` when it ends well, else is removed."""
    with explained_write(target):
        if target.exists() and not (target / DESCRIPTION).is_file():
            raise FileError(f"{target}: exists and is no package of a data set: it is not replaced. Move it away.")
        partial = target.with_name(f".{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        try:
            yield partial
            with uninterrupted():
                shutil.rmtree(target, ignore_errors=True)
                partial.rename(target)
        finally:
            with uninterrupted():
                shutil.rmtree(partial, ignore_errors=True)
