"""The lines of an .obj file by their keywords: continued ones joined, comments cut off, unread ones counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nlosrender.scene.meshes.file_mesh import some_of

_READ = (b"v", b"vt", b"vn", b"f")
_NO_SURFACE = {b"l": "lines", b"p": "points", b"curv": "curves", b"curv2": "curves", b"vp": "points of curves"}
_OLD = "patches of an old kind"
_SURFACES = {b"surf": "free-form surfaces", b"fo": "faces of an old kind (fo)", b"call": "other files (call)"}
_SURFACES |= {b"bzp": _OLD, b"bsp": _OLD, b"cdp": _OLD}
_NO_EFFECT = (  # grouping, looks, and what only belongs to curves and free-form surfaces
    b"g o s mg usemtl mtllib usemap maplib lod shadow_obj trace_obj ctech stech bevel c_interp d_interp cstype deg "
    b"bmat step parm trim hole scrv sp end con cdc res csh"
).split()
_NO_MATERIAL = "none"


@dataclass(frozen=True, eq=False)
class ObjLines:
    """Lines of an .obj file; a line that ends in a backslash is one with the next."""

    lines: Sequence[bytes]  # those of v, vt, vn and f without their comments
    numbers: Sequence[int]  # where each begins in the file, from 1
    rows_by_keyword: dict[bytes, list[int]]  # indices into ``lines``

    @classmethod
    def of(cls, content: bytes) -> ObjLines:
        """Return the lines of a file."""
        lines, numbers = _joined(content)
        rows: dict[bytes, list[int]] = {}
        for row, line in enumerate(lines):
            words = line.split(None, 1)
            if words and not words[0].startswith(b"#"):
                rows.setdefault(words[0], []).append(row)
                if b"#" in line and words[0] in _READ:
                    lines[row] = line.split(b"#", 1)[0]
        return cls(lines, numbers, rows)

    def rows(self, keyword: bytes) -> list[int]:
        """Return the indices of the lines that begin with a keyword."""
        return self.rows_by_keyword.get(keyword, [])

    def place(self, row: int) -> str:
        """Return the name of a line in messages."""
        return f"line {self.numbers[row]}"

    def materials(self) -> tuple[str, ...]:
        """Return the names of the materials that faces have, in the order of the file; "none" for faces without."""
        if not self.rows(b"usemtl"):
            return ()
        lines = [self.lines[row] for row in self.rows(b"usemtl")]
        names = ["", *(" ".join(word.decode("utf-8", "replace") for word in line.split()[1:]) for line in lines)]
        owners = np.unique(np.searchsorted(self.rows(b"usemtl"), self.rows(b"f")))  # 0: before the first usemtl
        return tuple(dict.fromkeys(names[owner] or _NO_MATERIAL for owner in owners))

    def dropped(self) -> tuple[str, ...]:
        """Return what the file has beside surfaces, with how many of it."""
        counts: Counter[str] = Counter()
        for keyword, what in _NO_SURFACE.items():
            counts[what] += len(self.rows(keyword))
        found = [f"{count} {what}" for what, count in counts.items() if count]
        first = self.lines[self.rows(b"v")[0]] if self.rows(b"v") else b""
        return (*found, "vertex colours") if len(first.split()) >= 7 else tuple(found)

    def doubts(self) -> Iterator[str]:
        """Yield a sentence for each kind of line that may have held a part of the surface."""
        surfaces = sorted({what for keyword, what in _SURFACES.items() if self.rows(keyword)})
        if surfaces:
            yield f"its {some_of(surfaces)} are left out, only polygons (f) are read."
        known = {*_READ, *_NO_SURFACE, *_SURFACES, *_NO_EFFECT}
        unknown = [row for keyword, rows in self.rows_by_keyword.items() if keyword not in known for row in rows]
        if unknown:
            yield (
                f"{len(unknown)} of its lines mean nothing in an .obj file and are left out, first "
                f"{self.place(min(unknown))}: {shown(self.lines[min(unknown)])}."
            )


def shown(text: bytes) -> str:
    """Return a line or word for a message."""
    return repr(text[:60].decode("latin-1"))


def _joined(content: bytes) -> tuple[list[bytes], Sequence[int]]:
    """Return the lines, those that go on after a backslash joined, and the numbers of their beginnings in the file."""
    lines = content.splitlines()
    if b"\\\n" not in content and b"\\\r" not in content:
        return lines, range(1, len(lines) + 1)
    parts: list[list[bytes]] = []
    numbers: list[int] = []
    goes_on = False
    for number, line in enumerate(lines, start=1):
        if not goes_on:
            parts.append([])
            numbers.append(number)
        goes_on = line.endswith(b"\\") and b"#" not in line  # a comment may end in the name of a folder
        parts[-1].append(line[:-1] if goes_on else line)
    return [b" ".join(part) for part in parts], numbers
