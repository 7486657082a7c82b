"""A check of a data set as a page: every capture's verdict and numbers, and pictures of those that differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nlosrender import __version__
from nlosrender.analysis.comparison.dataset import DatasetCheck
from nlosrender.analysis.comparison.difference_view import DifferenceView, difference_view
from nlosrender.analysis.laser_view import dotted, lit_window
from nlosrender.analysis.pages.html_page import colored, curve, write_page
from nlosrender.analysis.theme import COLORMAP
from nlosrender.errors import FileError

MAX_PICTURED = 50  # captures; each reads a laser point of both files again
DIFFERENCE_COLORS = "RdBu_r"


def write_check_page(path: Path, check: DatasetCheck, folder: Path, reference: Path) -> None:
    """Write the page of a check of ``folder`` against ``reference``.

    Raises
    ------
    FileError
        It cannot be written, or would replace a file of another kind.
    """
    differing = [file for file in check.files if file.report and file.report.get("worst")]
    pictured = sorted(differing, key=lambda file: file.status == "ok")[:MAX_PICTURED]  # stable: else as they come
    entries = []
    for number, file in enumerate(check.files, start=1):
        compared = file.report is not None and not file.report["structure"]
        shown = file.report is not None and not file.report.get("identical")
        entry: dict[str, Any] = {"file": file, "number": number, "report": file.report}
        entries.append(entry | {"compared": compared, "shown": shown, "pictures": None, "unread": ""})
        if file.report is not None and file in pictured:
            try:
                laser = file.report["worst"]["laser"]
                view = difference_view(folder / file.name, reference / file.name, (laser[0], laser[1]))
                entries[-1]["pictures"] = _pictures(view)
            except FileError as error:  # gone or changed since it was checked
                entries[-1]["unread"] = str(error)
    write_page(
        path,
        "check.html",
        title=f"check of {folder}",
        folder=str(folder),
        reference=str(reference),
        version=__version__,
        files=entries,
        extra=check.extra,
        n_failed=len(check.files) - len(check.with_status("ok")),
        pictured=MAX_PICTURED,
        n_unpictured=len(differing) - len(pictured),
    )


def _pictures(view: DifferenceView) -> dict[str, Any]:
    first, last = lit_window(view.histogram + view.reference_histogram)
    histograms = [values[first : last + 1] for values in (view.histogram, view.reference_histogram)]
    top = max(float(values.max()) for values in histograms)
    ends = [view.header.start_opl + index * view.header.bin_width_opl for index in (first, last + 1)]
    return {
        "laser": view.laser,
        "sensor": view.sensor,
        "walls": _walls(view),
        "new": curve(histograms[0], top),
        "old": curve(histograms[1], top),
        "top": top,
        "span": f"{ends[0]:.4g} to {ends[1]:.4g} m of optical path",
    }


def _walls(view: DifferenceView) -> list[dict[str, str]]:
    """Return both walls on one scale, and their difference on a scale of its own with zero in the middle."""
    difference = view.wall - view.reference_wall
    top = max(float(view.wall.max()), float(view.reference_wall.max()), 0.0)
    most = float(np.abs(difference).max())
    unit = view.header.unit
    new, old, change = (dotted(view.points, wall) for wall in (view.wall, view.reference_wall, difference))
    return [
        {"uri": colored(new, COLORMAP, 0, top), "caption": "new", "range": f"0 to {top:.3g} {unit}"},
        {"uri": colored(old, COLORMAP, 0, top), "caption": "reference", "range": "same scale"},
        {
            "uri": colored(change, DIFFERENCE_COLORS, -most, most),
            "caption": "new - reference: red brighter, blue darker",
            "range": f"-{most:.3g} to {most:.3g} {unit}",
        },
    ]
