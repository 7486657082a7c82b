"""Sizes and durations as people read them, a few digits and the unit that suits; text from files, safe to print."""

from __future__ import annotations

_DURATIONS = ((100.0, 1.0, "s"), (6000.0, 60.0, "min"), (172_800.0, 3600.0, "h"), (6e7, 86_400.0, "days"))  # below, s
_JULIAN_YEAR = 31_557_600.0  # s
SHOWN_LENGTH = 160  # characters of one value in a table; --json has all of it


def readable_size(n_bytes: float) -> str:
    """Return a number of bytes with three digits and a decimal unit: "1.25 GB"."""
    size = float(n_bytes)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 999.5:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def readable_duration(seconds: float) -> str:
    """Return a time [s] with two digits: "0.35 s", "4.2 min", "3.1e+13 years"."""
    for bound, size, unit in _DURATIONS:
        if seconds < bound:
            return f"{_two_digits(seconds / size)} {unit}"
    return f"{_two_digits(seconds / _JULIAN_YEAR)} years"


def printable(text: object, max_length: int = SHOWN_LENGTH) -> str:
    """Return text from a file as one line that is safe to print, cut to ``max_length`` characters."""
    # attributes are anybody's: control characters would reach the terminal
    shown = "".join(character if character.isprintable() else ascii(character)[1:-1] for character in str(text))
    return shown if len(shown) <= max_length else shown[:max_length] + " ..."


def _two_digits(number: float) -> str:
    if 1 <= number < 9.95:
        return f"{number:.1f}"
    return f"{number:.0f}" if 9.95 <= number < 10_000 else f"{number:.2g}"
