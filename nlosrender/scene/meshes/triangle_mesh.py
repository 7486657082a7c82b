"""Triangle meshes in float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.scene.bounding_box import Bounds, bounds_of
from nlosrender.scene.pose import Float64

Int64 = NDArray[np.int64]
_WIDTHS = {"uvs": 2, "normals": 3, "colors": 3}  # of what vertices may have beside a position


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh; counter-clockwise faces are seen from the side their normal points to.

    Raises
    ------
    ValueError
        A shape is wrong, a number is not finite, or an index is out of range; names the first bad vertex or face.
    """

    vertices: Float64  # (n, 3) m
    faces: NDArray[np.integer]  # (m, 3) vertex indices, kept as uint32
    uvs: Float64 | None = None  # (n, 2) texture coordinates
    normals: Float64 | None = None  # (n, 3) shading normals; None: flat faces
    colors: Float64 | None = None  # (n, 3) reflectances, linear r, g, b from 0 to 1

    def __post_init__(self) -> None:
        vertices = _per_vertex("vertices", self.vertices, 3, None)
        faces = np.asarray(self.faces)
        if faces.size == 0:
            faces = np.zeros((0, 3), dtype=np.uint32)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise ValueError(f"faces have shape {faces.shape} and type {faces.dtype}: need (m, 3) integers")
        bad = np.flatnonzero(np.any((faces < 0) | (faces >= len(vertices)), axis=1))
        if bad.size:
            face = faces[bad[0]].tolist()
            raise ValueError(f"face {bad[0]} is {face}: indices must lie between 0 and {len(vertices) - 1}")
        object.__setattr__(self, "vertices", _frozen(vertices))
        object.__setattr__(self, "faces", _frozen(faces.astype(np.uint32)))
        for name, width in _WIDTHS.items():
            rows = getattr(self, name)
            if rows is not None:
                object.__setattr__(self, name, _frozen(_per_vertex(name, rows, width, len(vertices))))

    @property
    def area(self) -> float:
        """Total area [m^2]."""
        return float(self.areas().sum())

    def areas(self) -> Float64:
        """Return the area of each face, (m,) [m^2]."""
        return 0.5 * np.linalg.norm(self._cross_products(), axis=1)

    def face_normals(self) -> Float64:
        """Return the unit normal of each face, (m, 3); zero for a face without area."""
        return unit_rows(self._cross_products())

    def bounds(self) -> Bounds:
        """Return the smallest and largest coordinates of the faces' vertices [m]; ValueError without faces."""
        if not len(self.faces):
            raise ValueError("a mesh without faces has no bounds")
        return bounds_of(self.vertices[self.faces].reshape(-1, 3))

    def transformed(self, matrix: ArrayLike) -> TriangleMesh:
        """Return the mesh under an affine map.

        A mirroring map also reverses the order of each face's vertices, so that faces keep the side that their
        (inversely transposed) normals point to.

        Parameters
        ----------
        matrix
            (4, 4) homogeneous matrix.

        Raises
        ------
        ValueError
            The matrix is not affine, not finite or not invertible.
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise ValueError("transform: need a finite affine 4 x 4 matrix with last row [0, 0, 0, 1]")
        linear = matrix[:3, :3]
        determinant = float(np.linalg.det(linear))
        if abs(determinant) <= 1e-15 * float(np.linalg.norm(linear)) ** 3:  # rounding of a determinant of 0
            raise ValueError("transform: the matrix is singular, it would flatten the mesh")
        normals = None if self.normals is None else unit_rows(self.normals @ np.linalg.inv(linear))
        faces = self.faces if determinant > 0 else self.faces[:, ::-1]
        return TriangleMesh(self.vertices @ linear.T + matrix[:3, 3], faces, self.uvs, normals, self.colors)

    def turned_round(self) -> TriangleMesh:
        """Return the mesh seen from the other side: faces run the other way, normals point the other way."""
        return replace(self, faces=self.faces[:, ::-1], normals=None if self.normals is None else -self.normals)

    def reindexed(self, rows: NDArray[np.integer], faces: NDArray[np.integer]) -> TriangleMesh:
        """Return a mesh of the vertices ``rows`` (k,) of this one, which may repeat, and ``faces`` that index them."""
        columns = (getattr(self, name) for name in _WIDTHS)
        parts = (None if values is None else values[rows] for values in columns)
        return TriangleMesh(self.vertices[rows], faces, *parts)

    def subset(self, mask: ArrayLike) -> TriangleMesh:
        """Return the faces where ``mask`` (m,) is true, without the vertices they do not use."""
        mask = np.asarray(mask)
        if mask.dtype != np.bool_ or mask.shape != (len(self.faces),):
            raise ValueError(f"mask has shape {mask.shape} and type {mask.dtype}: need ({len(self.faces)},) booleans")
        used, indices = np.unique(self.faces[mask], return_inverse=True)
        return self.reindexed(used, indices.reshape(-1, 3))

    def with_area_only(self) -> TriangleMesh:
        """Return the mesh without faces of no area and without vertices that no face uses; itself if it has neither."""
        kept = np.einsum("ij,ij->i", *[self._cross_products()] * 2) > 0
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        return self if kept.all() and used.all() else self.subset(kept)

    @staticmethod
    def merged(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
        """Return one mesh with the faces of all, in order; uvs, normals, colors are kept when every part has them."""
        if not meshes:
            raise ValueError("no meshes to merge: need at least one")
        offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
        faces = [mesh.faces.astype(np.int64) + offset for mesh, offset in zip(meshes, offsets, strict=True)]
        columns = ([getattr(mesh, name) for mesh in meshes] for name in _WIDTHS)
        return TriangleMesh(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate(faces),
            *(None if any(part is None for part in parts) else np.concatenate(parts) for parts in columns),
        )

    def _cross_products(self) -> Float64:
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        return np.cross(b - a, c - a)


def unit_rows(vectors: Float64, min_length: float = 0.0) -> Float64:
    """Return vectors (n, 3) at length 1, those of at most ``min_length`` as zero."""
    with np.errstate(over="ignore"):  # an absurd vector has infinite length and becomes zero
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > min_length)


def equal_columns(keys: NDArray[Any] | Sequence[NDArray[Any]]) -> Int64:
    """Return for each column of ``keys`` (k, n) its number among the different columns, in order of the last key."""
    order = np.lexsort(keys)
    is_new = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    numbers = np.empty(len(order), np.int64)
    numbers[order] = np.append(0, np.cumsum(is_new))[: len(order)]
    return numbers


def distinct_columns(keys: NDArray[Any] | Sequence[NDArray[Any]]) -> tuple[Int64, Int64]:
    """Return the index of one column of ``keys`` (k, n) of each kind, and which of these each column equals, (n,)."""
    numbers = equal_columns(keys)
    first = np.empty(int(numbers.max(initial=-1)) + 1, np.int64)
    first[numbers] = np.arange(len(numbers))
    return first, numbers


def _per_vertex(name: str, rows: ArrayLike, width: int, count: int | None) -> Float64:
    rows = np.array(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width or (count is not None and len(rows) != count):
        raise ValueError(f"{name} have shape {rows.shape}: need ({'n' if count is None else count}, {width})")
    bad = np.flatnonzero(~np.all(np.isfinite(rows), axis=1))
    if bad.size:
        raise ValueError(f"{name}: vertex {bad[0]} is {rows[bad[0]].tolist()}, need finite numbers")
    return rows


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
