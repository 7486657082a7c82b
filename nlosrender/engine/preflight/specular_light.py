"""Specular light: trial rays from the laser or lamps through delta lobes (mirrors, glass, masks).

Rays whose first hit has a delta lobe (S) are followed until they scatter at a vertex that a sensor point sees. Nothing
is rendered: the result is which surfaces send light along paths that no technique samples, see ``unsampled_paths``.
What one mirror, flat or convex, sends from the laser to a surface that scatters is none of it: connections find it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.arrivals import sampled_indices
from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import columns
from nlosrender.engine.launch.mirror_connections import Mirrors, mirrors_of
from nlosrender.engine.launch.ray_offsets import offset_origin
from nlosrender.engine.launch.surface_sampler import SAMPLEABLE_PLUGINS
from nlosrender.engine.launch.wall_points import laser_points
from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.loading.number_of_shape import pointer_index
from nlosrender.scene.pose import Float64
from nlosrender.scene.view import BuiltView

RAYS = 2**16  # in all, shared by surfaces and laser points: light from less than about 1e-4 of a mirror is missed
MIN_RAYS = 256  # of one surface and one laser point: light from less than about 1 % of a mirror is missed
MAX_EVENTS = 16  # hits that a ray is followed for; chosen: 15 mirrors of reflectance 0.9 leave 20 % of the light
RAY_MARGIN = 1e-4  # share of a ray's length that is left out before its end; chosen, not measured
WALL_NAME = "scene.relay_wall"


@dataclass(frozen=True)
class SpecularLight:
    """Light that a delta lobe of one surface sends to a vertex that the capture measures."""

    item: str  # "scene.hidden_geometry.0 (front)"
    is_reflected: bool  # else let through
    first_bounce: int  # the lowest bounce it can add to


@dataclass(frozen=True, eq=False)
class _Rays:
    """Trial rays, one lane each."""

    ray: mi.Ray3f  # of length 0 where nothing is sent
    is_specular: bool  # whether an S lies behind it already


def light_after_laser(
    built: BuiltScene, capture: Capture, time_axis: TimeAxis, max_bounces: int | None
) -> list[SpecularLight]:
    """Return what light of the laser points the surfaces with delta lobes send on that can reach sensor points.

    Parameters
    ----------
    built, capture, time_axis
        As for the engines.
    max_bounces
        Highest bounce that is rendered; None for no limit.
    """
    shapes = [shape for shape in _with_wall(built) if bool(shape.bsdf().flags() & mi.BSDFFlags.Delta)]
    if not shapes:
        return []
    index = sampled_indices(capture.laser_grid)
    per_pair = max(MIN_RAYS, RAYS // (len(shapes) * len(index)))
    targets = np.concatenate([_points_on(shape, per_pair, seed) for seed, shape in enumerate(shapes)])
    lasers = np.repeat(index, len(targets)).astype(np.uint32)
    lit = laser_points(built, capture, time_axis, lasers).interaction
    aim = mi.Point3f(*columns(np.tile(targets, (len(index), 1))))
    direction = dr.normalize(aim - lit.p)
    emitted = built.bsdf_at(lit).eval(mi.BSDFContext(), lit, lit.to_local(direction))
    sent = dr.any(mi.unpolarized_spectrum(emitted) > 0)
    rays = _Rays(_ray(built, lit, direction, sent), False)
    return list(_followed(built, capture, time_axis, rays, max_bounces, 1, mirrors_of(built)))


def light_mirrored_by_wall(
    built: BuiltScene, capture: Capture, time_axis: TimeAxis, max_bounces: int | None
) -> list[SpecularLight]:
    """Return the laser's beam as mirrored by delta lobes of the wall, where it meets anything; parameters as above."""
    if not any(bool(shape.bsdf().flags() & mi.BSDFFlags.Delta) for shape in built.lit_shapes):
        return []
    index = sampled_indices(capture.laser_grid)
    lasers = np.repeat(index, MIN_RAYS).astype(np.uint32)
    lit = laser_points(built, capture, time_axis, lasers).interaction
    bs, weight = built.bsdf_at(lit).sample(mi.BSDFContext(), lit, *_numbers(len(lasers), 0))
    mirrored = _is_delta(bs) & _carries(weight)
    rays = _Rays(_ray(built, lit, lit.to_world(bs.wo), mirrored), True)
    found = _followed(built, capture, time_axis, rays, max_bounces, 1)
    mirror = next(shape for shape in built.lit_shapes if bool(shape.bsdf().flags() & mi.BSDFFlags.Delta))
    name = _names(built)[pointer_index(mirror)]
    return [SpecularLight(name, True, light.first_bounce) for light in found]


def light_after_lamps(
    built: BuiltView, capture: Capture, time_axis: TimeAxis, max_bounces: int | None
) -> list[SpecularLight]:
    """Return what light of lamps without extent is sent on by delta lobes to surfaces; parameters as above."""
    kinds = mi.EmitterFlags.DeltaPosition | mi.EmitterFlags.DeltaDirection
    lamps = [lamp for lamp in built.scene.emitters() if bool(lamp.flags() & kinds)]
    lamps = [lamp for lamp in lamps if not bool(lamp.flags() & mi.EmitterFlags.Infinite)]  # outside any window
    if not any(bool(shape.bsdf().flags() & mi.BSDFFlags.Delta) for shape in built.hidden_shapes):
        return []
    found: list[SpecularLight] = []
    for number, lamp in enumerate(lamps):
        one, two = _numbers(RAYS, number)
        _, three = _numbers(RAYS, number + len(lamps))
        ray, weight = lamp.sample_ray(0.0, one, two, three)
        ray.maxt = dr.select(_carries(weight), dr.largest(mi.Float), 0)
        rays = _Rays(mi.Ray3f(ray), False)
        found += _followed(built, capture, time_axis, rays, max_bounces, 0)
    return found


def _followed(
    built: BuiltScene | BuiltView,
    capture: Capture,
    time_axis: TimeAxis,
    start: _Rays,
    max_bounces: int | None,
    interactions: int,
    mirrors: tuple[Mirrors, ...] = (),
) -> Iterator[SpecularLight]:
    """Follow rays that had ``interactions`` surface interactions; yield the specular light of the surfaces met first.

    Rays that ``mirrors`` send straight to where they scatter are left out.

    The bounce is the lowest that a surface was seen to add to: a ray met the wall among the sensor points, or scattered
    where one of them sees it.
    """
    ray, opl = start.ray, mi.Float(0)  # a lower bound on the optical path length so far [engine units]
    alive, n_rays = mi.Bool(ray.maxt > 0), dr.width(ray.d)
    latest = (
        time_axis.end_opl - float(capture.laser_legs.min() + capture.sensor_legs.min())
    ) / built.metres_per_engine_unit
    first = np.zeros(n_rays, dtype=np.int64)  # twice the number of the first surface, plus 1 if it reflected the ray
    lowest: dict[int, int] = {}  # bounce by ``first``
    is_imaged = np.zeros(n_rays, dtype=bool)  # the first surface is a mirror that reflected the ray
    for event in range(MAX_EVENTS):
        count = interactions + event + 1  # interactions up to the surface that is met now
        if max_bounces is not None and count > max_bounces:
            break
        si = built.scene.ray_intersect(ray, alive)
        numbers = _numbers(n_rays, 100 + event)
        bs, weight = si.bsdf().sample(mi.BSDFContext(), si, *numbers, alive & si.is_valid())
        opl = opl + si.t
        hit = np.array(alive & si.is_valid() & _carries(weight) & (opl <= latest), dtype=bool)
        is_delta = np.array(_is_delta(bs), dtype=bool)
        if event == 0:
            crossing = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(bs.wo)
            first = 2 * np.array(dr.reinterpret_array(mi.UInt32, si.shape), dtype=np.int64) + np.array(crossing > 0)
            hit &= is_delta | start.is_specular
            for kind in mirrors:
                is_imaged |= np.array(kind.is_met(si, mi.Bool(hit)) & (crossing > 0), dtype=bool)
        if event == 1:
            hit &= is_delta | ~is_imaged
        if event > 0 or start.is_specular:
            scattered = mi.Bool(hit & ~is_delta)
            for more, measured in enumerate(_measured(built, capture, si, scattered, event)):
                for sent in np.unique(first[measured]).tolist():
                    lowest.setdefault(sent, count + more)
        if set(np.unique(first[hit]).tolist()) <= set(lowest):
            break
        ray, alive = si.spawn_ray(si.to_world(bs.wo)), mi.Bool(hit)
        dr.eval(ray, opl, alive)
    names = _names(built)
    for sent, bounce in lowest.items():
        if max_bounces is None or bounce <= max_bounces:
            yield SpecularLight(names.get(sent // 2, "the scene"), bool(sent % 2), bounce)


def _measured(
    built: BuiltScene | BuiltView, capture: Capture, si: mi.SurfaceInteraction3f, scattered: mi.Bool, seed: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (rays,) whether a scattering vertex is measured itself, and whether it is seen from a sensor point.

    Measured are vertices on the wall among the sensor points, or any before a camera; for the other, one sensor point
    is drawn at random.
    """
    active = np.array(scattered, dtype=bool)
    if isinstance(built, BuiltView):
        return active, np.zeros_like(active)
    grid = capture.sensor_grid.lattice
    points = grid.positions.reshape(-1, 3) / built.metres_per_engine_unit
    margin = (
        max(size / count for size, count in zip(grid.size, (grid.nx, grid.ny), strict=True))
        / built.metres_per_engine_unit
    )
    place = np.array(si.p, dtype=np.float64).T
    near = ((place >= points.min(axis=0) - margin) & (place <= points.max(axis=0) + margin)).all(axis=-1)
    on_wall = np.array(built.is_wall(si.shape), dtype=bool)
    chosen = points[np.random.default_rng(seed).integers(len(points), size=len(place))]
    direction = mi.Point3f(*columns(chosen)) - si.p
    distance = dr.norm(direction)
    direction /= distance
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), scattered)
    sees = mi.Bool(scattered & _carries(value))
    way = mi.Ray3f(offset_origin(built, si, direction), direction, distance * (1 - RAY_MARGIN), mi.Float(0), [])
    sees &= ~built.scene.ray_test(way, sees)
    return active & on_wall & near, np.array(sees, dtype=bool)


def _with_wall(built: BuiltScene) -> tuple[mi.Shape, ...]:
    has_wall = not (built.wall.is_planar or isinstance(built, SceneWithoutWall))
    return (*built.hidden_shapes, *((built.wall_shape,) if has_wall else ()))


def _names(built: BuiltScene | BuiltView) -> dict[int, str]:
    """Return the items by the numbers that shape pointers have on the device."""
    names: dict[int, str] = {}
    if isinstance(built, BuiltScene) and not isinstance(built, SceneWithoutWall):
        names[pointer_index(built.wall_shape)] = WALL_NAME
    keyed = len(built.surfaces) == len(built.hidden_shapes)  # a Mitsuba scene has shapes of its own
    for place, shape in enumerate(built.hidden_shapes):
        surface = built.surfaces[place] if keyed else None
        names[pointer_index(shape)] = f"{surface.key} ({surface.name})" if surface else shape.id() or shape.class_name()
    return names


def _ray(built: BuiltScene, lit: mi.SurfaceInteraction3f, direction: mi.Vector3f, is_sent: mi.Bool) -> mi.Ray3f:
    ray = mi.Ray3f(offset_origin(built, lit, direction), direction)
    ray.maxt = dr.select(is_sent, dr.largest(mi.Float), 0)
    return ray


def _points_on(shape: mi.Shape, count: int, seed: int) -> Float64:
    """Return points (count, 3) spread over a shape, or over its box where the shape cannot be sampled."""
    draw = np.random.default_rng(seed)
    if shape.is_mesh() or shape.class_name() in SAMPLEABLE_PLUGINS:
        at = mi.Point2f(*columns(draw.random((count, 2))))
        return np.array(shape.sample_position(mi.Float(0), at).p, dtype=np.float64).T
    low, high = (np.ravel(np.asarray(corner, dtype=np.float64)) for corner in (shape.bbox().min, shape.bbox().max))
    return low + (high - low) * draw.random((count, 3))


def _numbers(count: int, seed: int) -> tuple[mi.Float, mi.Point2f]:
    lobe, *place = columns(np.random.default_rng(seed).random((count, 3)))
    return lobe, mi.Point2f(*place)


def _is_delta(bs: mi.BSDFSample3f) -> mi.Bool:
    return mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)


def _carries(weight: mi.Spectrum) -> mi.Bool:
    return dr.any(mi.unpolarized_spectrum(weight) > 0)
