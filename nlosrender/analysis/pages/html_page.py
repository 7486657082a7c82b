"""Fills a template of this folder; pictures become part of the page, and everything from files is escaped."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PAGE
from nlosrender.readable import printable, readable_duration, readable_size

if TYPE_CHECKING:
    from jinja2 import Environment

Float64 = NDArray[np.float64]
MAX_TEXT = 2000  # characters of one text from a file
EMPTY = 0.45  # grey where there is no point (NaN)
MAX_CURVE = 480  # points of a histogram, which is about as many pixels wide


def write_page(path: Path, template: str, sources: Iterable[Path] = (), **values: object) -> None:
    """Fill ``template`` with ``values`` and write the page.

    Raises
    ------
    FileError
        It cannot be written, or would replace a file of another kind or one of ``sources``.
    """
    text = _environment().get_template(template).render(**values)
    with replacing(path, PAGE, sources) as partial:
        partial.write_text(text, encoding="utf-8")


def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # control characters, and halves of characters, which UTF-8 cannot hold
        finalize=lambda value: printable(value, MAX_TEXT) if type(value) is str else value,
    )
    environment.filters |= {"size": readable_size, "duration": readable_duration, "number": number, "percent": percent}
    environment.filters["lines"] = lambda text: Markup(
        escape("\n".join(printable(line, MAX_TEXT) for line in text.split("\n")))
    )
    return environment


def number(value: float | None, infinite: str = "infinite") -> str:
    """Return a number with four digits; None stands for one that is not finite."""
    return infinite if value is None else f"{value:.4g}"


def percent(share: float | None, infinite: str = "infinite") -> str:
    """Return a share in percent, signed; None stands for one that is not finite."""
    return infinite if share is None else f"{100 * share:+.3g} %"


def colored(values: Float64, colormap: str, low: float, high: float) -> str:
    """Return (rows, columns) on the wall as a picture's address: the first row at the bottom."""
    from matplotlib import colormaps

    share = (values[::-1] - low) / (high - low if high > low else 1.0)
    colors = np.asarray(colormaps[colormap](np.clip(share, 0, 1)))[..., :3]
    return picture_uri(np.round(255 * np.where(np.isnan(share)[..., None], EMPTY, colors)).astype(np.uint8))


def picture_uri(picture: NDArray[np.uint8]) -> str:
    """Return (row, column, 3) as an address that holds a PNG of it."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(picture).save(content, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode('ascii')}"


def curve(values: Float64, top: float) -> str:
    """Return (bin,) as the points of an SVG polyline in a square of 100; ``top`` is at its upper edge.

    Of bins that share a pixel the largest is shown: a narrow peak must not vanish.
    """
    shown = np.array([part.max() for part in np.array_split(values, min(len(values), MAX_CURVE))])
    x = (np.arange(len(shown)) + 0.5) / len(shown) * 100
    y = 100 - 96 * np.clip(shown / (top or 1.0), -0.04, 1)
    return " ".join(f"{across:.2f},{down:.2f}" for across, down in zip(x, y, strict=True))
