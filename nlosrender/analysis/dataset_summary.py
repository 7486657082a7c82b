"""What a folder of captures holds: counts, splits, sizes, failures, spreads, from its index alone."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nlosrender.files.dataset_index import read_index

QUANTILES = {"lowest": 0.0, "median": 0.5, "highest": 1.0}
MAX_LISTED = 20  # failures that are listed


def dataset_summary(folder: str | Path) -> dict[str, Any]:
    """Return what a dataset holds, as plain values.

    Raises
    ------
    FileError
        There is no index, or it is damaged.
    """
    folder = Path(folder)
    index = read_index(folder)
    captures = index["captures"]
    done = [entry for entry in captures if entry["status"] == "done"]
    failed = [entry for entry in captures if entry["status"] == "failed"]
    sizes = [path.stat().st_size for entry in done if (path := folder / entry["file"]).is_file()]
    return {
        "source": index["source"],
        "captures": len(captures),
        "status": dict(Counter(entry["status"] for entry in captures)),
        "splits": dict(Counter(entry["split"] for entry in captures if entry["split"])),
        "labels": dict(
            Counter(str(entry["label"]) for entry in captures if entry["label"] is not None).most_common(20)
        ),
        "keys": index["keys"],
        "files_drawn": len({file["file"] for entry in captures for file in entry["files"].values()}),
        "in_two_splits": sorted(_in_two_splits(captures)),
        "missing_files": len(done) - len(sizes),
        "bytes": sum(sizes),
        "bytes_per_capture": _spread(sizes),
        "energy": _spread([sum(entry["energy"].values()) for entry in done if entry["energy"]]),
        "error_estimate": _spread([entry["error_estimate"] for entry in done]),
        "target_missed": sum(entry["target_missed"] for entry in done),
        "error_unknown": sum(entry["error_estimate"] is None for entry in done),
        "seconds": _spread([entry["seconds"] for entry in done]),
        "seconds_in_all": sum(entry["seconds"] or 0.0 for entry in done),
        "failures": [{name: entry[name] for name in ("index", "file", "message")} for entry in failed[:MAX_LISTED]],
    }


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    return {name: float(np.quantile(known, share)) for name, share in QUANTILES.items()} if known else None


def _in_two_splits(captures: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield files whose content captures of several splits hold, under whatever names."""
    splits: dict[str, set[str]] = defaultdict(set)
    names: dict[str, str] = {}
    for entry in captures:
        for file in entry["files"].values():
            content = file["sha256"] or file["file"]
            splits[content].add(entry["split"])
            names.setdefault(content, file["file"])
    yield from (names[content] for content, found in splits.items() if len(found - {None}) > 1)
