"""A finished figure: saved as a picture, shown by notebooks."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.errors import OptionError
from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PICTURES, FileKind
from nlosrender.files.path_argument import path_argument

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")
DOTS_PER_INCH, NOTEBOOK_DOTS_PER_INCH = 130, 75  # a notebook holds its pictures: 14 inches are then about 100 kB


@dataclass(frozen=True, eq=False)
class Picture:
    """A matplotlib figure that is drawn; a notebook shows it where it is the value of a cell."""

    figure: Figure
    dots_per_inch: float = DOTS_PER_INCH  # of pixels in it, whatever its format

    def save(self, path: str | Path, sources: Iterable[str | Path] = ()) -> Path:
        """Write it as .png, .pdf or .svg, by the suffix of ``path``, and return ``path``.

        ``sources`` are files that it is made of: they are not replaced.

        Raises
        ------
        FileError
            It cannot be written, or a file of another kind is there.
        OptionError
            Pictures have no such format.
        """
        from matplotlib import rc_context

        path = path_argument("path", path)
        # TrueType: publishers refuse matplotlib's own Type 3 fonts
        with replacing(path, picture_kind(path), sources) as partial, rc_context({"pdf.fonttype": 42}):
            self.figure.savefig(partial, format=path.suffix[1:].lower(), dpi=self.dots_per_inch)
        return path

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self.figure.savefig(content, format="png", dpi=NOTEBOOK_DOTS_PER_INCH)
        return content.getvalue()


def picture_kind(path: Path) -> FileKind:
    """Return the kind of picture that a name ends in; OptionError for one that is not written."""
    if path.suffix.lower() not in FORMATS:
        raise OptionError(f"--output: got {str(path)!r}, need a name that ends in one of {', '.join(FORMATS)}")
    return PICTURES[path.suffix.lower()]
