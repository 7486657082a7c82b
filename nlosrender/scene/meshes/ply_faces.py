"""Faces of a .ply file: polygons and triangle strips as triangles, with the texture coordinates of their corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.ply_body import Lists, PlyRows
from nlosrender.scene.meshes.polygons import cut_polygons
from nlosrender.scene.meshes.triangle_mesh import Int64, TriangleMesh, distinct_columns
from nlosrender.scene.pose import Float64

_END_OF_STRIP = -1


@dataclass(frozen=True, eq=False)
class TriangleCorners:
    """Triangles of an element."""

    faces: Int64  # (m, 3) vertices
    uvs: Float64 | None = None  # (m, 3, 2) texture coordinates of their corners
    lacking_uvs: str = ""  # what a message says where only some faces have texture coordinates


def polygon_corners(
    runs: Lists, uv_runs: Lists | None, positions: Float64, text: PlyRows | None
) -> tuple[TriangleCorners, tuple[str, ...]]:
    """Return the triangles of polygons, and sentences about bent polygons.

    Parameters
    ----------
    runs
        Vertices of the faces, run by run.
    uv_runs
        Texture coordinates of their corners as u v u v ..., the same faces in the same runs; None: the file has none.
    positions
        (n, 3) of the vertices.
    text
        The rows of an ASCII file, which have line numbers.

    Raises
    ------
    ValueError
        An index is out of range or not an integer, or a polygon crosses itself.
    """
    first = np.cumsum([0, *(len(run) for run in runs)])

    def named(face: int) -> str:
        return f"face {face}" if text is None else f"face {face} ({text.place('face', face)})"

    polygons = [whole_numbers(run) for run in runs]
    for start, run in zip(first, polygons, strict=False):
        for row in np.flatnonzero(((run < 0) | (run >= len(positions))).any(axis=1))[:1]:
            raise ValueError(
                f"{named(start + row)} is {run[row].tolist()}: indices must lie between 0 and {len(positions) - 1}"
            )
    cuts, bent = cut_polygons([positions[run] for run in polygons], lambda group, i: named(int(first[group]) + i))
    faces = [np.zeros((0, 3), np.int64)]
    faces += [run[owners[:, None], corners] for run, (owners, corners) in zip(polygons, cuts, strict=True)]
    uvs, lacking = [np.zeros((0, 3, 2))], ""
    for start, run, of_corners, (owners, corners) in zip(first, polygons, uv_runs or (), cuts, strict=False):
        if of_corners.shape[1] == 2 * run.shape[1]:
            uvs.append(of_corners.reshape(*run.shape, 2)[owners[:, None], corners].astype(np.float64))
        elif run.shape[1] > 2:
            lacking = lacking or f"its {named(start)} has no texture coordinates for its corners"
    is_whole = uv_runs is not None and not lacking
    return TriangleCorners(np.concatenate(faces), np.concatenate(uvs) if is_whole else None, lacking), bent


def strip_corners(runs: Lists, n_vertices: int) -> TriangleCorners:
    """Return the triangles of strips: each vertex makes one with the two before it, every second one turned round.

    A strip ends at the index -1. ValueError for an index that is out of range or not an integer.
    """
    ended = [np.pad(whole_numbers(run), ((0, 0), (0, 1)), constant_values=_END_OF_STRIP).ravel() for run in runs]
    flat = np.concatenate([np.zeros(0, np.int64), *ended])
    for index in flat[(flat < _END_OF_STRIP) | (flat >= n_vertices)][:1]:
        raise ValueError(f"a strip has the index {index}: indices must lie between 0 and {n_vertices - 1}")
    if len(flat) < 3:
        return TriangleCorners(np.zeros((0, 3), np.int64))
    place = np.arange(len(flat))
    in_strip = place - np.maximum.accumulate(np.where(flat == _END_OF_STRIP, place, -1)) - 1
    faces = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=-1)
    turned = in_strip[:-2] % 2 == 1
    faces[turned] = faces[turned][:, [1, 0, 2]]
    return TriangleCorners(faces[(faces != _END_OF_STRIP).all(axis=1)])


def with_corner_uvs(mesh: TriangleMesh, uvs: Float64) -> TriangleMesh:
    """Return a mesh with texture coordinates (m, 3, 2) for each corner of its faces: a vertex for each that differ."""
    vertices, flat = mesh.faces.ravel().astype(np.int64), uvs.reshape(-1, 2)
    first, which = distinct_columns([flat[:, 1], flat[:, 0], vertices])
    return replace(mesh.reindexed(vertices[first], which.reshape(-1, 3)), uvs=flat[first])


def whole_numbers(values: NDArray[Any]) -> Int64:
    """Return indices as integers; ValueError for one that is none."""
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise ValueError("a face has an index that is no number, or far too large")
    indices = values.astype(np.int64)
    if values.dtype.kind == "f" and (indices != values).any():
        raise ValueError(f"a face has the index {values[indices != values][0]:g}, need integers")
    return indices
