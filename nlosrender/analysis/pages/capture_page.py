"""One capture as a page: pictures, bounces, stated error, warnings, what was skipped, time, configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nlosrender import __version__
from nlosrender.analysis.capture_table import summary_rows
from nlosrender.analysis.laser_view import (
    LaserView,
    dotted,
    laser_view,
    list_on_wall,
    lit_window,
    moments,
    point_histograms,
    row_over_time,
)
from nlosrender.analysis.pages.html_page import Float64, colored, curve, write_page
from nlosrender.analysis.summary import summarise
from nlosrender.analysis.theme import COLORMAP
from nlosrender.constants import opl_to_seconds
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.attributes import json_object
from nlosrender.files.file_kinds import PAGE
from nlosrender.files.reading.reader import StoredCapture, open_capture

DECADES = 5  # shown of the histograms
MAX_ROW_LINES = 400  # of the row over time
APART = {"energy", "error per bounce", "seconds", "WARNING", "skipped", "NOT SAMPLED", "ZERO BECAUSE"}  # own sections


def write_capture_page(path: Path, page: Path) -> None:
    """Write the page of a capture.

    Raises
    ------
    FileError
        The capture cannot be read, or the page not written, or it would replace a file of another kind.
    """
    check_writable(page, PAGE, [path])  # before the work, not after it
    summary = summarise(path)
    try:
        with open_capture(path) as capture:
            pictures, unread = _pictures(capture), ""
            config = json_object(capture.header.attributes.get("config"))
    except FileError as error:  # what its metadata says is worth showing
        pictures, unread, config = None, str(error), {}
    write_page(
        page,
        "capture.html",
        [path],
        title=path.name,
        version=__version__,
        summary=summary,
        facts=[(label, text) for label, text in summary_rows(summary) if label not in APART],
        bounces=_bounces(summary),
        seconds=numbers(summary["seconds"]),
        config=yaml.safe_dump(config, sort_keys=False, allow_unicode=True) if config else "",
        pictures=pictures,
        unread=unread,
    )


def _bounces(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return energy, its standard error, share and the stated error of every bounce; nothing where none is stated."""
    names = ("energy", "energy_error_per_bounce", "error_estimate_per_bounce")
    energies, errors, stated = (numbers(summary[name]) for name in names)
    total = sum(energies.values())
    return [
        {
            "name": name,
            "energy": energy,
            "error": errors.get(name),
            "share": energy / total if total > 0 else 0.0,
            "stated": stated.get(name),
        }
        for name, energy in energies.items()
    ]


def numbers(found: object) -> dict[str, float]:
    """Return what is a number in a mapping; attributes are anybody's."""
    values = found if isinstance(found, Mapping) else {}
    return {str(name): float(value) for name, value in values.items() if isinstance(value, (int, float))}


def _pictures(capture: StoredCapture) -> dict[str, Any]:
    """Return the pictures of the laser point in the middle."""
    header = capture.header
    view = laser_view(capture, (header.sizes["laser_y"] // 2, header.sizes["laser_x"] // 2))
    first, last = lit_window(view.time)
    ends = [header.start_opl + index * header.bin_width_opl for index in (first, last + 1)]
    row, column = view.brightest
    histograms = point_histograms(capture, view.laser, (row, column))[:, first : last + 1]
    over_time = row_over_time(capture, view.laser, row)[:, first : last + 1].T
    over_time = np.array([lines.max(axis=0) for lines in np.array_split(over_time, min(len(over_time), MAX_ROW_LINES))])
    top = max(float(over_time.max()), 0.0)
    return {
        "laser": view.laser if header.scan_type == "exhaustive" else None,
        "frames": _frames(capture, view),
        "brightest": (row, column),
        "is_list": header.is_list(),
        "curves": _curves(capture, histograms),
        "top": float(histograms.max()),
        "span": f"{ends[0]:.4g} to {ends[1]:.4g} m ({_ns(ends[0])} to {_ns(ends[1])} ns)",
        # square root: one bright front would leave everything behind it black
        "row": colored(np.sqrt(np.maximum(over_time, 0)), COLORMAP, 0, top**0.5),
        "unit": header.unit,
    }


def _frames(capture: StoredCapture, view: LaserView) -> list[dict[str, str]]:
    """Return the wall as all of time sums up, then at a few moments, each on its own scale."""
    found = moments(capture, view)
    captions = ["all bins", *(f"{opl:.3f} m, {_ns(opl)} ns" for opl in found.opl)]
    shown = [view.wall, *found.light]
    tops = [max(float(frame.max()), 0.0) for frame in shown]
    points = list_on_wall(capture)
    return [
        {"uri": colored(dotted(points, frame), COLORMAP, 0, top), "caption": caption, "range": f"0 to {top:.3g}"}
        for frame, top, caption in zip(shown, tops, captions, strict=True)
    ]


def _curves(capture: StoredCapture, histograms: Float64) -> list[dict[str, str]]:
    """Return name and points of each lit bounce's histogram, on one logarithmic scale of ``DECADES``."""
    header = capture.header
    floor = max(float(histograms.max()), 0.0) * 10.0**-DECADES
    return [
        {
            "name": header.bounce_name(header.bounce_indices[slot]),
            "points": curve(np.log10(np.maximum(values, floor) / floor), DECADES),
        }
        for slot, values in enumerate(histograms)
        if floor > 0 and (values > 0).any()
    ]


def _ns(opl: float) -> str:
    return f"{opl_to_seconds(opl) * 1e9:.2f}"
