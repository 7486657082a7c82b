"""Occlusion-free scenes: nothing can lie between the wall and surfaces that face it, so no shadow rays are cast."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from nlosrender.scene.build import BuiltScene, wall_box

MAX_FACES = 4000  # quadratic cost: 12 ms of CPU time for a closed mesh of 4000 faces and 2002 vertices
FACES_AT_ONCE = 64  # heights of all vertices over so many faces: 64 x 2002 float64 numbers, 1 MB
PLANARITY = 1e-6  # engine units: float32 vertices of a plane of size 1 are good to 1e-7


def nothing_occludes(built: BuiltScene) -> bool:
    """Return whether no surface can hide a front-facing point of the hidden geometry from a planar wall.

    That holds for one object alone in front of a planar wall: a sphere seen from outside; a mesh whose vertices all
    lie behind (or in) the plane of each of its faces: a flat sheet, a box, any convex solid; and a mesh whose vertices
    and whose wall all lie in front of each face: a convex room around the wall. Surfaces that light can reach from
    behind, by their BSDF or by vertex normals that turn away from their faces', may be hidden by the object itself.
    """
    if not built.wall.is_planar or len(built.hidden_shapes) != 1:
        return False
    shape = built.hidden_shapes[0]
    if bool(shape.bsdf().flags() & (mi.BSDFFlags.BackSide | mi.BSDFFlags.Transmission)):
        return False
    if not shape.is_mesh():
        return shape.class_name() == "Sphere" and not shape.has_flipped_normals()
    if shape.face_count() > MAX_FACES or shape.has_vertex_normals():
        return False
    parameters = mi.traverse(shape)
    vertices = np.asarray(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    corners = vertices[np.asarray(parameters["faces"]).reshape(-1, 3)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    real = lengths[:, 0] > 0
    normals = normals[real] / lengths[real]
    offsets = np.einsum("ij,ij->i", corners[real, 0], normals)
    corners_of_wall = wall_box(built.wall) / built.metres_per_engine_unit
    is_convex, is_room = True, True
    for start in range(0, len(normals), FACES_AT_ONCE):
        part = slice(start, start + FACES_AT_ONCE)
        heights = vertices @ normals[part].T - offsets[part]
        of_wall = corners_of_wall @ normals[part].T - offsets[part]
        is_convex &= bool(heights.max(initial=0.0) <= PLANARITY)
        is_room &= bool(min(heights.min(initial=0.0), of_wall.min(initial=0.0)) >= -PLANARITY)
        if not is_convex and not is_room:  # most meshes fail at their first faces
            return False
    return True
