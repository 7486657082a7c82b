"""Shading normals of mesh files: the file's, none (flat faces), or those averaged from the faces around a vertex."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh, equal_columns, unit_rows
from nlosrender.scene.pose import Float64

# auto: the file's where it has some, else flat. file: the file's, which has to have them. smooth: averaged, whatever
# the file has. mitsuba: as its readers do, the file's where it has some, else averaged.
Normals = Literal["auto", "file", "flat", "smooth", "mitsuba"]
MIN_FLAT_COSINE = 1 - 1e-7  # files of a few decimals have the normals of flat faces to 4e-4 rad
MIN_LENGTH = 1e-30  # normals below have no direction: their squares are near the smallest number of float64


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
    own = np.zeros_like(mesh.vertices) if mesh.normals is None else unit_rows(mesh.normals, MIN_LENGTH)
    is_missing = ~np.any(own, axis=1)
    has = ~is_missing[mesh.faces]  # (m, 3)
    if normals == "file" and not has.all():
        lacking = int((~has).any(axis=1).sum())
        raise ValueError(f"{lacking} of its {len(has)} triangles have no normals; normals: auto takes these for flat")
    if normals == "flat" or (normals == "auto" and not has.any()):
        return replace(mesh, normals=None), "flat"
    if normals == "smooth":
        return _completed(mesh, smooth_normals(mesh, joined=True)), "smoothed"
    if normals == "mitsuba" and is_missing.any():
        own[is_missing] = smooth_normals(mesh)[is_missing]
        return _completed(mesh, own), "file" if has.any() else "smoothed"
    mesh = _completed(mesh, own)
    if normals == "auto" and normal_cosines(mesh).min() > MIN_FLAT_COSINE:
        return replace(mesh, normals=None), "flat"
    return mesh, "file"


def smooth_normals(mesh: TriangleMesh, *, joined: bool = False) -> Float64:
    """Return a unit normal per vertex, (n, 3): the faces' normals weighted by their angles there.

    Thürmer & Wüthrich 1998. Zero at vertices without faces. ``joined``: vertices at the same place are one.
    """
    which = equal_columns(mesh.vertices.T) if joined else np.arange(len(mesh.vertices))
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
    return unit_rows(normals, MIN_LENGTH)[which]


def normal_cosines(mesh: TriangleMesh) -> Float64:
    """Return the cosines (m, 3) between the normals at the corners of each face and that of the face; 1 if flat."""
    if mesh.normals is None:
        return np.ones((len(mesh.faces), 3))
    return np.einsum("mcx,mx->mc", mesh.normals[mesh.faces], mesh.face_normals())


def _completed(mesh: TriangleMesh, normals: Float64) -> TriangleMesh:
    """Return the mesh with these normals, and with their face's at corners where they are zero."""
    is_missing = ~np.any(normals, axis=1)[mesh.faces]
    if not is_missing.any():
        return replace(mesh, normals=normals)
    # faces that share such a vertex may disagree: each gets one of its own
    owners = mesh.faces[is_missing]
    faces = mesh.faces.astype(np.int64)
    faces[is_missing] = len(mesh.vertices) + np.arange(len(owners))
    split = mesh.reindexed(np.concatenate([np.arange(len(mesh.vertices)), owners]), faces)
    own = mesh.face_normals()[np.nonzero(is_missing)[0]]
    return replace(split, normals=np.concatenate([normals, own]))
