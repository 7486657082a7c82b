"""Connections of a path's vertex to the lasers, and the deposits they make.

Laser sampling connects every vertex to every laser of the lane (Royo et al. 2022, section 4). A laser with a spot may
also be found by chance: the two ways are weighted by the balance heuristic (Veach 1997).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FIRST_BOUNCE
from nlosrender.engine.launch.device_arrays import WallPoints
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaunchParams, PathSettings
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

LEAST_COSINE = 1e-2  # between a ray and a surface's normal
# Ray offset along the normal, over 1 + the largest coordinate [engine units]. A ray from the wall to a point this far
# before a triangle meets that triangle in 0 of 2e6 tries at 4e-7, in 1e-3 at 2e-7 (float32, tilts of 0 to 88 degrees).
# Of a sphere of radius r < 1 the quadratic equation is good to 1 / r times that: 0 of 2e6 at r = 1, 0.3 and 0.01.
RAY_OFFSET = 5e-7
ROUGH_RAY_OFFSET = 2e-5  # shapes whose intersections are found numerically, see ``BuiltScene.has_exact_hits``
WALL_OFFSET = 1e-20  # engine units: points of a planar wall have z = 0 exactly, and rays leave it on the right side
HEIGHT_SHARE = 0.25  # of a surface's height over a planar wall: the ray offset never carries a ray beyond the wall


@dr.syntax
def connect_to_lasers(
    settings: PathSettings,
    params: LaunchParams,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    lane: mi.UInt32,
    si: mi.SurfaceInteraction3f,
    active: mi.Bool,
    bounce: mi.UInt32,
    opl: mi.Float,
    throughput: mi.Spectrum,
    origin: mi.Point3f,
    leg: mi.Vector3f,
    coherent: bool = False,
) -> None:
    """Laser sampling: connect the vertex to every laser of the lane and deposit (Royo et al. 2022, section 4).

    The vertex lies at ``origin`` plus ``leg``: closer to a laser point than float32 tells positions apart, only the leg
    says where it is. ``coherent``: neighbouring lanes are at neighbouring vertices, and trace their rays together.
    """
    slot = _slot(settings, bounce)
    # one place in the spot for all lasers: what a path draws must not depend on how many lasers a batch has
    in_spot = mi.Vector3f(0)
    if dr.hint(settings.finds_spot, mode="scalar"):
        in_spot = _on_disc(generator, active) * settings.spot_radius
    vertex = si, active, opl, throughput, origin, leg
    if dr.hint(params.lasers_per_lane == 1, mode="scalar"):
        _connect(settings, params, histogram, in_spot, lane, mi.UInt32(0), slot, *vertex, coherent)
    else:
        laser = mi.UInt32(0)
        while dr.hint(laser < params.n_lasers, exclude=[settings, params, histogram, vertex]):
            _connect(settings, params, histogram, in_spot, lane, laser, slot, *vertex, coherent)
            laser += 1


def _connect(
    settings: PathSettings,
    params: LaunchParams,
    histogram: DeviceHistogram,
    in_spot: mi.Vector3f,
    lane: mi.UInt32,
    laser: mi.UInt32,
    slot: mi.UInt32,
    si: mi.SurfaceInteraction3f,
    active: mi.Bool,
    opl: mi.Float,
    throughput: mi.Spectrum,
    origin: mi.Point3f,
    leg: mi.Vector3f,
    coherent: bool,
) -> None:
    built = params.built
    context = mi.BSDFContext()
    points = params.lasers.gather(params.first_laser + laser)
    lit = points.interaction
    if settings.finds_spot:
        lit.p = lit.p + lit.to_world(in_spot)
        # what a spot loses over the wall's edge lights nothing
        active = active & built.wall_shape.ray_test(mi.Ray3f(lit.p + 1e-2 * lit.n, -lit.n), active=active)
    to_laser = (lit.p - origin) - leg
    distance2 = dr.squared_norm(to_laser)
    distance = dr.sqrt(distance2)
    direction = to_laser / distance
    bsdf = si.bsdf()
    wo, towards = si.to_local(direction), lit.to_local(-direction)
    reflected, pdf = bsdf.eval_pdf(context, si, wo, active)
    reflected = si.to_world_mueller(reflected, -wo, si.wi)
    # light comes from the laser at wi and leaves along wo, which matters to polarised light alone
    from_laser = mi.BSDFContext(mi.TransportMode.Importance) if mi.is_polarized else context
    emitted = built.wall_bsdf.eval(from_laser, lit, towards, active)  # includes the laser point's cosine
    emitted = lit.to_world_mueller(emitted, -lit.wi, towards)
    value = throughput * reflected * emitted / distance2
    if settings.finds_spot:
        # balance heuristic against finding the same point of the spot by the next ray
        share = dr.select(si.shape == mi.ShapePtr(built.wall_shape), 1 - settings.p_hidden_sampling, 1.0)
        cosine = dr.maximum(dr.dot(lit.n, -direction), 0)
        value *= _balance(distance2, share * pdf * cosine * dr.pi * settings.spot_radius**2)
    active = active & dr.any(
        mi.unpolarized_spectrum(value) > 0
    )  # not in place: the caller's mask serves the other lasers, too
    if settings.needs_visibility:
        segment = connection_segment(built, si, direction, lit)
        active &= ~built.scene.ray_test(segment, coherent=coherent, active=active)
    bins = delay_bin(params, points, opl + distance)
    histogram.deposit(lane, laser, slot, bins, value, active)


@dr.syntax
def deposit_spot(
    settings: PathSettings,
    params: LaunchParams,
    histogram: DeviceHistogram,
    lane: mi.UInt32,
    si: mi.SurfaceInteraction3f,
    ray: mi.Ray3f,
    active: mi.Bool,
    is_delta: mi.Bool,
    bounce: mi.UInt32,
    opl: mi.Float,
    throughput: mi.Spectrum,
    value: mi.Spectrum,
    density: mi.Float,
    distance2: mi.Float,
) -> None:
    """A ray that met the relay wall inside the laser's spot carries the spot's radiance; once per laser of the lane."""
    context = mi.BSDFContext()
    slot = _slot(settings, bounce)
    spot_area = dr.pi * settings.spot_radius**2
    cosine = dr.maximum(-dr.dot(si.n, ray.d), 1e-9)
    laser = mi.UInt32(0)
    while dr.hint(laser < params.n_lasers, exclude=[settings, params, histogram]):
        points = params.lasers.gather(params.first_laser + laser)
        lit = points.interaction
        inside = active & (dr.squared_norm(si.p - lit.p) < settings.spot_radius**2)
        emitted = params.built.wall_bsdf.eval(context, lit, lit.to_local(-ray.d), inside) / (cosine * spot_area)
        carried = throughput * value * emitted / density
        if dr.hint(settings.laser_sampling, mode="scalar"):
            carried *= dr.select(is_delta, 1, _balance(density * cosine * spot_area, distance2))
        inside &= dr.any(carried > 0)
        histogram.deposit(lane, laser, slot, delay_bin(params, points, opl), carried, inside)
        laser += 1


def _slot(settings: PathSettings, bounce: mi.UInt32) -> mi.UInt32:
    """Return the histogram's slot of a bounce; the second bounce is computed elsewhere and has none."""
    bounces = settings.bounces
    if not bounces.split:
        return mi.UInt32(0)
    return dr.minimum(bounce - (FIRST_BOUNCE + 1), mi.UInt32(bounces.n_slots - 2))


def delay_bin(params: LaunchParams, points: WallPoints, opl: mi.Float) -> mi.Int32:
    """Return the bin of a path: its length in bins, plus what laser and sensor point add."""
    sensors = params.sensors
    delay = opl * params.bins_per_unit + (points.delay_fraction + sensors.delay_fraction)
    return mi.Int32(dr.floor(dr.minimum(delay, 1e9))) + points.delay_bins + sensors.delay_bins


def _balance(own: mi.Float, other: mi.Float) -> mi.Float:
    return own / dr.maximum(own + other, 1e-30)


def _on_disc(generator: mi.PCG32, active: mi.Bool) -> mi.Vector3f:
    square = mi.Point2f(generator.next_float32(active), generator.next_float32(active))
    point = mi.warp.square_to_uniform_disk_concentric(square)
    return mi.Vector3f(point.x, point.y, 0)


def offset_origin(built: BuiltScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Point3f:
    """Return where a ray that leaves a surface in ``direction`` starts: a little off the surface, on the ray's side.

    Points of a planar wall need no offset, and surfaces close to it one that stays before it: nothing is too near to
    the wall to be met, or to be lit.
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


def off_the_wall(built: BuiltScene, wall_point: mi.SurfaceInteraction3f) -> mi.Point3f:
    """Return where a ray starts that leaves a laser or sensor point on the lit side."""
    if built.wall.is_planar:
        offset = mi.Float(WALL_OFFSET)
    else:
        offset = ray_offset_at(built, wall_point.p, mi.ShapePtr(built.wall_shape))
    return wall_point.p + wall_point.n * offset


def leg_to_tangent_plane(
    built: BuiltScene, si: mi.SurfaceInteraction3f, origin: mi.Point3f, direction: mi.Vector3f
) -> mi.Vector3f:
    """Return the way from ``origin`` to the surface that a ray found which started at the ray offset from it.

    The offset shortens the way to a surface close by: 4e-5 m of a 2 m wall are 4 % of H 1 mm in front of it. Where
    the ray grazes the surface, or the surface is curved or lies within the offset, the point that was found has to do.
    """
    along = dr.dot(si.n, direction)
    found = si.p - origin
    way = dr.dot(si.n, found) / along
    trusted = (dr.abs(along) > LEAST_COSINE) & (way > 0) & si.is_valid()
    if not built.all_flat:  # otherwise there is no need to ask the surface that was found
        trusted &= si.shape.is_mesh()
    return dr.select(trusted, direction * way, found)


def connection_segment(
    built: BuiltScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, wall_point: mi.SurfaceInteraction3f
) -> mi.Ray3f:
    """Shadow ray from a point of the wall to a surface, from which the wall point lies in ``direction``.

    Both ends are moved off their surfaces along the normals by the ray offset, not along the ray: a surface in front
    of either end is met however oblique the ray, if the gap is wider than the offset.
    """
    # aimed at the offset end: a parallel ray would pass beside the point, behind the wall at oblique incidence
    start, end = off_the_wall(built, wall_point), offset_origin(built, si, direction)
    distance = dr.norm(end - start)
    return mi.Ray3f(start, (end - start) / distance, distance, mi.Float(0), [])
