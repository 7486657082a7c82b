"""The configurations of ``configs/``, which travel with the package, and the files they name.

``examples/`` holds links to ``configs/`` and ``scenes/``; a wheel has their files in its place.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from nlosrender.errors import OptionError, did_you_mean

FOLDER = Path(__file__).parents[1] / "examples"
_FILES = re.compile(r"(?:\.\./scenes/)?[\w*-]+\.(?:csv|ply|xml)\b")


@dataclass(frozen=True)
class Example:
    """A configuration that can stand in any folder, with the files that it names beside it."""

    text: str
    files: tuple[Path, ...]


def example_names() -> tuple[str, ...]:
    """Return the names of the examples, in alphabetical order."""
    return tuple(sorted(path.stem for path in (FOLDER / "configs").glob("*.yaml")))


def read_example(name: str, file: str = "capture.yaml") -> Example:
    """Return an example as the content of ``file``: it writes and reads beside itself.

    Raises
    ------
    OptionError
        There is no such example.
    """
    if name not in example_names():
        known = example_names()
        hint = did_you_mean(name, known)
        raise OptionError(f"--example: got {name!r}, need one of {', '.join(known)}. {hint}".rstrip())
    configs = FOLDER / "configs"
    text = (configs / f"{name}.yaml").read_text(encoding="utf-8")
    files = {path for pattern in _FILES.findall(text) for path in configs.glob(pattern)}
    text = text.replace("../scenes/", "").replace(f"configs/{name}.yaml", file)
    return Example(re.sub(r"\bout/", "", text), tuple(sorted(files)))
