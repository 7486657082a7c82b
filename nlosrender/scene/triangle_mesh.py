"""Triangle meshes in float64: what primitives and letters are generated as."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.scene.pose import Float64

UInt32 = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh; counter-clockwise faces are seen from the side their normal points to.

    Parameters
    ----------
    vertices
        (n, 3) float64 [m].
    faces
        (m, 3) vertex indices, kept as uint32.
    uvs
        (n, 2) texture coordinates, or None.
    normals
        (n, 3) shading normals, or None for flat faces.
    colors
        (n, 3) reflectances of the vertices, linear r, g, b from 0 to 1; or None.

    Raises
    ------
    ValueError
        A shape is wrong, a number is not finite, or an index is out of range; names the first bad vertex or face.
    """

    vertices: Float64
    faces: NDArray[np.integer]
    uvs: Float64 | None = None
    normals: Float64 | None = None
    colors: Float64 | None = None

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
        for name, width in (("uvs", 2), ("normals", 3), ("colors", 3)):
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
        cross = self._cross_products()
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the faces' vertices, (3,) and (3,) [m].

        Raises
        ------
        ValueError
            The mesh has no faces.
        """
        if not len(self.faces):
            raise ValueError("a mesh without faces has no bounds")
        corners = self.vertices[self.faces].reshape(-1, 3)
        return corners.min(axis=0), corners.max(axis=0)

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
        if abs(determinant) <= 1e-15 * float(np.linalg.norm(linear)) ** 3:
            raise ValueError("transform: the matrix is singular, it would flatten the mesh")
        normals = self.normals
        if normals is not None:
            normals = normals @ np.linalg.inv(linear)
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        faces = self.faces if determinant > 0 else self.faces[:, ::-1]
        return TriangleMesh(self.vertices @ linear.T + matrix[:3, 3], faces, self.uvs, normals, self.colors)

    def turned_round(self) -> TriangleMesh:
        """Return the mesh seen from the other side: faces run the other way, normals point the other way."""
        normals = None if self.normals is None else -self.normals
        return TriangleMesh(self.vertices, self.faces[:, ::-1], self.uvs, normals, self.colors)

    def subset(self, mask: ArrayLike) -> TriangleMesh:
        """Return the faces where ``mask`` (m,) is true, without the vertices they do not use.

        Raises
        ------
        ValueError
            The mask is not boolean with one entry per face.
        """
        mask = np.asarray(mask)
        if mask.dtype != np.bool_ or mask.shape != (len(self.faces),):
            raise ValueError(f"mask has shape {mask.shape} and type {mask.dtype}: need ({len(self.faces)},) booleans")
        used, indices = np.unique(self.faces[mask], return_inverse=True)
        return TriangleMesh(
            self.vertices[used],
            indices.reshape(-1, 3).astype(np.uint32),
            None if self.uvs is None else self.uvs[used],
            None if self.normals is None else self.normals[used],
            None if self.colors is None else self.colors[used],
        )

    def with_vertices(self, vertices: Float64) -> TriangleMesh:
        """Return the same faces with other vertices (n, 3)."""
        return replace(self, vertices=vertices)

    def with_area_only(self) -> TriangleMesh:
        """Return the mesh without faces of no area and without vertices that no face uses; itself if it has neither."""
        kept = np.einsum("ij,ij->i", *[self._cross_products()] * 2) > 0
        used = np.zeros(len(self.vertices), dtype=bool)
        used[self.faces] = True
        return self if kept.all() and used.all() else self.subset(kept)

    @staticmethod
    def merged(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
        """Return one mesh with the faces of all, in order; uvs, normals, colors are kept when every part has them.

        Raises
        ------
        ValueError
            There is no mesh to merge.
        """
        if not meshes:
            raise ValueError("no meshes to merge: need at least one")
        offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
        faces = [mesh.faces.astype(np.int64) + offset for mesh, offset in zip(meshes, offsets, strict=True)]

        def joined(name: str) -> Float64 | None:
            rows = [values for mesh in meshes if (values := getattr(mesh, name)) is not None]
            return np.concatenate(rows) if len(rows) == len(meshes) else None

        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        return TriangleMesh(vertices, np.concatenate(faces), *(joined(name) for name in ("uvs", "normals", "colors")))

    def _cross_products(self) -> Float64:
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        return np.cross(b - a, c - a)


def numbers_in(text: bytes, dtype: type) -> NDArray:
    """Return the numbers in a text, separated by white space, up to the first word that is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # how numpy reports such a word
        try:
            return np.fromstring(text.decode("latin-1"), dtype=dtype, sep=" ")
        except ValueError:  # the first word already
            return np.zeros(0, dtype=dtype)


def _per_vertex(name: str, rows: ArrayLike, width: int, count: int | None) -> Float64:
    rows = np.array(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width or (count is not None and len(rows) != count):
        raise ValueError(f"{name} have shape {rows.shape}: need ({'n' if count is None else count}, {width})")
    bad = np.flatnonzero(~np.all(np.isfinite(rows), axis=1))
    if bad.size:
        raise ValueError(f"{name}: vertex {bad[0]} is {rows[bad[0]].tolist()}, need finite numbers")
    return rows


def _frozen(array: NDArray) -> NDArray:
    array.flags.writeable = False
    return array
