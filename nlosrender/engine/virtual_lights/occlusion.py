"""Scenes and patches between which and the wall nothing can lie: no visibility rays are needed there."""

from __future__ import annotations

from contextlib import suppress

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from nlosrender.engine.virtual_lights.patches import Patches
from nlosrender.scene.build import BuiltScene, wall_box
from nlosrender.scene.pose import Float64

MOST_FACES = 4000  # beyond it the test itself, faces times vertices, costs more than the rays it saves
MOST_CORNERS = 512  # of the hull
MOST_HEIGHTS = 2**22  # of corners over planes at a time, for memory
PLANARITY = 1e-6  # engine units: float32 vertices of a plane of size 1 are good to 1e-7
PARALLEL = 1e-9  # sine of the angle to the wall


def nothing_occludes(built: BuiltScene) -> bool:
    """Return whether no surface can hide a front-facing point of the hidden geometry from a planar wall.

    That holds for one object alone in front of a planar wall: a sphere seen from outside; a mesh whose vertices all
    lie behind (or in) the plane of each of its faces: a flat sheet, a box, any convex solid; and a mesh whose vertices
    and whose wall all lie in front of each face: a convex room around the wall.
    """
    if not built.wall.is_planar or len(built.hidden_shapes) != 1:
        return False
    shape = built.hidden_shapes[0]
    if not shape.is_mesh():
        return shape.class_name() == "Sphere" and not shape.has_flipped_normals()
    if shape.face_count() > MOST_FACES or bool(shape.bsdf().flags() & mi.BSDFFlags.BackSide):
        return False  # a two-sided sheet may be seen from behind, past its own other faces
    parameters = mi.traverse(shape)
    vertices = np.asarray(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    corners = vertices[np.asarray(parameters["faces"]).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    real = lengths[:, 0] > 0
    normals = normals[real] / lengths[real]
    offsets = np.einsum("ij,ij->i", corners[real, 0], normals)
    heights = vertices @ normals.T - offsets
    of_wall = wall_box(built.wall) / built.unit @ normals.T - offsets
    is_convex = heights.max(initial=0.0) <= PLANARITY
    is_room = min(heights.min(initial=0.0), of_wall.min(initial=0.0)) >= -PLANARITY
    return bool(is_convex or is_room)


class HiddenHull:
    """The convex hull of all hidden geometry: a patch in one of its faces is seen from everywhere in front of it.

    Parameters
    ----------
    built
        The scene. Before a curved wall, or with surfaces that reflect on both sides, no patch is known to be seen.
    """

    def __init__(self, built: BuiltScene):
        shapes = built.hidden_shapes
        two_sided = any(bool(shape.bsdf().flags() & mi.BSDFFlags.BackSide) for shape in shapes)
        self.corners: Float64 | None = None
        if built.wall.is_planar and shapes and not two_sided:
            corners = _outermost(np.concatenate([_points(shape) for shape in shapes]))
            # a round mesh has all its vertices on its hull: looking at each for every patch costs more than the rays
            self.corners = corners if len(corners) <= MOST_CORNERS else None

    def is_below(self, patches: Patches) -> NDArray[np.bool_]:
        """Return which patches (n,) have all hidden geometry behind, or in, their planes."""
        if self.corners is None:
            return np.zeros(len(patches), bool)
        result = np.zeros(len(patches), bool)
        step = max(1, MOST_HEIGHTS // len(self.corners))
        for start in range(0, len(patches), step):
            part = slice(start, start + step)
            normals = patches.normals[part]
            offsets = np.einsum("ij,ij->i", patches.centres[part], normals)
            # the heights of planes parallel to the wall are exact, and those close to it are told apart
            is_parallel = np.hypot(normals[:, 0], normals[:, 1]) < PARALLEL
            allowed = PLANARITY * np.where(is_parallel, np.abs(offsets), 1.0)
            result[part] = (normals @ self.corners.T).max(axis=1) - offsets <= allowed
        return result


def _points(shape: mi.Shape) -> Float64:
    """Return points whose convex hull holds a shape: vertices of a mesh, else the corners of its box."""
    if shape.is_mesh():
        return np.asarray(mi.traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    box = shape.bbox()
    return np.array([np.ravel(np.asarray(box.corner(k), dtype=np.float64)) for k in range(8)])


def _outermost(points: Float64) -> Float64:
    """Return the points (m, 3) that are corners of the convex hull."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # all in a plane, perhaps on a line
        return _outermost_in_plane(points)


def _outermost_in_plane(points: Float64) -> Float64:
    """The same for points that lie in one plane, or nearly: what lies off it by more than rounding stays."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    x, y, z = ((points - middle) @ axes.T).T
    ends = [int(end(values)) for values in (x, y, z) for end in (np.argmin, np.argmax)]
    with suppress(QhullError):  # a line: its ends are known
        ends += ConvexHull(np.column_stack([x, y])).vertices.tolist()
    return points[np.unique(ends)]
