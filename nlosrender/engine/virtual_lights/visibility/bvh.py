"""Bounding volume hierarchy (BVH) of the triangles of the hidden geometry, on the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.facing_triangles import triangles_of
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.virtual_lights.elements.triangles import centroids, normals_and_areas
from nlosrender.scene.pose import Float64

LEAF = 8  # triangles; 2, 4 and 16 were slower
BOX = 8  # numbers, the last two empty: two aligned loads of four
# Corners of the twelve triangles of a box, in the order of Mitsuba's BoundingBox.corner.
FACES_OF_BOX = np.array(
    [
        [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6]],
        [[0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6]],
        [[0, 2, 6], [0, 6, 4], [1, 3, 7], [1, 7, 5]],
    ]
).reshape(12, 3)


@dataclass(frozen=True, eq=False)
class Bvh:
    """A complete binary tree: box 1 holds all triangles, the children of box k are 2 k and 2 k + 1 [engine units]."""

    boxes: mi.Float  # eight a box: lowest and highest corner; box 0 is none
    triangles: mi.Float  # twelve a triangle: three corners, each with one component of the unit normal
    first: mi.UInt32  # triangle of each leaf, LEAF of them; the last boxes are the leaves
    n_leaves: mi.UInt32  # opaque

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape]) -> Bvh:
        """Return the BVH of meshes and of the bounding boxes of other shapes, split along a Morton curve."""
        triangles = np.concatenate([_triangles(shape) for shape in shapes])
        order = np.argsort(morton_order(centroids(triangles)), kind="stable")
        order = np.append(order, np.repeat(order[-1], max(0, LEAF - len(order))))
        packed = np.empty((len(order), 3, 4), np.float32)
        packed[:, :, :3] = triangles = triangles[order]
        # float64: in float32 the normals of slivers are off by more than what they hide, and those of no area NaN
        packed[:, :, 3] = normals_and_areas(triangles)[0]
        n_leaves = 2 ** math.ceil(math.log2(len(order) / LEAF))
        first = np.arange(n_leaves) * len(order) // n_leaves
        lows = np.minimum.reduceat(packed[:, :, :3].min(axis=1), first)
        highs = np.maximum.reduceat(packed[:, :, :3].max(axis=1), first)
        boxes = np.zeros((2 * n_leaves, BOX), np.float32)
        level = n_leaves
        while level:
            boxes[level : 2 * level, 0:3], boxes[level : 2 * level, 3:6] = lows, highs
            level //= 2
            lows, highs = np.minimum(lows[0::2], lows[1::2]), np.maximum(highs[0::2], highs[1::2])
        return cls(
            on_device(mi.Float, boxes.ravel()),
            on_device(mi.Float, packed.ravel()),
            on_device(mi.UInt32, np.minimum(first, len(order) - LEAF)),
            dr.opaque(mi.UInt32, n_leaves),
        )

    def box(self, node: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
        """Return the lowest and the highest corner of a box."""
        one, two = (dr.gather(mi.Vector4f, self.boxes, 2 * node + k) for k in range(2))
        return mi.Point3f(one.x, one.y, one.z), mi.Point3f(one.w, two.x, two.y)

    def triangle(self, index: mi.UInt32) -> tuple[list[mi.Point3f], mi.Vector3f]:
        """Return the corners of a triangle and its normal, zero where it has no area."""
        rows = [dr.gather(mi.Vector4f, self.triangles, 3 * index + k) for k in range(3)]
        return [mi.Point3f(row.x, row.y, row.z) for row in rows], mi.Vector3f(*(row.w for row in rows))

    def following(self, node: mi.UInt32) -> mi.UInt32:
        """Return the box after ``node`` and all it holds in depth-first order, without a stack; 0 after the last one.

        The next sibling of the last ancestor that is a left child: all of its trailing ones are shifted out.
        """
        sibling = node + 1
        sibling = sibling >> dr.tzcnt(sibling)
        return dr.select(sibling == 1, 0, sibling)


def _triangles(shape: mi.Shape) -> Float64:
    """Return the triangles (n, 3, 3) of a mesh, or of the box around another shape."""
    if shape.is_mesh():
        return triangles_of(shape)
    box = shape.bbox()
    corners = np.array([np.ravel(np.asarray(box.corner(k), dtype=np.float64)) for k in range(8)])
    return corners[FACES_OF_BOX]
