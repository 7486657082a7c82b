"""What a mesh file holds: its triangles, and what has to be said of everything else in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nlosrender.scene.triangle_mesh import TriangleMesh

BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # that Windows editors put before a text in UTF-8; no part of it
_SHOWN_NAMES = 5


@dataclass(frozen=True, eq=False)
class FileMesh:
    """A mesh as its file has it.

    Parameters
    ----------
    mesh
        In the file's coordinates; a normal is zero where a corner of a face has none.
    materials
        Names of the materials that faces have, in the order of the file.
    dropped
        What the file has and the mesh has not, in a few words each: lines, colours.
    doubts
        Sentences about what may not be as its author meant it.
    no_uvs
        Why ``mesh`` has no texture coordinates; empty when it has some.
    """

    mesh: TriangleMesh
    materials: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    no_uvs: str = "it has no texture coordinates"


def some_of(names: Sequence[str]) -> str:
    """Return a list of names for a message, cut where it is long."""
    rest = len(names) - _SHOWN_NAMES
    return ", ".join(names[:_SHOWN_NAMES]) + (f" and {rest} more" if rest > 0 else "")
