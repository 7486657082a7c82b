"""Mirror connections: vertices connected to the laser points by one reflection in a flat or round mirror."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.flat_mirrors import FlatMirrors, has_flat_mirrors
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.mirror_index import LitSphere
from nlosrender.engine.launch.ray_offsets import off_the_wall
from nlosrender.engine.launch.round_mirrors import RoundMirrors
from nlosrender.scene.build import BuiltScene

Mirrors = FlatMirrors | RoundMirrors


@dataclass(frozen=True, eq=False)
class MirroredVertex:
    """Vertices to be connected, one per lane, and by way of which mirrors."""

    si: mi.SurfaceInteraction3f
    throughput: mi.Spectrum  # of the path up to it
    opl: mi.Float  # of the path up to it [engine units]
    slot: mi.UInt32  # bounce slot of the deposits
    begin: mi.UInt32  # in the mirrors' index: what is near the vertex begins here
    length: mi.UInt32  # and so many mirrors are
    first: mi.UInt32  # of these, the first that is tried
    count: mi.UInt32  # that are tried; after the last one follows number 0
    in_spot: mi.Vector3f | None  # from the laser point to the point of its spot, in the wall's frame; None: no spot


def mirrors_of(built: BuiltScene, lasers: LitSphere | None = None) -> tuple[Mirrors, ...]:
    """Return the flat and the round mirrors of a scene, if there are any, indexed for light of ``lasers``."""
    flat = FlatMirrors.of(built, lasers) if any(map(has_flat_mirrors, built.scene.shapes())) else None
    return tuple(mirrors for mirrors in (flat, RoundMirrors.of(built)) if mirrors is not None)


def deposit_mirrored_bounce(params: LaunchParams, mirrors: Mirrors, histogram: DeviceHistogram) -> None:
    """Deposit the third bounce by one mirror reflection, for every lane and each of its lasers; exact.

    Parameters as of ``deposit_second_bounce``.
    """
    sensor, zero, yes = params.sensors.interaction, mi.UInt32(0), mi.Bool(True)
    begin, count = mirrors.index.near(sensor.p, yes)
    vertex = MirroredVertex(sensor, mi.Spectrum(1), mi.Float(0), zero, begin, count, zero, count, None)
    deposit_reflections(params, mirrors, histogram, vertex, yes)


@dr.syntax
def deposit_reflections(
    params: LaunchParams, mirrors: Mirrors, histogram: DeviceHistogram, vertex: MirroredVertex, active: mi.Bool
) -> None:
    """Deposit what mirrors reflect to vertices from every laser of their lanes."""
    laser = mi.UInt32(0)
    while dr.hint(laser < params.n_lasers, exclude=[params, mirrors, histogram, vertex, active]):
        place, tried = _lit(params, vertex, laser).p, mi.UInt32(0)
        while dr.hint(
            active & (tried < vertex.count),
            exclude=[params, mirrors, histogram, vertex, active, laser, place],
        ):
            entry = vertex.first + tried
            entry = vertex.begin + dr.select(entry < vertex.length, entry, entry - vertex.length)
            number = mirrors.index.mirror(entry, active)
            is_near = active & mirrors.may_reflect(number, vertex.si.p, place)
            _connect(params, mirrors, histogram, vertex, laser, number, is_near)
            tried += 1
        laser += 1


@dr.syntax
def _connect(
    params: LaunchParams,
    mirrors: Mirrors,
    histogram: DeviceHistogram,
    vertex: MirroredVertex,
    laser: mi.UInt32,
    number: mi.UInt32,
    active: mi.Bool,
) -> None:
    """Connect vertices by way of one mirror; packets with no active lane skip the rays."""
    if dr.hint(active, exclude=[params, mirrors, histogram, vertex, laser, number]):
        built, si, lit = params.built, vertex.si, _lit(params, vertex, laser)
        seen = mi.Bool(active)
        if dr.hint(vertex.in_spot is not None, mode="scalar"):
            # the part of a spot beyond the wall's edge lights nothing
            seen &= built.wall_shape.ray_test(mi.Ray3f(lit.p + 1e-2 * lit.n, -lit.n), active=seen)
        found = mirrors.reflected(built, number, si, lit.p, off_the_wall(built, lit), seen)
        context = mi.BSDFContext()
        scattered = si.bsdf().eval(context, si, si.to_local(found.direction), found.active)
        scattered *= built.bsdf_at(lit).eval(context, lit, lit.to_local(found.from_lit), found.active)
        points = params.lasers.gather(params.first_laser + laser)
        bins = params.delay_bin(points, vertex.opl + found.distance)
        value = points.shared(vertex.throughput * scattered * found.value)
        histogram.deposit(params.row_of_lane, laser, vertex.slot, bins, value, found.active)


def _lit(params: LaunchParams, vertex: MirroredVertex, laser: mi.UInt32) -> mi.SurfaceInteraction3f:
    """Return the point that is connected to: a laser point, or the same point of every laser's spot."""
    lit = params.lasers.gather(params.first_laser + laser).interaction
    if vertex.in_spot is not None:
        lit.p = lit.p + lit.to_world(vertex.in_spot)
    return lit
