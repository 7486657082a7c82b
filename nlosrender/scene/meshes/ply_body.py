"""The body of a .ply file as arrays: single values, and lists in runs of equal length.

An ASCII body is read row by row: a record ends where its line does, or something has been misread.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.file_mesh import numbers_in
from nlosrender.scene.meshes.ply_header import PlyElement, PlyHeader
from nlosrender.scene.meshes.triangle_mesh import Int64
from nlosrender.scene.pose import Float64

Lists = list[NDArray[Any]]  # of one list property: runs of records of equal length, (records, length)


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


@dataclass(frozen=True, eq=False)
class PlyRecords:
    """The values of an element by the names of its properties."""

    columns: dict[str, NDArray[Any]]  # single values, (records,)
    lists: dict[str, Lists]


def read_records(content: bytes, header: PlyHeader, rows: PlyRows | None) -> dict[str, PlyRecords]:
    """Return every element's records by its name; ``rows`` are those of an ASCII file.

    Raises
    ------
    ValueError
        The file is cut short, goes on after what its header promises, or a list's length cannot be.
    """
    body = memoryview(content)[header.size :]
    found = {}
    for element in header.elements:
        if rows is not None:
            body = memoryview(rows.take(element).tobytes())
        found[element.name], used = _records(element, body)
        body = body[used:]
    if rows is not None:
        rows.refuse_rest(header)
    elif bytes(body[:1024]).strip() or len(body) > 1024:  # some writers end a binary body with a line
        raise ValueError(f"{len(body)} bytes are left over after what its header promises: {header.promised()}")
    return found


def _records(element: PlyElement, body: memoryview) -> tuple[PlyRecords, int]:
    """Return an element's values, and the number of bytes they take.

    Lists of one length make records of one size, which numpy reads at once: the records are read in runs of
    equal lengths.
    """
    lists = [index for index, prop in enumerate(element.properties) if prop.count_kind is not None]
    columns: dict[str, list[NDArray[Any]]] = {prop.name: [] for prop in element.properties if prop.count_kind is None}
    values: dict[str, Lists] = {element.properties[index].name: [] for index in lists}
    done, offset, window = 0, 0, element.count
    while done < element.count and element.properties:
        lengths = _lengths(element, body[offset:], done)
        dtype = element.dtype(lengths)
        fitting = (len(body) - offset) // dtype.itemsize
        if fitting == 0 or (fitting < element.count - done and not lists):
            raise element.cut_short(done + fitting)
        run = np.frombuffer(body, dtype, min(element.count - done, fitting, max(window, 1)), offset)
        same = np.ones(len(run), dtype=bool)
        for index, length in zip(lists, lengths, strict=True):
            same &= run[f"{index}n"] == length
        count = len(run) if same.all() else int(np.argmin(same))
        # a run that ends early is followed by short looks, or mixed polygons would be read again and again
        window = 2 * window if count == len(run) else 2 * count
        for index, prop in enumerate(element.properties):
            (columns if prop.count_kind is None else values)[prop.name].append(run[f"{index}"][:count])
        done, offset = done + count, offset + count * dtype.itemsize
    joined = {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in columns.items()}
    return PlyRecords(joined, values), offset


def _lengths(element: PlyElement, body: memoryview, record: int) -> list[int]:
    """Return the lengths of the lists of the next record, all of which fit into the body."""
    lengths: list[int] = []
    for index, prop in enumerate(element.properties):
        if prop.count_kind is None:
            continue
        before, kind = element.dtype(lengths, index).itemsize, np.dtype(element.stored(prop.count_kind))
        if before + kind.itemsize > len(body):
            raise element.cut_short(record)
        length = float(np.frombuffer(body, kind, 1, before)[0])
        if not 0 <= length <= element.max_list or length != int(length):
            raise ValueError(element.no_length(record, length))
        if length * np.dtype(element.stored(prop.kind)).itemsize > len(body):
            raise element.cut_short(record)
        lengths.append(int(length))
    return lengths
