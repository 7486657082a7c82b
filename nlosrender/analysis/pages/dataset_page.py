"""A folder of captures as a page: contact sheet, a table that sorts, outliers, failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nlosrender import __version__
from nlosrender.analysis.comparison.dataset import captures_below
from nlosrender.analysis.contact_sheet import SIDE, capture_pictures, entry_text, evenly, short_key, shown_value, square
from nlosrender.analysis.outliers import RULE, outliers
from nlosrender.analysis.pages.capture_page import numbers
from nlosrender.analysis.pages.html_page import curve, picture_uri, write_page
from nlosrender.analysis.summary import summarise
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.dataset_index import has_index, read_index
from nlosrender.files.file_kinds import PAGE
from nlosrender.files.reading.reader import read_header

QUANTITIES = {"energy": "energy", "error_estimate": "stated error", "seconds": "seconds"}  # that are looked at
TEXT_LETTERS = 48  # of a line below the pictures of a capture


def write_dataset_page(folder: Path, page: Path, most: int) -> None:
    """Write the page of a folder; pictures of at most ``most`` captures, outliers first, the others evenly chosen.

    Raises
    ------
    FileError
        There is no capture, or the page cannot be written, or it would replace a file of another kind.
    """
    check_writable(page, PAGE)  # before the work, not after it
    rows, unlisted = _rows(folder)
    if not rows:
        raise FileError(f"{folder}: holds no capture.")
    found = _outliers(rows)
    done = [row for row in rows if row["status"] == "done"]
    odd = [row for row in done if row["number"] in {entry["row"]["number"] for entry in found}][:most]
    others = [row for row in done if row not in odd]
    shown = odd + [others[at] for at in evenly(len(others), most - len(odd))]
    sheet = [_pictured(folder, row) for row in sorted(shown, key=lambda row: int(row["number"]))]
    write_page(
        page,
        "dataset.html",
        title=folder.resolve().name,
        folder=str(folder),
        version=__version__,
        rows=rows,
        keys={key: short_key(key) for row in rows for key in row["values"] if key != "render.seed"},
        has_splits=any(row["split"] for row in rows),
        has_labels=any(row["label"] is not None for row in rows),
        counts=Counter(row["status"] for row in rows),
        seconds=sum(row["seconds"] or 0.0 for row in rows),
        bytes=sum(row["bytes"] or 0 for row in rows),
        sheet=sheet,
        outliers=found,
        rule=RULE,
        unlisted=unlisted,
        side=SIDE,
    )


def _rows(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """Return the captures of a folder, by its index where it has one, and how many files the index lacks."""
    names = captures_below(folder)
    if not has_index(folder):
        return [_row(number, _looked_at(folder, name), folder) for number, name in enumerate(names)], 0
    entries = read_index(folder)["captures"]
    listed = {entry["file"] for entry in entries}
    rows = [_row(number, _still_there(folder, entry), folder) for number, entry in enumerate(entries)]
    return rows, sum(name not in listed for name in names)


def _looked_at(folder: Path, name: str) -> dict[str, Any]:
    """Return what an index would say of a file."""
    try:
        summary = summarise(folder / name)
    except FileError as error:
        return {"file": name, "status": "failed", "message": str(error)}
    seconds, energy = (numbers(summary[key]) for key in ("seconds", "energy"))
    stated = summary["error_estimate"]
    return {
        "file": name,
        "status": "done",
        "energy": energy,
        "error_estimate": stated if isinstance(stated, (int, float)) else None,
        "seconds": seconds.get("total"),
        "unsampled_paths": summary["unsampled_paths"],
        "target_missed": summary["target_missed"] is not None,
    }


def _still_there(folder: Path, entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return an entry of an index, as a failure where its file is damaged or gone since it was rendered."""
    try:
        if entry["status"] == "done":
            read_header(folder / entry["file"])
    except FileError as error:
        return {**entry, "status": "failed", "message": str(error)}
    return entry


def _row(number: int, entry: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    path = folder / entry["file"]
    row: dict[str, Any] = {"index": number, "values": {}, "target_missed": False}
    row |= dict.fromkeys((*QUANTITIES, "unsampled_paths", "split", "label", "message"))
    row |= dict(entry) | {"number": number}
    row["energy"] = sum(entry["energy"].values()) if entry.get("energy") else None
    row["bytes"] = path.stat().st_size if path.is_file() else None
    row["shown"] = {key: shown_value(value) for key, value in row["values"].items()}
    return row


def _outliers(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the row, quantity, value and reason of every outlier, and of captures without light or known error."""
    done = [row for row in rows if row["status"] == "done"]
    found = []
    for key, name in QUANTITIES.items():
        for at, score in outliers([row[key] for row in done]).items():
            reason = f"{'above' if score > 0 else 'below'} the median by {abs(score):.1f} robust standard deviations"
            found.append({"row": done[at], "quantity": name, "value": done[at][key], "reason": reason})
    for row in done:
        if row["energy"] == 0:
            found.append({"row": row, "quantity": "energy", "value": 0.0, "reason": "no light at all"})
        if row["error_estimate"] is None:
            reason = "light is missing" if row["unsampled_paths"] else "not stated"
            found.append({"row": row, "quantity": "stated error", "value": None, "reason": reason})
        elif row["target_missed"]:
            found.append(
                {"row": row, "quantity": "stated error", "value": row["error_estimate"], "reason": "target missed"}
            )
    return sorted(found, key=lambda entry: int(entry["row"]["number"]))


def _pictured(folder: Path, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the pictures of a capture: the scene's front, the wall at its peak, a histogram; or why there are none."""
    try:
        front, wall, histogram = capture_pictures(folder / row["file"])
    except FileError as error:
        return {"row": row, "text": [str(error)], "pictures": [], "curve": ""}
    pictures = [picture_uri(square(picture)) for picture in (front, wall) if picture is not None]
    lit = histogram.nonzero()[0]
    shown = histogram[lit[0] : lit[-1] + 1] if len(lit) else histogram
    return {"row": row, "text": entry_text(row, TEXT_LETTERS)[1:], "pictures": pictures, "curve": curve(shown, 1.0)}
