"""Ray offsets against self-intersection: origins of rays and both ends of shadow rays are moved off their surfaces.

Both ends of a shadow ray are moved along the normals, not along the ray: a surface in front of either end is met
however oblique the ray, as long as the gap is wider than the offset. A planar wall is z = 0 exactly and needs none.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.pose import Float64

MIN_COSINE = 1e-2  # between a ray and a surface's normal
# Ray offset along the normal, over 1 + the largest coordinate [engine units]. A ray from the wall to a point this far
# before a triangle meets that triangle in 0 of 2e6 tries at 4e-7, in 1e-3 at 2e-7 (float32, tilts of 0 to 88 degrees).
# Of a sphere of radius r < 1 the quadratic equation is good to 1 / r times that: 0 of 2e6 at r = 1, 0.3 and 0.01.
RAY_OFFSET = 5e-7
ROUGH_RAY_OFFSET = 2e-5  # shapes whose intersections are found numerically, see ``BuiltScene.has_exact_hits``
WALL_OFFSET = 1e-20  # engine units: points of a planar wall have z = 0 exactly, and rays leave it on the right side
HEIGHT_SHARE = 0.25  # of a surface's height over a planar wall: the ray offset never carries a ray beyond the wall


def offset_origin(built: BuiltScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Point3f:
    """Return the origin of a ray that leaves a surface in ``direction``: moved along the normal, to the ray's side.

    Points of a planar wall need no offset; that of surfaces close to it is limited so that it does not cross the wall:
    no surface is too near to the wall to be met or lit.
    """
    scale = ray_offset_at(built, si.p, si.shape)
    side = dr.dot(si.n, direction)
    if not built.wall.is_planar:
        return si.p + si.n * dr.mulsign(mi.Float(scale), side)
    scale = dr.minimum(scale, HEIGHT_SHARE * dr.abs(si.p.z) / dr.maximum(dr.abs(si.n.z), HEIGHT_SHARE))
    origin = si.p + si.n * dr.mulsign(mi.Float(scale), side)
    on_wall = si.shape == mi.ShapePtr(built.wall_shape)
    origin.z = dr.select(on_wall, dr.mulsign(mi.Float(WALL_OFFSET), direction.z), origin.z)
    return origin


def ray_offset(built: BuiltScene) -> float:
    """Return the ray offset of a scene, over 1 + the largest coordinate [engine units]."""
    return RAY_OFFSET if built.has_exact_hits else ROUGH_RAY_OFFSET


def ray_offset_at(built: BuiltScene, point: mi.Point3f, shape: mi.ShapePtr) -> mi.Float:
    """Return the ray offset at a point of a shape [engine units]: what float32 coordinates of its size need."""
    offset = ray_offset(built) * (1 + dr.max(dr.abs(point)))
    if not built.is_curved:
        return offset
    return offset * dr.maximum(dr.gather(mi.Float, built.curvatures, dr.reinterpret_array(mi.UInt32, shape)), 1)


def off_the_surface(built: BuiltScene, positions: Float64, normals: Float64, shapes: NDArray[np.uint32]) -> Float64:
    """Return points (n, 3) of hidden surfaces moved along their unit normals by the ray offset, see ``offset_origin``.

    Shadow rays end there: whatever lies in front of the surface by more than the offset is met. ``shapes`` (n,) are
    the indices of their shapes in the scene.
    """
    curvatures = built.curvature_of_shapes[shapes]
    scale = ray_offset(built) * (1 + np.abs(positions).max(axis=1, initial=0.0)) * np.maximum(curvatures, 1)
    if built.wall.is_planar:
        highest = HEIGHT_SHARE * np.abs(positions[:, 2]) / np.maximum(np.abs(normals[:, 2]), HEIGHT_SHARE)
        scale = np.minimum(scale, highest)
    return positions + normals * scale[:, None]


def off_the_wall(
    built: BuiltScene, wall_point: mi.SurfaceInteraction3f, direction: mi.Vector3f | None = None
) -> mi.Point3f:
    """Return the origin of a ray that leaves a laser or sensor point on the lit side.

    Points of a ``SceneWithoutWall`` have the side in ``direction``, without one that of the laser or sensor.
    """
    if built.wall.is_planar:
        offset = mi.Float(WALL_OFFSET)
    else:
        offset = ray_offset_at(built, wall_point.p, built.shape_at(wall_point))
    if isinstance(built, SceneWithoutWall):
        towards = wall_point.to_world(wall_point.wi) if direction is None else direction
        offset = dr.mulsign(offset, dr.dot(wall_point.n, towards))
    return wall_point.p + wall_point.n * offset


def leg_to_tangent_plane(
    built: BuiltScene, si: mi.SurfaceInteraction3f, origin: mi.Point3f, direction: mi.Vector3f
) -> mi.Vector3f:
    """Return the vector from ``origin``, without ray offset, to the tangent plane of the surface that its ray met.

    The ray offset shortens the leg to a surface close by: 4e-5 m of a 2 m wall are 4 % of H 1 mm in front of it. Where
    the ray grazes, or the surface is curved or lies within the offset, it is the vector to the point that was met.
    """
    along = dr.dot(si.n, direction)
    found = si.p - origin
    way = dr.dot(si.n, found) / along
    trusted = (dr.abs(along) > MIN_COSINE) & (way > 0) & si.is_valid()
    if not built.all_flat:  # otherwise there is no need to ask the surface that was found
        trusted &= si.shape.is_mesh()
    return dr.select(trusted, direction * way, found)


def connection_segment(
    built: BuiltScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, wall_point: mi.SurfaceInteraction3f
) -> mi.Ray3f:
    """Shadow ray from a point of the wall to a surface, from which the wall point lies in ``direction``.

    Both ends are moved along the normals, see the module.
    """
    # aimed at the offset end: a parallel ray would pass beside the point, behind the wall at oblique incidence
    start, end = off_the_wall(built, wall_point, -direction), offset_origin(built, si, direction)
    distance = dr.norm(end - start)
    return mi.Ray3f(start, (end - start) / distance, distance, mi.Float(0), [])
