"""Minimal readers of OBJ and PLY for the reference renderer; polygons have to be convex."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reference.renderer import Array

_PLY = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
_PLY |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_PLY |= {"float32": "f4", "float64": "f8"}


class Unsupported(Exception):
    """The reference has no words for a part of a configuration."""


@dataclass(frozen=True)
class Face:
    """A triangle: (3, 3) corners, (3, 3) normals, (3, 2) texture coordinates with v upwards."""

    corners: Array
    normals: Array | None
    uvs: Array | None


def read_mesh(path: Path) -> list[Face]:
    """Read the triangles of a file."""
    return list(_obj(path) if path.suffix.lower() == ".obj" else _ply(path))


def _obj(path: Path) -> Iterator[Face]:
    rows: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        word, *rest = line.split("#")[0].split() or [""]
        if word in rows:
            rows[word].append([float(number) for number in rest])
        if word != "f":
            continue
        corners = [[*corner.split("/"), "", ""][:3] for corner in rest]
        columns = []
        for key, texts in zip(rows, zip(*corners, strict=True), strict=True):
            numbers = [int(text) for text in texts if text]
            if len(numbers) < len(corners):
                columns.append(None)
            else:
                width = 2 if key == "vt" else 3
                columns.append(np.array([rows[key][n - 1 if n > 0 else n][:width] for n in numbers]))
        yield from _fan(columns[0], columns[2], columns[1])


def _ply(path: Path) -> Iterator[Face]:
    head, body = path.read_bytes().split(b"end_header", 1)
    body = body[body.index(b"\n") + 1 :]
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in head.decode().splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    lines, offset = iter(body.decode().splitlines() if not order else []), 0

    def number(kind: str, words: Iterator[str]) -> float:
        nonlocal offset
        if not order:
            return float(next(words))
        value = np.frombuffer(body, order + _PLY[kind], 1, offset)[0]
        offset += value.itemsize
        return float(value)

    table: dict[str, list[dict[str, list[float]]]] = {}
    for name, count, properties in elements:
        table[name] = []
        for _ in range(count):
            words, row = iter(next(lines).split() if not order else []), {}
            for p in properties:
                n = int(number(p[1], words)) if p[0] == "list" else 1
                row[p[-1]] = [number(p[-2], words) for _ in range(n)]
            table[name].append(row)
    vertex = table["vertex"]

    def column(*names: str) -> Array | None:
        return np.array([[row[n][0] for n in names] for row in vertex]) if set(names) <= vertex[0].keys() else None

    p, n = column("x", "y", "z"), column("nx", "ny", "nz")
    uv = next((c for c in (column("u", "v"), column("s", "t")) if c is not None), None)
    for face in table["face"]:
        index = np.array(face.get("vertex_indices", face.get("vertex_index")), dtype=int)
        yield from _fan(p[index], None if n is None else n[index], None if uv is None else uv[index])


def _fan(p: Array, n: Array | None, uv: Array | None) -> Iterator[Face]:
    turns = np.cross(np.roll(p, -1, 0) - p, np.roll(p, -2, 0) - np.roll(p, -1, 0))
    if len(p) > 3 and not (turns @ turns.sum(0) > 0).all():
        raise Unsupported("a polygon that is not convex")
    for i in range(1, len(p) - 1):
        pick = [0, i, i + 1]
        yield Face(p[pick], None if n is None else n[pick], None if uv is None else uv[pick])
