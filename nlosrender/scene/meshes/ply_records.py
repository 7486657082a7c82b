"""The body of a .ply file as arrays: single values, and lists in runs of equal length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.ply_header import PlyElement, PlyHeader
from nlosrender.scene.meshes.ply_rows import PlyRows

Lists = list[NDArray]  # of one list property: runs of records of equal length, (records, length)


@dataclass(frozen=True, eq=False)
class PlyRecords:
    """The values of an element by the names of its properties."""

    columns: dict[str, NDArray]  # single values, (records,)
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
    columns: dict[str, list[NDArray]] = {prop.name: [] for prop in element.properties if prop.count_kind is None}
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
