"""File names that Python programs hand over."""

from __future__ import annotations

import os
from pathlib import Path

from nlosrender.errors import OptionError


def path_argument(name: str, value: str | os.PathLike[str], need: str = "the name of a file") -> Path:
    """Return the path that the argument ``name`` is; OptionError, with what is needed, for a value of another type."""
    try:
        return Path(value)
    except TypeError as error:  # numbers, None, and bytes, whose encoding nobody knows
        raise OptionError(f"{name}: got {value!r:.60}, need {need}: text or a pathlib.Path") from error
