"""The body of an ASCII .ply file, row by row: a record ends where its line does, or something has been misread."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nlosrender.scene.meshes.file_mesh import numbers_in
from nlosrender.scene.meshes.ply_header import PlyElement, PlyHeader
from nlosrender.scene.meshes.triangle_mesh import Int64
from nlosrender.scene.pose import Float64


@dataclass(eq=False)
class PlyRows:
    """The lines of the body that are not blank, taken element by element."""

    lines: list[bytes]
    numbers: Int64  # of the lines in the file, from 1
    taken: int = 0
    first_rows: dict[str, int] = field(default_factory=dict)  # of the elements taken so far

    @classmethod
    def of(cls, content: bytes, header: PlyHeader) -> PlyRows:
        """Return the rows of a file."""
        lines = content[header.size :].splitlines()
        filled = [number for number, line in enumerate(lines) if line and not line.isspace()]
        above = len(content[: header.size].splitlines())
        return cls([lines[number] for number in filled], np.array(filled, dtype=np.int64) + above + 1)

    def place(self, element: str, record: int) -> str:
        """Return the name of the line of a record in messages."""
        return f"line {self.numbers[self.first_rows[element] + record]}"

    def take(self, element: PlyElement) -> Float64:
        """Return the values of the next rows, those of an element.

        Raises
        ------
        ValueError
            A row is missing, holds a word that is no number, or has more or less values than it should.
        """
        if not element.properties:
            return np.zeros(0)
        rows = self.lines[self.taken : self.taken + element.count]
        self.first_rows[element.name] = self.taken
        n_words = np.array([len(row.split()) for row in rows], dtype=np.int64)
        values = numbers_in(b"\n".join(rows), np.float64)
        if len(values) < n_words.sum():
            words = ((row, word) for row, line in enumerate(rows) for word in line.split())
            row, word = next((row, word) for row, word in words if not len(numbers_in(word, float)))
            raise ValueError(f"{self.place(element.name, row)}: {word[:60].decode('latin-1')!r} is no number")
        if len(rows) < element.count:
            raise element.cut_short(len(rows))
        self._check_rows(element, values, np.cumsum(n_words), n_words)
        self.taken += element.count
        return values

    def refuse_rest(self, header: PlyHeader) -> None:
        """Raise a ValueError where rows are left over."""
        rest = len(self.lines) - self.taken
        if rest:
            more = f" and {rest - 1} more" if rest > 1 else ""
            raise ValueError(
                f"line {self.numbers[self.taken]}{more}: values are left over after what its header promises: "
                f"{header.promised()}"
            )

    def _check_rows(self, element: PlyElement, values: Float64, ends: Int64, n_words: Int64) -> None:
        at = ends - n_words  # of the next property in each row
        for prop in element.properties:
            if prop.count_kind is not None and len(values):
                lengths = np.where(at < ends, values[np.minimum(at, len(values) - 1)], 0.0)
                is_length = (lengths >= 0) & (lengths <= element.max_list) & (lengths == np.floor(lengths))
                for row in np.flatnonzero(~is_length)[:1]:
                    raise ValueError(f"{self.place(element.name, row)}: {element.no_length(row, lengths[row])}")
                at += lengths.astype(np.int64)
            at += 1
        for row in np.flatnonzero(at != ends)[:1]:
            missing, what = int(at[row] - ends[row]), f"element {element.name} of its header"
            fault = f"are missing ({missing}), {what} has more"
            if missing < 0:
                fault = f"are left over ({-missing}), {what} has no place for them"
            raise ValueError(f"{self.place(element.name, row)}: values {fault}")
