"""Pictures of the page: the theme of all other pictures, and the few kinds of axes that figures need."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.theme import COLORMAP, FAINT, GROUND, INK, style
from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PNG

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Float64 = NDArray[np.float64]
BRIGHT = 99.7  # percentile of the light that is drawn white: noise has single bins far above it


def new_figure(rows: int, columns: int, width: float, height: float) -> tuple[Figure, NDArray[Any]]:
    """Return a dark figure of ``width`` x ``height`` inches and its (rows, columns) axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor=GROUND, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for part in axes.flat:
        style(part)
    return figure, axes


def save(figure: Figure, path: Path) -> Path:
    """Write a picture.

    Raises
    ------
    FileError
        It cannot be written.
    """
    with replacing(path, PNG) as partial:
        figure.savefig(partial, dpi=110, facecolor=GROUND, format="png")
    return path


def show_row(axes: Axes, row: Float64, edges: Float64, half_width: float, title: str, top: float | None = None) -> None:
    """Draw one row of sensor points over time: (point, bin)."""
    top = np.percentile(row, BRIGHT) if top is None else top
    extent = (edges[0], edges[-1], -half_width, half_width)
    axes.imshow(
        np.sqrt(np.clip(row / max(top, 1e-300), 0, 1)), origin="lower", aspect="auto", extent=extent, cmap=COLORMAP
    )
    style(axes, title, "optical path [m]", "wall x [m]")


def show_wall(axes: Axes, wall: Float64, half_width: float, title: str, top: float | None = None) -> None:
    """Draw one value per sensor point: (y, x)."""
    top = np.percentile(wall, BRIGHT) if top is None else top
    extent = (-half_width, half_width, -half_width, half_width)
    axes.imshow(np.clip(wall / max(top, 1e-300), 0, 1), origin="lower", extent=extent, cmap=COLORMAP)
    style(axes, title)
    axes.set(xticks=[], yticks=[])


def frames_at(light: Float64, shares: Float64, energy: Float64, bins_per_frame: float) -> list[tuple[int, Float64]]:
    """Return moments of a capture as bins, and the light summed over a few bins around each.

    Parameters
    ----------
    light
        (..., bin).
    shares
        Of the energy that has arrived by then.
    energy
        (bin,) that they are shares of.
    bins_per_frame
        Half a frame's length, in shares of all bins.
    """
    reach, arrived = max(1, int(light.shape[-1] * bins_per_frame)), energy.cumsum()
    moments = [int(np.searchsorted(arrived, share * arrived[-1])) for share in shares]
    return [(moment, light[..., max(0, moment - reach) : moment + reach + 1].sum(axis=-1)) for moment in moments]


def log_log(axes: Axes, title: str, xlabel: str, ylabel: str) -> None:
    """Make ``axes`` log-log with a legend of its labelled lines."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    style(axes, title, xlabel, ylabel)
    axes.grid(color="#22242c", which="major")
    axes.legend(facecolor=GROUND, edgecolor=FAINT, labelcolor=INK, fontsize=8)
