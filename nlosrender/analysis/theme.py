"""The look of the pictures: dark ground, one perceptual colour map, units in the labels."""

from __future__ import annotations

from math import floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from nlosrender.constants import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase
    from matplotlib.image import AxesImage

GROUND, INK, FAINT, EDGE, PANEL = "#0e0f14", "#e8e8ee", "#8b8d98", "#34363f", "#000004"
MARK = "#7fd6ff"
COLORMAP = "inferno"
TITLE_SIZE, TICK_SIZE = 10.5, 8.5
M_PER_NS = SPEED_OF_LIGHT * 1e-9


def style(axes: Axes, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Give ``axes`` the dark look, a title and labels."""
    axes.set_facecolor(PANEL)
    for spine in axes.spines.values():
        spine.set_color(EDGE)
    axes.tick_params(colors=FAINT, labelsize=TICK_SIZE, which="both")
    axes.set_title(title, color=INK, size=TITLE_SIZE)
    axes.set_xlabel(xlabel, color=FAINT)
    axes.set_ylabel(ylabel, color=FAINT)


def color_bar(figure: FigureBase, image: AxesImage, axes: Axes, label: str) -> None:
    """Add the colour scale of ``image`` beside ``axes``, with few enough ticks for a square-root scale."""
    from matplotlib.ticker import MaxNLocator

    bar = figure.colorbar(image, ax=axes, pad=0.02, fraction=0.06, ticks=MaxNLocator(4))
    bar.set_label(label, color=FAINT)
    bar.ax.tick_params(colors=FAINT, labelsize=TICK_SIZE)
    bar.outline.set_edgecolor(EDGE)


def add_nanoseconds(axes: Axes) -> None:
    """Add a second scale above ``axes``, whose x axis is an optical path length [m]."""

    def to_ns(opl: Any) -> Any:
        return opl / M_PER_NS

    def to_opl(time: Any) -> Any:
        return time * M_PER_NS

    scale = axes.secondary_xaxis(1.0, functions=(to_ns, to_opl))
    scale.tick_params(colors=FAINT, labelsize=TICK_SIZE)
    scale.set_xlabel("time [ns]", color=FAINT)


def line_colors(number: int) -> list[tuple[float, ...]]:
    """Return ``number`` colours from bright to dark, for the bounces from the lowest up."""
    from matplotlib import colormaps

    return [tuple(color) for color in colormaps["plasma"](np.linspace(0.9, 0.35, max(number, 1)))][:number]


def power_of_ten(top: float) -> tuple[float, str]:
    """Return the power of ten to divide by so that ``top`` becomes 1 to 10, and how a unit's label says so."""
    if top <= 0:
        return 1.0, ""
    exponent = floor(log10(top))
    # matplotlib's own offset text would lie under the second time scale
    return (1.0, "") if exponent == 0 else (10.0**exponent, rf"10$^{{{exponent}}}$ ")
