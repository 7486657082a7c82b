"""Reads mesh files. Nothing of them reaches Mitsuba before it has been checked: its own readers trust them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.scene.obj import read_obj
from nlosrender.scene.ply import read_ply
from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_mesh import TriangleMesh

MAX_BYTES = 4 * 2**30
MOST_FACES = 2**31 - 1  # Mitsuba counts with 32 bits
LARGEST = 1e30  # of a coordinate: the squares of areas stay finite
_SHORTEST = 1e-30  # normals below have no direction
READERS = {"ply": read_ply, "obj": read_obj}


def read_mesh(filename: str, kind: str, *, face_normals: bool = False) -> TriangleMesh:
    """Return the triangles of a mesh file in its own coordinates, without those that have no area.

    Parameters
    ----------
    filename
        The file.
    kind
        ``ply`` or ``obj``.
    face_normals
        Flat shading: no normals. Otherwise those of the file, or in their absence those of the faces around each
        vertex (``smooth_normals``).

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
        mesh = READERS[kind](content).mesh
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise ValueError("it does not fit into memory. Use fewer triangles.") from error
    del content
    if not len(mesh.faces):
        raise ValueError("it has no triangles")
    if len(mesh.faces) > MOST_FACES:
        raise ValueError(f"it has {len(mesh.faces)} triangles, need at most {MOST_FACES}")
    far = np.flatnonzero(np.abs(mesh.vertices[mesh.faces]).max(axis=(1, 2)) > LARGEST)
    if far.size:
        corners = mesh.vertices[mesh.faces[far[0]]].tolist()
        raise ValueError(f"its triangle {far[0]} has the corners {corners}, need coordinates up to {LARGEST:g}")
    mesh = mesh.with_area_only()
    if not len(mesh.faces):
        raise ValueError("none of its triangles has an area")
    if face_normals:
        return TriangleMesh(mesh.vertices, mesh.faces, mesh.uvs)
    return _with_normals(mesh)


def smooth_normals(mesh: TriangleMesh) -> Float64:
    """Return a unit normal per vertex, (n, 3): the faces' normals weighted by their angles there.

    Thürmer & Wüthrich 1998. Zero at vertices without faces.
    """
    normals = np.zeros_like(mesh.vertices)
    face_normals, twice_areas = mesh.face_normals(), 2 * mesh.areas()
    corners = mesh.vertices[mesh.faces]
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(twice_areas, np.einsum("ij,ij->i", a, b))  # |a x b| is the same at every corner
        for axis in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], angle * face_normals[:, axis], len(normals))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


def _with_normals(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with a unit normal at every vertex: the file's, else a smooth one, else the face's."""
    normals = np.zeros_like(mesh.vertices) if mesh.normals is None else mesh.normals
    with np.errstate(over="ignore"):  # the length of an absurd normal is infinite: it becomes a missing one
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > _SHORTEST)
    if not normals.any(axis=1).all():
        missing = ~normals.any(axis=1)
        normals[missing] = smooth_normals(mesh)[missing]
    torn = ~normals.any(axis=1)[mesh.faces]
    if not torn.any():
        return TriangleMesh(mesh.vertices, mesh.faces, mesh.uvs, normals)
    # Where opposite faces share a vertex no normal serves both: each gets a vertex of its own.
    owners = mesh.faces[torn]
    faces = mesh.faces.astype(np.int64)
    faces[torn] = len(mesh.vertices) + np.arange(len(owners))
    return TriangleMesh(
        np.concatenate([mesh.vertices, mesh.vertices[owners]]),
        faces,
        None if mesh.uvs is None else np.concatenate([mesh.uvs, mesh.uvs[owners]]),
        np.concatenate([normals, mesh.face_normals()[np.nonzero(torn)[0]]]),
    )
