"""Shading normals of mesh files: the file's, none (flat faces), or those averaged from the faces around a vertex."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_mesh import TriangleMesh

# auto: the file's where it has some, else flat. file: the file's, which has to have them. smooth: averaged, whatever
# the file has. mitsuba: as its readers do, the file's where it has some, else averaged.
Normals = Literal["auto", "file", "flat", "smooth", "mitsuba"]
SAME_NORMAL = 1 - 1e-7  # cosine: files of a few decimals have the normals of flat faces to 4e-4 rad
_SHORTEST = 1e-30  # normals below have no direction


def with_normals(mesh: TriangleMesh, normals: Normals) -> tuple[TriangleMesh, str]:
    """Return a mesh with the normals asked for, of unit length, and what they are: "flat", "file" or "smoothed".

    Parameters
    ----------
    mesh
        As its file has it; a normal is zero where there is none.
    normals
        ``auto`` leaves normals away that are the faces'. Corners without a normal get their face's, or with ``mitsuba``
        an averaged one; vertices are split where faces that share them need it.

    Raises
    ------
    ValueError
        ``file``, and a corner has no normal.
    """
    own = _unit(np.zeros_like(mesh.vertices) if mesh.normals is None else mesh.normals)
    has = _are_there(own)[mesh.faces]  # (m, 3)
    if normals == "file" and not has.all():
        lacking = int((~has).any(axis=1).sum())
        raise ValueError(f"{lacking} of its {len(has)} triangles have no normals; normals: auto takes these for flat")
    if normals == "flat" or (normals == "auto" and not has.any()):
        return replace(mesh, normals=None), "flat"
    if normals == "smooth":
        return _torn(mesh, smooth_normals(mesh, joined=True)), "smoothed"
    if normals == "mitsuba" and not _are_there(own).all():
        missing = ~_are_there(own)
        own[missing] = smooth_normals(mesh)[missing]
        return _torn(mesh, own), "file" if has.any() else "smoothed"
    mesh = _torn(mesh, own)
    if normals == "auto" and normal_cosines(mesh).min() > SAME_NORMAL:
        return replace(mesh, normals=None), "flat"
    return mesh, "file"


def smooth_normals(mesh: TriangleMesh, *, joined: bool = False) -> Float64:
    """Return a unit normal per vertex, (n, 3): the faces' normals weighted by their angles there.

    Thürmer & Wüthrich 1998. Zero at vertices without faces. ``joined``: vertices at the same place are one.
    """
    which = same_places(mesh.vertices) if joined else np.arange(len(mesh.vertices))
    normals = np.zeros_like(mesh.vertices)
    face_normals, twice_areas = mesh.face_normals(), 2 * mesh.areas()
    corners = mesh.vertices[mesh.faces]
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(twice_areas, np.einsum("ij,ij->i", a, b))  # |a x b| is the same at every corner
        for axis in range(3):
            weights = angle * face_normals[:, axis]
            normals[:, axis] += np.bincount(which[mesh.faces[:, corner]], weights, len(normals))
    return _unit(normals)[which]


def normal_cosines(mesh: TriangleMesh) -> Float64:
    """Return the cosines (m, 3) between the normals at the corners of each face and that of the face; 1 if flat."""
    if mesh.normals is None:
        return np.ones((len(mesh.faces), 3))
    return np.einsum("mcx,mx->mc", mesh.normals[mesh.faces], mesh.face_normals())


def same_places(vertices: Float64) -> NDArray[np.int64]:
    """Return for each vertex a number that all have that lie exactly where it does, below the number of vertices."""
    order = np.lexsort(vertices.T)
    new = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    which = np.empty(len(order), np.int64)
    which[order] = np.append(0, np.cumsum(new))[: len(order)]
    return which


def _are_there(normals: Float64) -> NDArray[np.bool_]:
    return np.any(normals != 0, axis=1)


def _unit(normals: Float64) -> Float64:
    with np.errstate(over="ignore"):  # the length of an absurd normal is infinite: it becomes a missing one
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > _SHORTEST)


def _torn(mesh: TriangleMesh, normals: Float64) -> TriangleMesh:
    """Return the mesh with these normals, and with their face's where they are zero."""
    torn = ~_are_there(normals)[mesh.faces]
    if not torn.any():
        return replace(mesh, normals=normals)
    # Faces that share such a vertex may disagree: each gets one of its own.
    owners = mesh.faces[torn]
    faces = mesh.faces.astype(np.int64)
    faces[torn] = len(mesh.vertices) + np.arange(len(owners))
    return TriangleMesh(
        np.concatenate([mesh.vertices, mesh.vertices[owners]]),
        faces,
        None if mesh.uvs is None else np.concatenate([mesh.uvs, mesh.uvs[owners]]),
        np.concatenate([normals, mesh.face_normals()[np.nonzero(torn)[0]]]),
        None if mesh.colors is None else np.concatenate([mesh.colors, mesh.colors[owners]]),
    )
