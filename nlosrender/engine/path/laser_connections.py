"""Laser sampling: connections of path vertices to the laser points, and deposits (Royo et al. 2022, section 4).

BSDF sampling may also find the laser's spot, if it has one; the balance heuristic weights the two (Veach 1997, 9.2.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.mirror_connections import MirroredVertex, deposit_reflections
from nlosrender.engine.launch.ray_offsets import connection_segment

if TYPE_CHECKING:
    from nlosrender.engine.launch.histogram import DeviceHistogram
    from nlosrender.engine.path.settings import PathParams, PathSettings
    from nlosrender.engine.path.vertex_steps import Arrival, Departure


@dataclass(frozen=True, eq=False)
class PathVertex:
    """A vertex of a path to be connected.

    It lies at ``origin`` plus ``leg``, whose float32 precision is kept even close to a laser point.
    """

    si: mi.SurfaceInteraction3f
    origin: mi.Point3f  # of the ray that found it
    leg: mi.Vector3f
    opl: mi.Float  # of the path up to it [engine units]
    throughput: mi.Spectrum  # of the path up to it
    bounce: mi.UInt32  # bounce index of its connections


@dr.syntax
def connect_to_lasers(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    vertex: PathVertex,
    active: mi.Bool,
    coherent: bool = False,
) -> None:
    """Laser sampling: connect a vertex to every laser of the lane and deposit (Royo et al. 2022, section 4).

    ``coherent``: neighbouring lanes are at neighbouring vertices, and trace their rays together.
    """
    # the same point of the spot for all lasers: random numbers must not depend on the lasers of a batch
    in_spot = mi.Vector3f(0)
    if dr.hint(settings.finds_spot, mode="scalar"):
        in_spot = _on_disk(generator, active) * settings.spot_radius
    if dr.hint(settings.flashes, mode="scalar"):
        in_spot = mi.Vector3f(generator.next_float32(active), generator.next_float32(active), 0)
    if dr.hint(params.lasers_per_lane == 1, mode="scalar"):
        _connect(settings, params, histogram, in_spot, mi.UInt32(0), vertex, active, coherent)
    else:
        laser = mi.UInt32(0)
        while dr.hint(laser < params.n_lasers, exclude=[settings, params, histogram, vertex, active]):
            _connect(settings, params, histogram, in_spot, laser, vertex, active, coherent)
            laser += 1


def connect_by_mirrors(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    vertex: PathVertex,
    active: mi.Bool,
    in_spot: mi.Vector3f | None = None,
) -> None:
    """Connect a vertex to every laser of the lane by way of mirrors and deposit, one bounce later than directly.

    By way of ``mirrors_per_vertex`` of either kind near the vertex, from a random one on, with the weight that makes up
    for the others; of all of them where the point of the spot is given. docs/virtual-lights.md, 11.2.
    """
    if not params.mirrors:
        return
    bounce, takes_all = vertex.bounce + 1, in_spot is not None
    active = active & settings.is_deposited(bounce)
    if settings.finds_spot and in_spot is None:
        in_spot = _on_disk(generator, active) * settings.spot_radius
    for mirrors in params.mirrors:
        begin, near = mirrors.index.near(vertex.si.p, active)
        count = near if takes_all else dr.minimum(near, params.mirrors_per_vertex)
        first = mi.UInt32(generator.next_float32(active & (count < near)) * mi.Float(near))
        first = dr.select(count < near, dr.minimum(first, near - 1), 0)
        throughput = vertex.throughput * (mi.Float(near) / mi.Float(dr.maximum(count, 1)))
        slot = settings.slot(bounce)
        start = MirroredVertex(vertex.si, throughput, vertex.opl, slot, begin, near, first, count, in_spot)
        deposit_reflections(params, mirrors, histogram, start, active & (near > 0))


def _connect(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    in_spot: mi.Vector3f,
    laser: mi.UInt32,
    vertex: PathVertex,
    active: mi.Bool,
    coherent: bool,
) -> None:
    built, si, context = params.built, vertex.si, mi.BSDFContext()
    points = params.lasers.gather(params.first_laser + laser)
    if params.flash is not None:
        points, is_met = params.flash.placed(points, mi.Point2f(in_spot.x, in_spot.y))
        active = active & is_met
    lit = points.interaction
    if settings.finds_spot:
        lit.p = lit.p + lit.to_world(in_spot)
        # the part of a spot beyond the wall's edge lights nothing
        active = active & built.wall_shape.ray_test(mi.Ray3f(lit.p + 1e-2 * lit.n, -lit.n), active=active)
    to_laser = (lit.p - vertex.origin) - vertex.leg
    distance2 = dr.squared_norm(to_laser)
    distance = dr.sqrt(distance2)
    direction = to_laser / distance
    wo, towards = si.to_local(direction), lit.to_local(-direction)
    reflected, pdf = si.bsdf().eval_pdf(context, si, wo, active)
    reflected = si.to_world_mueller(reflected, -wo, si.wi)
    # light comes from the laser at wi and leaves along wo, which matters to polarised light alone
    from_laser = mi.BSDFContext(mi.TransportMode.Importance) if mi.is_polarized else context
    emitted = built.bsdf_at(lit).eval(from_laser, lit, towards, active)  # includes the laser point's cosine
    emitted = lit.to_world_mueller(emitted, -lit.wi, towards)
    value = points.shared(vertex.throughput * reflected * emitted / distance2)
    if settings.finds_spot:
        # balance heuristic against finding the same point of the spot by the next ray
        share = dr.select(si.shape == mi.ShapePtr(built.wall_shape), 1 - settings.p_hidden_sampling, 1.0)
        cosine = dr.maximum(dr.dot(lit.n, -direction), 0)
        value *= _balance_heuristic(distance2, share * pdf * cosine * dr.pi * settings.spot_radius**2)
    # not in place: the caller's mask is used for the other lasers
    active = active & dr.any(mi.unpolarized_spectrum(value) > 0)
    if settings.needs_visibility:
        segment = connection_segment(built, si, direction, lit)
        active &= ~built.scene.ray_test(segment, coherent=coherent, active=active)
    bins = params.delay_bin(points, vertex.opl + distance)
    histogram.deposit(params.row_of_lane, laser, settings.slot(vertex.bounce), bins, value, active)


@dr.syntax
def deposit_spot(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    there: Arrival,
    way: Departure,
    bounce: mi.UInt32,
    opl: mi.Float,
    throughput: mi.Spectrum,
) -> None:
    """Deposit the radiance of the laser's spot on rays that met the relay wall inside it; once per laser of the lane.

    ``opl`` is the path's length up to the wall, ``throughput`` and ``bounce`` those of the vertex before. What
    ``connect_by_mirrors`` finds is left out.
    """
    context, slot, si = mi.BSDFContext(), settings.slot(bounce), there.si
    spot_area = dr.pi * settings.spot_radius**2
    cosine = dr.maximum(-dr.dot(si.n, way.ray.d), 1e-9)
    on_wall = there.is_reached & there.on_wall & ~way.is_imaged
    laser = mi.UInt32(0)
    while dr.hint(laser < params.n_lasers, exclude=[settings, params, histogram, there, way, si]):
        points = params.lasers.gather(params.first_laser + laser)
        lit = points.interaction
        inside = on_wall & (dr.squared_norm(si.p - lit.p) < settings.spot_radius**2)
        emitted = params.built.wall_bsdf.eval(context, lit, lit.to_local(-way.ray.d), inside) / (cosine * spot_area)
        carried = throughput * way.value * emitted / there.density
        if dr.hint(settings.laser_sampling, mode="scalar"):
            weight = _balance_heuristic(there.density * cosine * spot_area, there.distance2)
            carried *= dr.select(way.is_delta, 1, weight)
        inside &= dr.any(carried > 0)
        histogram.deposit(params.row_of_lane, laser, slot, params.delay_bin(points, opl), carried, inside)
        laser += 1


def _balance_heuristic(own: mi.Float, other: mi.Float) -> mi.Float:
    return own / dr.maximum(own + other, 1e-30)


def _on_disk(generator: mi.PCG32, active: mi.Bool) -> mi.Vector3f:
    return disk_point(mi.Point2f(generator.next_float32(active), generator.next_float32(active)))


def disk_point(square: mi.Point2f) -> mi.Vector3f:
    """Return points of the unit disk in z = 0, uniform by area where the numbers are in the unit square."""
    point = mi.warp.square_to_uniform_disk_concentric(square)
    return mi.Vector3f(point.x, point.y, 0)
