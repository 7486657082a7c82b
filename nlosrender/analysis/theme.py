"""The look of the pictures: a dark or a light ground, one perceptual colour map, units in the labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from nlosrender.constants import SPEED_OF_LIGHT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import FigureBase


@dataclass(frozen=True)
class Theme:
    """Colours of a picture, and how much smaller than usual its text is."""

    ground: str
    ink: str
    faint: str
    edge: str
    panel: str
    mark: str
    lines: tuple[float, float]  # ends of the colour map of lines, of the first and the last
    text_scale: float = 1.0

    def size(self, points: float) -> float:
        """Return the size of text that is ``points`` high in a picture of the usual size."""
        return points * self.text_scale


DARK = Theme("#0e0f14", "#e8e8ee", "#8b8d98", "#34363f", "#000004", "#7fd6ff", (0.9, 0.35))
LIGHT = Theme("#ffffff", "#16181d", "#565a64", "#c3c7cf", "#ffffff", "#d55e00", (0.0, 0.75))
THEMES = {"dark": DARK, "light": LIGHT}
GROUND, INK, FAINT, EDGE, PANEL, MARK = DARK.ground, DARK.ink, DARK.faint, DARK.edge, DARK.panel, DARK.mark
FRAME_MARK = DARK.mark  # on pictures in ``COLORMAP``, which are dark in every theme
COLORMAP = "inferno"
TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 10.5, 10.0, 8.5
M_PER_NS = SPEED_OF_LIGHT * 1e-9


def style(axes: Axes, title: str = "", xlabel: str = "", ylabel: str = "", theme: Theme = DARK) -> None:
    """Give ``axes`` the look of a theme, a title and labels."""
    axes.set_facecolor(theme.panel)
    for spine in axes.spines.values():
        spine.set_color(theme.edge)
    axes.tick_params(colors=theme.faint, labelsize=theme.size(TICK_SIZE), which="both")
    axes.set_title(title, color=theme.ink, size=theme.size(TITLE_SIZE))
    axes.set_xlabel(xlabel, color=theme.faint, size=theme.size(LABEL_SIZE))
    axes.set_ylabel(ylabel, color=theme.faint, size=theme.size(LABEL_SIZE))


def color_bar(
    figure: FigureBase, image: ScalarMappable, axes: Axes | list[Axes], label: str, theme: Theme = DARK
) -> None:
    """Add the colour scale of ``image`` beside ``axes``, with few enough ticks for a square-root scale."""
    from matplotlib.ticker import MaxNLocator

    low, high = image.get_clim()
    # ticks beyond the scale would stand at its end, where a clipped scale has another value
    ticks = [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high]
    bar = figure.colorbar(image, ax=axes, pad=0.02, fraction=0.06, ticks=ticks)
    bar.set_label(label, color=theme.faint, size=theme.size(LABEL_SIZE))
    bar.ax.tick_params(colors=theme.faint, labelsize=theme.size(TICK_SIZE))
    bar.outline.set_edgecolor(theme.edge)


def add_nanoseconds(axes: Axes, theme: Theme = DARK) -> None:
    """Add a second scale above ``axes``, whose x axis is an optical path length [m]."""

    def to_ns(opl: Any) -> Any:
        return opl / M_PER_NS

    def to_opl(time: Any) -> Any:
        return time * M_PER_NS

    scale = axes.secondary_xaxis(1.0, functions=(to_ns, to_opl))
    scale.tick_params(colors=theme.faint, labelsize=theme.size(TICK_SIZE))
    scale.set_xlabel("time [ns]", color=theme.faint, size=theme.size(LABEL_SIZE))


def add_legend(axes: Axes, theme: Theme = DARK) -> None:
    """Name the labelled lines of ``axes``."""
    text = {"labelcolor": theme.ink, "fontsize": theme.size(9)}
    axes.legend(facecolor=theme.panel, edgecolor="none", loc="upper right", framealpha=0.75, **text)


def line_colors(number: int, theme: Theme = DARK) -> list[tuple[float, ...]]:
    """Return ``number`` colours, for the bounces from the lowest up: away from the ground, then towards it."""
    from matplotlib import colormaps

    return [tuple(color) for color in colormaps["plasma"](np.linspace(*theme.lines, max(number, 1)))][:number]


def drawable(text: str) -> str:
    """Return text from a file with the characters that the font lacks written out, such as ``\\u6587``."""
    glyphs = _glyphs()
    known = (
        character if ord(character) in glyphs and character.isprintable() else ascii(character)[1:-1]
        for character in text
    )
    return "".join(known)


@cache
def _glyphs() -> frozenset[int]:
    """Return the characters that the bold and the regular font have, which differ."""
    from matplotlib.font_manager import findfont, get_font

    fonts = (get_font(findfont(f"DejaVu Sans:weight={weight}")) for weight in ("regular", "bold"))
    return frozenset.intersection(*(frozenset(font.get_charmap()) for font in fonts))


def power_of_ten(top: float) -> tuple[float, str]:
    """Return the power of ten to divide by so that ``top`` becomes 1 to 10, and how a unit's label says so."""
    if top <= 0:
        return 1.0, ""
    exponent = floor(log10(top))
    # matplotlib's own offset text would lie under the second time scale
    return (1.0, "") if exponent == 0 else (10.0**exponent, rf"10$^{{{exponent}}}$ ")
