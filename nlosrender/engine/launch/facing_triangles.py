"""Triangles of a mesh that the relay wall may see on a side which reflects; only these are sampled or gathered."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.build import BuiltScene, wall_box
from nlosrender.scene.pose import Float64


def triangles_of(mesh: mi.Mesh) -> Float64:
    """Return the corners (n, 3, 3) of a mesh's triangles [engine units]."""
    parameters = mi.traverse(mesh)
    vertices = np.asarray(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    return vertices[np.asarray(parameters["faces"]).reshape(-1, 3)]


def is_one_sided(shape: mi.Shape) -> bool:
    """Return whether the BSDF of a shape is black on the back side."""
    return not bool(shape.bsdf().flags() & mi.BSDFFlags.BackSide)


def _visible_from(
    wall_corners: Float64, triangles: Float64, one_sided: bool, wall_is_planar: bool
) -> NDArray[np.bool_]:
    """Return which triangles some point of the box ``wall_corners`` (8, 3) may see on a side that reflects."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    visible = np.linalg.norm(normals, axis=-1) > 0
    if wall_is_planar:
        visible &= triangles[:, :, 2].max(axis=1) > 0  # nothing behind the wall's plane is lit or seen
    if not one_sided:
        return visible
    # The whole box is behind a plane when its corner farthest along the plane's normal is.
    low, high = wall_corners.min(axis=0), wall_corners.max(axis=0)
    farthest = np.where(normals > 0, high, low) - triangles[:, 0]
    return visible & (np.einsum("nx,nx->n", farthest, normals) > 0)


def facing_triangles(
    built: BuiltScene, mesh: mi.Mesh, images: Callable[[Float64], Float64] | None = None
) -> tuple[Float64, NDArray[np.uint32]]:
    """Return the corners (n, 3, 3) [engine units] of the triangles that the wall may see lit, and their numbers (n,).

    Left out are triangles that turn a black side to the whole wall, and to its image in a mirror, if there is one:
    ``images`` returns those of points (n, 3). Occlusion by other surfaces is not considered.
    """
    triangles = triangles_of(mesh)
    corners = wall_box(built.wall) / built.metres_per_engine_unit
    # Shading normals may light part of a geometric back side.
    one_sided = is_one_sided(mesh) and not mesh.has_vertex_normals()
    visible = _visible_from(corners, triangles, one_sided, built.wall.is_planar)
    if images is not None:
        visible |= _visible_from(images(corners), triangles, one_sided, built.wall.is_planar)
    (numbers,) = np.nonzero(visible)
    return triangles[numbers], numbers.astype(np.uint32)
