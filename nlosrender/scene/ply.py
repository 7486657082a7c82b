"""Reads .ply meshes: ASCII and binary, triangles and polygons, in float64.

Every count and index is held against what the file has before anything of its size is made: a wrong number in a file
is a message, never a crash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.triangle_mesh import TriangleMesh, fan_triangles, numbers_in

MAX_HEADER = 2**16  # bytes; the header of a scan with long comments takes a few thousand
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
TEXTURE_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
FACE_LISTS = ("vertex_indices", "vertex_index")
MOST_CORNERS = 1000  # of a polygon; more is a damaged count


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: str
    count_dtype: str | None  # of a list's length; None: one value


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    def dtype(self, lengths: Sequence[int]) -> np.dtype:
        """Return the layout of one record whose lists have these lengths."""
        fields: list[tuple] = []
        of_lists = iter(lengths)
        for index, prop in enumerate(self.properties):
            if prop.count_dtype is None:
                fields.append((f"{index}", prop.dtype))
            else:
                fields += [(f"{index}n", prop.count_dtype), (f"{index}", prop.dtype, (next(of_lists),))]
        return np.dtype(fields)


Columns = dict[str, NDArray]  # of an element's single values, by their names
Lists = list[NDArray]  # of one list property: runs of records of equal length, (records, length)


def read_ply(content: bytes) -> TriangleMesh:
    """Return the mesh of a .ply file.

    Parameters
    ----------
    content
        The file's bytes.

    Returns
    -------
    TriangleMesh
        In the file's coordinates. Polygons are cut into fans from their first corner (right for convex ones).

    Raises
    ------
    ValueError
        The file is cut short, its header is damaged, or a count, an index or a number cannot be.
    """
    byte_order, elements, start = _header(content)
    body = memoryview(content)[start:]
    if byte_order == "=":
        # a word that is no number ends the text: the records that are missing then are reported
        body = memoryview(numbers_in(content[start:], np.float64).tobytes())
    vertices: Columns | None = None
    faces: NDArray[np.int64] | None = None
    for element in elements:
        columns, lists, used = _records(element, body)
        body = body[used:]
        if element.name == "vertex":
            vertices = columns
        elif element.name == "face":
            named = [lists[name] for name in FACE_LISTS if name in lists]
            if not named:
                raise ValueError(f"element face has no list {' or '.join(FACE_LISTS)}")
            faces = fan_triangles(named[0])
    if vertices is None or not set(POSITION) <= set(vertices):
        raise ValueError("there is no element vertex with x, y and z")
    if faces is None:
        raise ValueError("there is no element face: a cloud of points has no surface")
    uvs = next((_columns(vertices, names) for names in TEXTURE_COORDINATES if set(names) <= set(vertices)), None)
    normals = _columns(vertices, NORMAL) if set(NORMAL) <= set(vertices) else None
    return TriangleMesh(_columns(vertices, POSITION), faces, uvs, normals)


def _columns(columns: Mapping[str, NDArray], names: Sequence[str]) -> NDArray[np.float64]:
    return np.column_stack([columns[name].astype(np.float64) for name in names])


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order, the elements and where the body starts."""
    if content[:3] != b"ply" or content[3:4] not in (b"\n", b"\r"):
        raise ValueError(f"it starts with {content[:12]!r}, not with the line ply" if content else "it is empty")
    end = content.find(b"end_header", 0, MAX_HEADER)
    line_end = content.find(b"\n", end)
    if end < 0 or line_end < 0:
        raise ValueError(f"its header has no line end_header within {MAX_HEADER} bytes")
    lines = content[:end].decode("latin-1").splitlines()[1:]
    byte_order, elements = "", list[tuple[str, int, list[_Property]]]()
    for number, line in enumerate(lines, start=2):
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", order, _] if order in BYTE_ORDERS:
                byte_order = BYTE_ORDERS[order]
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(TYPES):
                elements[-1][2].append(_Property(name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append(_Property(name, TYPES[kind], None))
            case _:
                raise ValueError(f"line {number} of its header means nothing: {line[:60]!r}")
    if not byte_order:
        raise ValueError(f"its header has no line format, one of {', '.join(BYTE_ORDERS)}")
    ordered = [
        _Element(name, count, tuple(_ordered(prop, byte_order) for prop in properties))
        for name, count, properties in elements
    ]
    return byte_order, ordered, line_end + 1


def _ordered(prop: _Property, byte_order: str) -> _Property:
    """Return the property as it stands in the body; in an ASCII file, everything has been read as float64."""
    if byte_order == "=":
        return _Property(prop.name, "=f8", None if prop.count_dtype is None else "=f8")
    count = None if prop.count_dtype is None else byte_order + prop.count_dtype
    return _Property(prop.name, byte_order + prop.dtype, count)


def _records(element: _Element, body: memoryview) -> tuple[Columns, dict[str, Lists], int]:
    """Return an element's values, and the number of bytes they take.

    Lists of one length make records of one size, which numpy reads at once: the records are read in runs of
    equal lengths.
    """
    lists = [index for index, prop in enumerate(element.properties) if prop.count_dtype is not None]
    singles: dict[str, list[NDArray]] = {p.name: [] for p in element.properties if p.count_dtype is None}
    values: dict[str, Lists] = {element.properties[index].name: [] for index in lists}
    done, offset, window = 0, 0, element.count
    while done < element.count and element.properties:
        lengths = _lengths(element, body[offset:], done)
        dtype = element.dtype(lengths)
        fitting = (len(body) - offset) // dtype.itemsize
        if fitting == 0 or (fitting < element.count - done and not lists):
            raise _cut_short(element, done + fitting)
        run = np.frombuffer(body, dtype, min(element.count - done, fitting, max(window, 1)), offset)
        same = np.ones(len(run), dtype=bool)
        for index, length in zip(lists, lengths, strict=True):
            same &= run[f"{index}n"] == length
        count = len(run) if same.all() else int(np.argmin(same))
        # a run that ends early is followed by short looks, or mixed polygons would be read again and again
        window = 2 * window if count == len(run) else 2 * count
        for index, prop in enumerate(element.properties):
            if prop.count_dtype is None:
                singles[prop.name].append(run[f"{index}"][:count])
            else:
                values[prop.name].append(run[f"{index}"][:count])
        done, offset = done + count, offset + count * dtype.itemsize
    return {name: _joined(parts) for name, parts in singles.items()}, values, offset


def _joined(parts: list[NDArray]) -> NDArray:
    return np.concatenate(parts) if parts else np.zeros(0)


def _lengths(element: _Element, body: memoryview, record: int) -> list[int]:
    """Return the lengths of the lists of the next record."""
    lengths: list[int] = []
    for index, prop in enumerate(element.properties):
        if prop.count_dtype is None:
            continue
        before = _Element("", 0, element.properties[:index]).dtype(lengths).itemsize
        if before + np.dtype(prop.count_dtype).itemsize > len(body):
            raise _cut_short(element, record)
        length = float(np.frombuffer(body, prop.count_dtype, 1, before)[0])
        if not 0 <= length <= MOST_CORNERS or length != int(length):
            raise ValueError(f"{element.name} {record} has a list of {length:g} values, need 0 to {MOST_CORNERS}")
        lengths.append(int(length))
    return lengths


def _cut_short(element: _Element, found: int) -> ValueError:
    return ValueError(f"it says that it has {element.count} of element {element.name}, but ends after {found}")
