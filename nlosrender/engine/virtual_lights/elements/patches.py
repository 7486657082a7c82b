"""Patches: parts of the hidden surfaces small enough to be gathered as one light each. docs/virtual-lights.md, 2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.struct_of_arrays import StructOfArrays
from nlosrender.engine.virtual_lights.elements.triangles import normals_and_areas
from nlosrender.scene.pose import Float64

# Points of a patch where shadow rays end: all rays of the only laser, one of each sensor point or all of each node of
# a lattice. Noise 0.25 / 0.18 / 0.15 % of 8 seeds at half / as is / twice, 0.42 % at 1 (screen of 4,496 patches).
SHADOW_RAYS = 4

Float32 = NDArray[np.float32]

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements


@dataclass(frozen=True, eq=False)
class SurfacePoints(StructOfArrays):
    """Points of the hidden geometry [engine units]."""

    positions: Float64  # (n, 3)
    normals: Float64  # (n, 3) geometric, unit
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of a mesh, 0 on analytic shapes
    barycentric: Float64  # (n, 2) within that triangle


@dataclass(frozen=True, eq=False)
class Patches(StructOfArrays):
    """Triangular patches, and parallelograms of clusters [engine units].

    ``areas``, ``centres`` and ``normals`` are those of the true surface where it is curved; its corners lie on it.
    """

    corners: Float64  # (n, 3, 3) of clusters three successive ones of a parallelogram's four
    areas: Float64  # (n,)
    centres: Float64  # (n, 3)
    normals: Float64  # (n, 3) geometric, unit
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of a mesh, 0 on analytic shapes
    barycentric: Float64  # (n, 2) of the centre within that triangle
    corner_barycentric: Float64  # (n, 3, 2) of the corners; of clusters, and off meshes, the centre's
    members: Float32  # (n, SHADOW_RAYS, 3) from the centre to where shadow rays of a cluster end; elsewhere 0
    member_normals: Float32  # (n, SHADOW_RAYS, 3) geometric, there; elsewhere 0
    is_cluster: NDArray[np.bool_]  # (n,)

    @classmethod
    def none(cls) -> Patches:
        """Return no patches."""
        none = np.zeros((0, 3))
        return cls.triangles(np.zeros((0, 3, 3)), np.zeros(0), none, none, np.zeros(0, np.uint32))

    def points(self, positions: Float64, barycentric: Float64) -> SurfacePoints:
        """Return one point per patch; parameters (n, 3) and (n, 2)."""
        return SurfacePoints(positions, self.normals, self.shapes, self.primitives, barycentric)

    def mixed(self, weights: Float64) -> SurfacePoints:
        """Return one point per patch, its corners' mean with ``weights`` (n, 3)."""
        position, barycentric = (
            np.einsum("nk,nkx->nx", weights, values) for values in (self.corners, self.corner_barycentric)
        )
        return self.points(position, barycentric)

    @classmethod
    def triangles(
        cls,
        corners: Float64,
        areas: Float64,
        centres: Float64,
        normals: Float64,
        shapes: NDArray[np.uint32],
        primitives: NDArray[np.uint32] | None = None,
        corner_barycentric: Float64 | None = None,
    ) -> Patches:
        """Return patches that are no clusters; without the last two, of analytic shapes."""
        count = len(areas)
        if primitives is None or corner_barycentric is None:
            primitives, corner_barycentric = np.zeros(count, np.uint32), np.zeros((count, 3, 2))
        return cls(
            corners=corners,
            areas=areas,
            centres=centres,
            normals=normals,
            shapes=shapes,
            primitives=primitives,
            barycentric=corner_barycentric.mean(axis=1),
            corner_barycentric=corner_barycentric,
            members=np.zeros((count, SHADOW_RAYS, 3), np.float32),
            member_normals=np.zeros((count, SHADOW_RAYS, 3), np.float32),
            is_cluster=np.zeros(count, bool),
        )


def split_elements(elements: Elements, splits: NDArray[np.int64]) -> Patches:
    """Cut every element into ``splits`` (n,) squared similar triangles."""
    normals, areas = normals_and_areas(elements.corners)
    parts = [Patches.none()]
    for n in np.unique(splits):
        index = np.flatnonzero(splits == n)
        weights = split_weights(int(n))
        corners = np.einsum("pkb,tbx->tpkx", weights, elements.corners[index]).reshape(-1, 3, 3)
        barycentric = np.einsum("pkb,tbx->tpkx", weights, elements.weights[index])[..., 1:].reshape(-1, 3, 2)
        index = np.repeat(index, n * n)
        parts.append(
            Patches.triangles(
                corners,
                areas[index] / (n * n),
                corners.mean(axis=1),
                normals[index],
                elements.shapes[index],
                elements.primitives[index],
                barycentric,
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
