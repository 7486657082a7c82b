"""Flat shapes as triangle meshes: rectangle, box and room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Pose

_QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]])
_QUAD_UVS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

# Sides of the unit cube centred on the origin: (outward normal, up); u runs along up x normal, v along up.
_BACK = ([0, 0, 1], [0, 1, 0])
_FRONT = ([0, 0, -1], [0, 1, 0])
_RIGHT = ([1, 0, 0], [0, 1, 0])
_LEFT = ([-1, 0, 0], [0, 1, 0])
_TOP = ([0, 1, 0], [0, 0, 1])
_BOTTOM = ([0, -1, 0], [0, 0, 1])


def rectangle_mesh(width: float, height: float, pose: Pose | None = None) -> TriangleMesh:
    """Return a rectangle of two triangles, seen from the side its normal points to.

    Parameters
    ----------
    width, height
        Size along the pose's x and y axes [m], > 0.
    pose
        Centre, axes and normal (z) of the rectangle in the mesh's frame; the frame itself when None.

    Returns
    -------
    TriangleMesh
        4 vertices, 2 faces, texture coordinates 0 to 1 along x and y.
    """
    corners = np.column_stack([(_QUAD_UVS - 0.5) * [width, height], np.zeros(4)])
    return TriangleMesh(corners if pose is None else pose.to_scene(corners), _QUAD_FACES, _QUAD_UVS)


def box_mesh(size: ArrayLike, pose: Pose | None = None) -> TriangleMesh:
    """Return a closed box with outward normals, centred on the pose's origin.

    Parameters
    ----------
    size
        (3,) edge lengths along the pose's axes [m], > 0.
    pose
        Centre and axes of the box in the mesh's frame; the frame itself when None.

    Returns
    -------
    TriangleMesh
        12 faces; each side has its own 4 vertices and texture coordinates 0 to 1.
    """
    sides = _cube_sides([_BACK, _FRONT, _RIGHT, _LEFT, _TOP, _BOTTOM])
    vertices = sides.vertices * np.asarray(size, dtype=np.float64)
    return replace(sides, vertices=vertices if pose is None else pose.to_scene(vertices))


def room_mesh(size: ArrayLike) -> TriangleMesh:
    """Return five sides of a box seen from within, open towards the relay wall, in the wall's local frame.

    Parameters
    ----------
    size
        (3,) width (x), height (y) and depth (z) [m], > 0. The room is centred on the wall in x and y and occupies
        z in [0, depth].

    Returns
    -------
    TriangleMesh
        10 faces with inward normals; each side has its own 4 vertices and texture coordinates 0 to 1.
    """
    edges = np.asarray(size, dtype=np.float64)
    sides = _cube_sides([_BACK, _RIGHT, _LEFT, _TOP, _BOTTOM])
    return replace(sides, vertices=sides.vertices * edges + [0.0, 0.0, edges[2] / 2], faces=sides.faces[:, ::-1])


def _cube_sides(sides: Sequence[tuple[list[int], list[int]]]) -> TriangleMesh:
    poses = [Pose.from_normal_up(0.5 * np.asarray(normal), normal, up) for normal, up in sides]
    return TriangleMesh.merged([rectangle_mesh(1.0, 1.0, pose) for pose in poses])
