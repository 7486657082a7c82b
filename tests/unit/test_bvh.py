"""The bounding volume hierarchy: nothing is lost in it, and a stackless traversal comes by every leaf."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.triangle_soup import mesh_of

pytestmark = pytest.mark.usefixtures("backend")


Array = NDArray[np.float64]


def bvh_of(triangles: Array) -> Any:
    """Return the BVH of triangles (n, 3, 3)."""
    from nlosrender.engine.virtual_lights.visibility.bvh import Bvh

    return Bvh.of([mesh_of(triangles)])


def soup(count: int) -> Array:
    """Return triangles all over a box of 2 x 1 x 0.5."""
    generator = np.random.default_rng(count)
    return (generator.random((count, 1, 3)) + 0.1 * generator.normal(size=(count, 3, 3))) * [2, 1, 0.5]


@pytest.mark.parametrize("count", [1, 2, 8, 9, 1000])
def test_every_triangle_is_in_a_leaf_and_every_box_holds_its_children(count: int) -> None:
    """A walk down from the root may pass over nothing but what lies outside a box."""
    from nlosrender.engine.virtual_lights.visibility.bvh import BOX, LEAF

    triangles, tree = soup(count).astype(np.float32), bvh_of(soup(count))
    n_leaves, boxes = int(tree.n_leaves[0]), np.array(tree.boxes).reshape(-1, BOX)
    low, high = boxes[:, 0:3], boxes[:, 3:6]
    assert len(boxes) == 2 * n_leaves
    for node in range(2, 2 * n_leaves):
        assert (low[node] >= low[node // 2]).all()
        assert (high[node] <= high[node // 2]).all()
    packed = np.array(tree.triangles).reshape(-1, 3, 4)[:, :, :3]
    first, found = np.array(tree.first), set()
    for leaf in range(n_leaves):
        for corners in packed[first[leaf] : first[leaf] + LEAF]:
            if (corners.min(axis=0) >= low[n_leaves + leaf]).all() and (
                corners.max(axis=0) <= high[n_leaves + leaf]
            ).all():
                found.add(corners.tobytes())
    assert found == {corners.tobytes() for corners in triangles}


@pytest.mark.parametrize("count", [1, 2, 8, 9, 1000])
def test_a_walk_through_all_boxes_visits_every_leaf_once(count: int) -> None:
    """Down to the left where there is more below, else on to the box that follows: depth first, and then the end."""
    import mitsuba as mi

    tree = bvh_of(soup(count))
    n_leaves, node, visited = int(tree.n_leaves[0]), 1, []
    following = np.array(tree.following(mi.UInt32(np.arange(2 * n_leaves, dtype=np.uint32))))
    while node:
        if node >= n_leaves:
            visited.append(node)
        node = int(following[node]) if node >= n_leaves else 2 * node
    assert visited == list(range(n_leaves, 2 * n_leaves))


def test_normals_of_slivers_and_of_no_area() -> None:
    """Slivers have the normals of their float32 corners to the last bits, and what has no area has none.

    Differences of corners that float32 rounds would turn the normal of a sliver of 1 x 1e-4 by 1e-3.
    """
    generator = np.random.default_rng(3)
    triangles = generator.random((200, 3, 3))
    triangles[:, 2] = triangles[:, :2].mean(axis=1) + 1e-4 * generator.normal(size=(200, 3))
    triangles[::5, 2] = triangles[::5, 0]
    triangles = triangles.astype(np.float32)
    rows = np.array(bvh_of(triangles).triangles).reshape(-1, 3, 4)
    a, b, c = (rows[:, k, :3].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    assert np.isfinite(rows).all()
    assert np.count_nonzero(lengths == 0) == 40
    np.testing.assert_allclose(rows[:, :, 3], normals / np.maximum(lengths, 1e-300)[:, None], atol=1e-6)


def test_the_smallest_triangles_have_normals() -> None:
    """A millionth of a millionth of a wall: the squares of its areas are no numbers of float32."""
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]) * 1e-12 + [0, 0, 0.5]
    rows = np.array(bvh_of(corners).triangles).reshape(-1, 3, 4)
    np.testing.assert_allclose(np.abs(rows[:, :, 3]), np.tile([0, 0, 1.0], (len(rows), 1)), atol=1e-6)
