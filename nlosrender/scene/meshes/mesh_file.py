"""Reads mesh files. Nothing of them reaches Mitsuba before it has been checked: its own readers trust them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_normals import Normals, with_normals
from nlosrender.scene.meshes.obj import read_obj
from nlosrender.scene.meshes.ply import read_ply
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.meshes.trimesh_formats import FORMATS, reader_of

MAX_BYTES = 4 * 2**30  # the arrays read from a text take about as much again
MAX_FACES = 2**31 - 1  # Mitsuba counts with 32 bits
MAX_COORDINATE = 1e30  # the squares of areas stay finite in float64
READERS = {"ply": read_ply, "obj": read_obj} | {kind: reader_of(kind) for kind in FORMATS}


def read_mesh(filename: str, kind: str, normals: Normals = "auto") -> TriangleMesh:
    """Return the triangles of a mesh file (``read_mesh_file``) with the normals asked for (``with_normals``).

    Raises
    ------
    ValueError
        As ``read_mesh_file``; or the file has not the normals asked for.
    """
    return with_normals(read_mesh_file(filename, kind).mesh, normals)[0]


def read_mesh_file(filename: str, kind: str) -> FileMesh:
    """Return what a mesh file holds in its own coordinates, without triangles of no area; kinds: ``READERS``.

    Raises
    ------
    ValueError
        The file cannot be read, is damaged, or has no triangle with an area; says what is wrong, but not which file.
    """
    try:
        path = Path(filename)
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES >> 30} GiB. Use fewer triangles, or a binary .ply.")
        found = READERS[kind](path.read_bytes())
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise ValueError("it does not fit into memory. Use fewer triangles.") from error
    mesh = found.mesh
    if not len(mesh.faces):
        raise ValueError("it has no triangles")
    if len(mesh.faces) > MAX_FACES:
        raise ValueError(f"it has {len(mesh.faces)} triangles, need at most {MAX_FACES}")
    far = np.flatnonzero(np.abs(mesh.vertices[mesh.faces]).max(axis=(1, 2)) > MAX_COORDINATE)
    if far.size:
        corners = mesh.vertices[mesh.faces[far[0]]].tolist()
        raise ValueError(f"its triangle {far[0]} has the corners {corners}, need coordinates up to {MAX_COORDINATE:g}")
    with_area = mesh.with_area_only()
    if not len(with_area.faces):
        raise ValueError("none of its triangles has an area")
    lost = len(mesh.faces) - len(with_area.faces)
    dropped = (*found.dropped, f"{lost} triangles without area") if lost else found.dropped
    return replace(found, mesh=with_area, dropped=dropped)
