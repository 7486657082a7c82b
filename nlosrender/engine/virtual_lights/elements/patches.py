"""Patches: pieces of the hidden surfaces small enough to be gathered as one light each."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.subdivision import Elements
from nlosrender.scene.pose import Float64


@dataclass(frozen=True, eq=False)
class Patches:
    """Triangular patches of the hidden geometry [engine units].

    ``areas``, ``centres`` and ``normals`` are those of the true surface where it is curved; ``corners`` are raised to
    its mean height over them.
    """

    corners: Float64  # (n, 3, 3); of clusters three in a row of a parallelogram's four
    areas: Float64  # (n,)
    centres: Float64  # (n, 3)
    normals: Float64  # (n, 3) geometric, unit
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of a mesh, 0 on analytic shapes
    barycentric: Float64  # (n, 2) the centre within that triangle
    corner_barycentric: Float64  # (n, 3, 2) the corners within that triangle; of clusters, and off meshes, the centre
    members: Float64  # (n, 3) where shadow rays of a cluster end; elsewhere the centre
    member_normals: Float64  # (n, 3) geometric, there
    is_cluster: NDArray[np.bool_]  # (n,)

    def __len__(self) -> int:
        return len(self.areas)

    def at(self, index: NDArray[np.integer]) -> Patches:
        """Return the patches at ``index``."""
        return Patches(*(getattr(self, field.name)[index] for field in fields(Patches)))

    @classmethod
    def joined(cls, parts: list[Patches]) -> Patches:
        """Return the patches of all parts."""
        if not parts:
            none, index = np.zeros((0, 3)), np.zeros(0, np.uint32)
            corners, numbers, pairs = np.zeros((0, 3, 3)), np.zeros(0), np.zeros((0, 2))
            places = np.zeros((0, 3, 2))
            return cls(corners, numbers, none, none, index, index, pairs, places, none, none, index.astype(bool))
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def split_cells(elements: Elements, splits: NDArray[np.int64]) -> Patches:
    """Cut every cell into ``splits`` squared similar triangles."""
    normals = np.cross(elements.corners[:, 1] - elements.corners[:, 0], elements.corners[:, 2] - elements.corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    parts = []
    for n in np.unique(splits):
        row_points = np.flatnonzero(splits == n)
        weights = split_weights(int(n))  # (n^2, 3 corners, 3 barycentric)
        corners = np.einsum("pkb,tbx->tpkx", weights, elements.corners[row_points]).reshape(-1, 3, 3)
        barycentric = np.einsum("pkb,tbx->tpkx", weights, elements.weights[row_points])[..., 1:].reshape(-1, 3, 2)
        repeated = np.repeat(row_points, n * n)
        units = normals[repeated] / lengths[repeated, None]
        parts.append(
            Patches(
                corners,
                lengths[repeated] / (2 * n * n),
                corners.mean(axis=1),
                units,
                elements.shapes[repeated],
                elements.primitives[repeated],
                barycentric.mean(axis=1),
                barycentric,
                corners.mean(axis=1),
                units,
                np.zeros(len(repeated), bool),
            )
        )
    return Patches.joined(parts)


def split_weights(n: int) -> Float64:
    """Return the n^2 similar parts of a triangle, (n^2, 3 corners, 3 barycentric coordinates)."""
    parts = []
    for i in range(n):
        for j in range(n - i):
            parts.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                parts.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    second_third = np.array(parts, dtype=np.float64) / n
    return np.concatenate([1 - second_third.sum(axis=-1, keepdims=True), second_third], axis=-1)
