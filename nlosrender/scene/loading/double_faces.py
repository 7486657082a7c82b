"""Removes duplicate triangles: light would count both, although rays meet only one of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

# 2^64 over the golden ratio, and two primes of xxHash64: products with odd numbers of many bits mix a coordinate's bits
_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def without_double_faces(mesh: TriangleMesh, *, both_sides: bool) -> TriangleMesh:
    """Return the mesh with one of every set of triangles that have the same three corners; itself if there are none.

    Parameters
    ----------
    mesh
        Corners are the same when their coordinates are, to the last bit.
    both_sides
        The surface reflects from its back, too: triangles that face opposite ways are doubles as well.
    """
    twins = first_of_doubles(mesh.vertices[mesh.faces], both_sides=both_sides)
    mask = twins == np.arange(len(twins))
    return mesh if mask.all() else mesh.subset(mask)


def first_of_doubles(corners: NDArray[np.floating], *, both_sides: bool) -> NDArray[np.intp]:
    """Return for each of the triangles (m, 3, 3) the first one with the same corners; itself where there is none."""
    corners = corners.astype(np.float64) + 0.0  # + 0.0: -0.0 and 0.0 are one place
    keys = _keys(corners)
    twins = np.arange(len(keys))
    _, first, group = np.unique(keys, return_index=True, return_inverse=True)
    if len(first) == len(keys):
        return twins
    suspects = np.flatnonzero(np.bincount(group)[group] > 1)  # equal keys may be chance: these few are compared
    order = np.lexsort(np.moveaxis(corners[suspects], -1, 0)[::-1], axis=-1)
    sorted_corners = np.take_along_axis(corners[suspects], order[..., None], axis=1).reshape(len(suspects), 9)
    if not both_sides:
        # an even permutation keeps the side a triangle faces
        even = np.isin(order @ [9, 3, 1], [0 * 9 + 1 * 3 + 2, 1 * 9 + 2 * 3 + 0, 2 * 9 + 0 * 3 + 1])
        sorted_corners = np.column_stack([sorted_corners, even])
    _, kept, same = np.unique(sorted_corners, axis=0, return_index=True, return_inverse=True)
    twins[suspects] = suspects[kept[np.ravel(same)]]
    return twins


def _keys(corners: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return one number per triangle (m, 3, 3), the same whatever the order of its corners."""
    bits = np.ascontiguousarray(corners).view(np.uint64)
    with np.errstate(over="ignore"):
        mixed = (bits * _MULTIPLIERS).sum(axis=-1, dtype=np.uint64)
        mixed ^= mixed >> np.uint64(29)
        return (mixed * _MULTIPLIERS[0] ^ (mixed >> np.uint64(32))).sum(axis=-1, dtype=np.uint64)
