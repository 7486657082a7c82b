"""Reads mesh files. Nothing of them reaches Mitsuba before it has been checked: its own readers trust them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nlosrender.scene.file_mesh import FileMesh
from nlosrender.scene.mesh_normals import Normals, with_normals
from nlosrender.scene.obj import read_obj
from nlosrender.scene.ply import read_ply
from nlosrender.scene.triangle_mesh import TriangleMesh

MAX_BYTES = 4 * 2**30
MOST_FACES = 2**31 - 1  # Mitsuba counts with 32 bits
LARGEST = 1e30  # of a coordinate: the squares of areas stay finite
READERS = {"ply": read_ply, "obj": read_obj}


def read_mesh(filename: str, kind: str, normals: Normals = "auto") -> TriangleMesh:
    """Return the triangles of a mesh file (``read_mesh_file``) with unit normals, or without any.

    Parameters
    ----------
    filename, kind
        The file, and ``ply`` or ``obj``.
    normals
        Which (``mesh_normals.with_normals``).

    Raises
    ------
    ValueError
        As ``read_mesh_file``; or the file has not the normals asked for.
    """
    return with_normals(read_mesh_file(filename, kind).mesh, normals)[0]


def read_mesh_file(filename: str, kind: str) -> FileMesh:
    """Return what a mesh file holds in its own coordinates, without triangles that have no area.

    Raises
    ------
    ValueError
        The file cannot be read, is damaged, or has no triangle with an area; says what is wrong, but not which file.
    """
    try:
        path = Path(filename)
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES >> 30} GiB. Use fewer triangles, or a binary .ply.")
        content = path.read_bytes()
        found = READERS[kind](content)
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise ValueError("it does not fit into memory. Use fewer triangles.") from error
    del content
    mesh = found.mesh
    if not len(mesh.faces):
        raise ValueError("it has no triangles")
    if len(mesh.faces) > MOST_FACES:
        raise ValueError(f"it has {len(mesh.faces)} triangles, need at most {MOST_FACES}")
    far = np.flatnonzero(np.abs(mesh.vertices[mesh.faces]).max(axis=(1, 2)) > LARGEST)
    if far.size:
        corners = mesh.vertices[mesh.faces[far[0]]].tolist()
        raise ValueError(f"its triangle {far[0]} has the corners {corners}, need coordinates up to {LARGEST:g}")
    with_area = mesh.with_area_only()
    if not len(with_area.faces):
        raise ValueError("none of its triangles has an area")
    lost = len(mesh.faces) - len(with_area.faces)
    dropped = (*found.dropped, f"{lost} triangles without area") if lost else found.dropped
    return replace(found, mesh=with_area, dropped=dropped)
