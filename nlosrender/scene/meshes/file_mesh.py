"""The content of a mesh file: its triangles, and a few words for everything else in it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # that Windows editors put before a text in UTF-8; no part of it
NO_UVS = "it has no texture coordinates"
MAX_NAMES = 5  # in a message


@dataclass(frozen=True, eq=False)
class FileMesh:
    """A mesh as its file has it."""

    mesh: TriangleMesh  # in the file's coordinates; a normal is zero where a corner of a face has none
    materials: tuple[str, ...] = ()  # names of the materials that faces have, in the order of the file
    dropped: tuple[str, ...] = ()  # what the file has and the mesh has not, in a few words each: lines, colours
    doubts: tuple[str, ...] = ()  # sentences about likely mistakes
    no_uvs: str = NO_UVS  # why ``mesh`` has no texture coordinates; empty when it has some


def some_of(names: Sequence[str]) -> str:
    """Return a list of names for a message, cut where it is long."""
    rest = len(names) - MAX_NAMES
    return ", ".join(names[:MAX_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def numbers_in(text: bytes, dtype: type) -> NDArray[Any]:
    """Return the numbers in a text, separated by white space, up to the first word that is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # how numpy reports such a word
        try:
            return np.fromstring(text.decode("latin-1"), dtype=dtype, sep=" ")
        except ValueError:  # the first word already
            return np.zeros(0, dtype=dtype)
