"""The map of the reproduction: every figure and table of the paper, in the paper's order."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from nlosrender.bench.paper.ablation import ablation
from nlosrender.bench.paper.binning import time_binning
from nlosrender.bench.paper.convergence import convergence
from nlosrender.bench.paper.curved_walls import curved_walls
from nlosrender.bench.paper.figure import PaperFigure
from nlosrender.bench.paper.light_in_flight import light_in_flight
from nlosrender.bench.paper.page import write_page
from nlosrender.bench.paper.polarised_light import polarised_light
from nlosrender.bench.paper.rooms import closed_rooms
from nlosrender.bench.paper.scenes_table import scenes_table
from nlosrender.bench.paper.silhouettes import silhouettes
from nlosrender.bench.paper.study import Study
from nlosrender.bench.paper.wavefronts import captured_letters, z_letter
from nlosrender.bench.runs import Timer
from nlosrender.files.provenance import package_versions

# by the name that --figure takes
FIGURES: Mapping[str, Callable[[Study], PaperFigure]] = {
    "1": captured_letters,
    "2": partial(light_in_flight, name="cornell-box"),
    "4": z_letter,
    "6": time_binning,
    "7": partial(light_in_flight, name="interior-mirror"),
    "7-xml": partial(light_in_flight, name="../mitsuba-scene"),
    "table1": scenes_table,
    "8": partial(ablation, name="letters-near", figure="Figure 8, Table 2", title="the four techniques, close"),
    "9": partial(
        ablation, name="letters-far", figure="Figure 9, Table 2", title="the four techniques, three times as far"
    ),
    "10": closed_rooms,
    "11": convergence,
    "12": silhouettes,
    "13": polarised_light,
    "walls": curved_walls,
}


def reproduce(
    study: Study, names: Iterable[str] = FIGURES, report_figure: Callable[[PaperFigure], None] = lambda figure: None
) -> tuple[list[PaperFigure], Path]:
    """Make figures and the page that shows them.

    Parameters
    ----------
    study
        Where from, where to, how much.
    names
        Keys of ``FIGURES``.
    report_figure
        Called with each figure as it is finished.

    Returns
    -------
    tuple
        The figures, and the page.

    Raises
    ------
    NlosError
        A configuration, a render or a file failed.
    """
    study.make_folders()
    begun = Timer()
    facts = {
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        "setting": "quick" if study.quick else "full",
        "processors": os.cpu_count(),
        "load at start": round(os.getloadavg()[0], 2),
        **package_versions(),
    }
    figures: list[PaperFigure] = []
    page = study.folder
    for name in names:
        timer = Timer()
        figure = FIGURES[name](study)
        figures.append(replace(figure, seed=study.seed, seconds=timer.read()[0]))
        report_figure(figures[-1])
        page = write_page(figures, study.folder, facts | {"seconds": round(begun.read()[0], 1)})
    return figures, page
