"""The header of a .ply file: its elements, their counts, and the layout of their values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nlosrender.scene.meshes.polygons import MAX_CORNERS

MAX_HEADER = 2**16  # bytes; the header of a scan with long comments takes a few thousand
KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
KINDS |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_LIST = 2**31 - 1  # of anything but a polygon: one strip may hold all triangles of a mesh


@dataclass(frozen=True)
class PlyProperty:
    """A value, or a list of values, of each record of an element."""

    name: str
    kind: str  # numpy type of a value, such as u1
    count_kind: str | None = None  # of a list's length; None: one value


@dataclass(frozen=True)
class PlyElement:
    """What the header says of one element."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]
    byte_order: str  # one of BYTE_ORDERS

    def stored(self, kind: str) -> str:
        """Return the type of a value in the body; an ASCII body has been read as float64."""
        return "=f8" if self.byte_order == "=" else self.byte_order + kind

    def dtype(self, lengths: Sequence[int], n_properties: int | None = None) -> np.dtype:
        """Return the layout of the first properties of a record, all of them by default, whose lists have lengths."""
        fields: list[tuple[Any, ...]] = []
        of_lists = iter(lengths)
        for index, prop in enumerate(self.properties[:n_properties]):
            if prop.count_kind is None:
                fields.append((f"{index}", self.stored(prop.kind)))
            else:
                fields.append((f"{index}n", self.stored(prop.count_kind)))
                fields.append((f"{index}", self.stored(prop.kind), (next(of_lists),)))
        return np.dtype(fields)

    @property
    def max_list(self) -> int:
        """The most values that a list of this element can have."""
        return MAX_CORNERS if self.name == "face" else MAX_LIST

    def no_length(self, record: int, length: float) -> str:
        """Return the message about a list whose length cannot be."""
        return f"{self.name} {record} has a list of {length:g} values, need 0 to {self.max_list}"

    def cut_short(self, found: int) -> ValueError:
        """Return the error of a file that has only some of the records."""
        return ValueError(f"it says that it has {self.count} of element {self.name}, but ends after {found}")


@dataclass(frozen=True)
class PlyHeader:
    """A header, understood and checked."""

    is_ascii: bool
    elements: tuple[PlyElement, ...]
    size: int  # bytes: where the body begins

    def kinds(self, element: str) -> dict[str, str]:
        """Return the types of the properties of an element by their names; none if there is no such element."""
        return {prop.name: prop.kind for own in self.elements if own.name == element for prop in own.properties}

    def promised(self) -> str:
        """Return how many of which elements there are, for messages."""
        return ", ".join(f"{element.count} of element {element.name}" for element in self.elements)


def read_header(content: bytes) -> PlyHeader:
    """Return the header at the beginning of a file's bytes; lines may end as on any system.

    Raises
    ------
    ValueError
        It is no header, or a line of it is not understood.
    """
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if first is None:
        raise ValueError(f"it starts with {content[:12]!r}, not with the line ply" if content else "it is empty")
    # old Macintosh lines end in \r alone, and a binary body after them may begin with \n
    line_end = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    end = re.compile(rb"[\r\n]end_header[ \t]*" + line_end).search(content, 0, MAX_HEADER)
    if end is None:
        raise ValueError(f"its header has no line end_header within {MAX_HEADER} bytes")
    order, elements = "", list[tuple[str, int, list[PlyProperty]]]()
    for number, line in enumerate(content[: end.start()].decode("latin-1").splitlines()[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in BYTE_ORDERS:
                order = BYTE_ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(KINDS):
                elements[-1][2].append(PlyProperty(name, KINDS[kind], KINDS[length]))
            case ["property", kind, name] if elements and kind in KINDS:
                elements[-1][2].append(PlyProperty(name, KINDS[kind]))
            case _:
                raise ValueError(f"line {number} of its header means nothing: {line[:60]!r}")
    if not order:
        raise ValueError(f"its header has no line format, one of {', '.join(BYTE_ORDERS)}")
    ordered = (PlyElement(name, count, tuple(properties), order) for name, count, properties in elements)
    return PlyHeader(order == "=", tuple(ordered), end.end())
