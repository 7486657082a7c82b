"""Triangles without order, what hides points behind them, and meshes made of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def mesh_of(triangles: Array) -> Any:
    """Return a Mitsuba mesh of triangles (n, 3, 3); the backend has to be started before."""
    import mitsuba as mi

    count = len(triangles)
    mesh = mi.Mesh("soup", 3 * count, count)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.asarray(triangles, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.arange(3 * count, dtype=np.uint32))
    parameters.update()
    return mesh


def triangles_of(mesh: Any) -> Array:
    """Return the triangles (n, 3, 3) of a Mitsuba mesh."""
    import mitsuba as mi

    parameters = mi.traverse(mesh)
    vertices = np.asarray(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    return vertices[np.asarray(parameters["faces"]).reshape(-1, 3)]


def unit_normals(triangles: Array) -> Array:
    """Return the normals (n, 3) of triangles (n, 3, 3), zero where they have no area."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]


def hits(start: Array, end: Array, triangles: Array) -> Array:
    """Return where segments meet triangles: (m, n) of the way from ``start`` to ``end`` (m, 3), NaN where they do not.

    A segment meets a triangle if its ends lie on different sides of the plane, and its line passes all edges on the
    same side: the volumes that it spans with them have one sign.
    """
    way = end - start
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    heights = [point @ normals.T - np.einsum("nx,nx->n", triangles[:, 0], normals) for point in (start, end)]
    volumes = []
    for k in range(3):
        one, other = triangles[:, k], triangles[:, k - 1]
        # way . ((one - start) x (other - start)) = way . (one x other) + (start x way) . (other - one)
        volumes.append(way @ np.cross(one, other).T + np.cross(start, way) @ (other - one).T)
    inside = np.all(np.stack(volumes) > 0, axis=0) | np.all(np.stack(volumes) < 0, axis=0)
    crosses = heights[0] * heights[1] < 0
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inside & crosses, heights[0] / (heights[0] - heights[1]), np.nan)
