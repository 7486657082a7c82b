"""What one reproduced figure or table consists of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Picture:
    """A picture file and the sentence under it."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True)
class Check:
    """A statement about numbers of this run that holds or does not."""

    statement: str
    holds: bool


@dataclass(frozen=True)
class PaperFigure:
    """One figure or table of the paper beside what was measured here."""

    name: str  # "Figure 4"
    title: str
    reported: str  # what the paper shows
    measured: str  # the numbers of this run
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    checks: tuple[Check, ...] = ()
    differs: str = ""  # where the result is another one than the paper's, and why
    configurations: tuple[str, ...] = ()
    seed: int = 0
    seconds: float = 0.0  # of the whole figure, rendering included

    @property
    def holds(self) -> bool:
        """Whether every check does."""
        return all(check.holds for check in self.checks)

    def report(self, folder: Path) -> dict[str, Any]:
        """Return all as plain values, pictures relative to ``folder``."""
        plain = asdict(self)
        plain["pictures"] = [
            {"path": relative_name(picture.path, folder), "caption": picture.caption} for picture in self.pictures
        ]
        return plain


def relative_name(path: Path, folder: Path) -> str:
    """Return a file's name as seen from ``folder``."""
    return path.resolve().relative_to(folder.resolve()).as_posix()
