"""Shadow rays of the gathers: whether a point of the wall and a point of a hidden surface see each other."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.flat_mirrors import FlatMirrors, image_in
from nlosrender.engine.launch.ray_offsets import off_the_wall
from nlosrender.scene.build import BuiltScene


def is_visible(
    built: BuiltScene,
    wall_point: mi.SurfaceInteraction3f,
    to_surface: mi.Vector3f,
    offset: mi.Vector3f,
    active: mi.Bool,
    mask: mi.UInt64 | None = None,
    tile: mi.UInt64 | None = None,
) -> mi.Bool:
    """Return whether nothing lies between a point of the wall and the point ``to_surface`` away on a hidden surface.

    The shadow ray ends at the latter moved by ``offset``, the ray offset along the surface's normal, to the side that
    faces the wall point. Where ``mask``, that of the surface point, holds ``tile``, that of the wall point, no ray is
    traced.
    """
    origin = off_the_wall(built, wall_point)
    direction = to_surface - (origin - wall_point.p)
    direction -= offset * dr.sign(dr.dot(offset, direction))
    asked = active if mask is None else active & ((mask & tile) == 0)
    ray = mi.Ray3f(origin, direction, mi.Float(1), mi.Float(0), [])
    return active & ~(asked & built.scene.ray_test(ray, coherent=False, active=asked))


def mirrored_share(
    built: BuiltScene,
    mirror: FlatMirrors | None,
    wall_point: mi.SurfaceInteraction3f,
    point: mi.Point3f,
    offset: mi.Vector3f,
    active: mi.Bool,
) -> mi.Spectrum:
    """Return the share of light that a scene's only mirror sends from a point of a hidden surface to one of the wall.

    0 where either does not see the mirror's image of the other; ``offset`` as for ``is_visible``. 1 without a mirror.
    """
    if mirror is None:
        return mi.Spectrum(1)
    start = point + offset * dr.sign(dr.dot(offset, image_in(mirror, wall_point.p) - point))
    return mirror.share(built, wall_point, point, start, active)
