"""How a picture is drawn: theme, size, resolution, scale of the frames."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from nlosrender.analysis.drawn_picture import DOTS_PER_INCH
from nlosrender.analysis.theme import THEMES, Theme
from nlosrender.errors import OptionError, did_you_mean

USUAL_SIZE = (14.0, 7.6)  # inches: five frames fit beside each other
SMALLEST, LARGEST = (6.5, 3.6), 60.0  # inches: below, the text of the panels overlaps; a poster
MIN_DPI, MAX_DPI = 20.0, 1200.0
MAX_PIXELS = 20_000  # of a side
LEAST_TEXT = 0.6  # of the usual size: 5 points for the numbers at the axes


@dataclass(frozen=True)
class PictureStyle:
    """The look of a picture of a capture.

    Raises
    ------
    OptionError
        A value is out of range; the option is named.
    """

    theme: str = "dark"
    size: tuple[float, float] = USUAL_SIZE  # inches, width and height
    dots_per_inch: float = DOTS_PER_INCH
    shared_scale: bool = False  # of the frames; else each has its own

    def __post_init__(self) -> None:
        if self.theme not in THEMES:
            hint = did_you_mean(self.theme, THEMES)
            raise OptionError(f"--theme: got {self.theme!r}, need one of {', '.join(THEMES)}. {hint}".rstrip())
        if not all(least <= side <= LARGEST for side, least in zip(self.size, SMALLEST, strict=True)):
            width, height = self.size
            least = " x ".join(f"{side:g}" for side in SMALLEST)
            raise OptionError(f"--size: got {width:g} x {height:g} inches, need {least} to {LARGEST:g} x {LARGEST:g}")
        if not MIN_DPI <= self.dots_per_inch <= MAX_DPI:
            raise OptionError(f"--dpi: got {self.dots_per_inch:g}, need {MIN_DPI:g} to {MAX_DPI:g}")
        if max(self.size) * self.dots_per_inch > MAX_PIXELS:
            pixels = max(self.size) * self.dots_per_inch
            raise OptionError(f"--dpi: makes {pixels:.0f} pixels of a side, need at most {MAX_PIXELS}")

    @property
    def look(self) -> Theme:
        """The theme, with text that suits the size."""
        scale = min(side / usual for side, usual in zip(self.size, USUAL_SIZE, strict=True))
        return replace(THEMES[self.theme], text_scale=min(max(scale, LEAST_TEXT), 2.0))


def picture_size(text: str | None) -> tuple[float, float]:
    """Return the inches in ``7x4`` or ``18x10cm``; OptionError where there are none."""
    if text is None:
        return USUAL_SIZE
    match = re.fullmatch(r"\s*([0-9.]{1,9})\s*x\s*([0-9.]{1,9})\s*(in|cm|mm)?\s*", text, re.ASCII)
    unit = {"cm": 2.54, "mm": 25.4}.get(match[3], 1.0) if match else 1.0
    try:
        width, height = (float(part) / unit for part in match.groups()[:2]) if match else (None, None)
    except ValueError:
        width = height = None
    if width is None or height is None:
        raise OptionError(f"--size: got {text!r}, need a width and a height in inches or cm, such as 7x4 or 18x10cm")
    return width, height
