"""Vertex steps of a path: leave a vertex in a sampled direction, arrive at the next vertex.

Directions are sampled from the BSDF or, on the relay wall, towards a point sampled on the hidden geometry. The density
is that of the mixture at the vertex that the ray reached (one-sample MIS, balance heuristic, Veach 1997, 9.2.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.launch_params import MAX_SURVIVAL
from nlosrender.engine.launch.ray_offsets import leg_to_tangent_plane, offset_origin

if TYPE_CHECKING:
    from nlosrender.engine.launch.surface_sampler import SurfaceSample
    from nlosrender.engine.path.settings import PathParams, PathSettings
    from nlosrender.scene.build import BuiltScene


@dataclass(eq=False)
class Departure:
    """A ray from a vertex with its BSDF value and densities; not frozen: state of a loop."""

    ray: mi.Ray3f
    origin: mi.Point3f  # the vertex it left, without ray offset
    # BSDF times cosine of the direction, not divided by its density (delta lobes: weight of the sample); divided by the
    # survival probability once Russian roulette has been survived
    value: mi.Spectrum
    bsdf_density: mi.Float  # share of BSDF sampling in the direction's density [1/sr]; 1 for delta lobes
    hidden_density: mi.Float  # share of hidden geometry sampling, before the Jacobian [1/area]
    is_delta: mi.Bool  # the direction comes from a delta lobe
    is_imaged: mi.Bool  # a mirror reflected a scattered ray: mirror connections sample such paths to the spot
    has_target: mi.Bool  # it was sent to a sampled point of the hidden geometry: the next three
    target: mi.Point3f
    target_shape: mi.ShapePtr
    target_primitive: mi.UInt32

    @classmethod
    def none(cls, built: BuiltScene) -> Departure:
        """Return the state before the first path."""
        ray, origin, shape = dr.zeros(mi.Ray3f), mi.Point3f(0), dr.zeros(mi.ShapePtr)
        zero, no = mi.Float(0), mi.Bool(False)
        return cls(ray, origin, mi.Spectrum(0), zero, zero, no, no, no, mi.Point3f(0), shape, mi.UInt32(0))


@dataclass(frozen=True, eq=False)
class Arrival:
    """The vertex that a ray reached."""

    si: mi.SurfaceInteraction3f
    is_reached: mi.Bool  # a surface, and that of the sampled point if the ray was sent to one
    on_wall: mi.Bool
    leg: mi.Vector3f  # from the vertex before; finer than the difference of positions
    distance: mi.Float
    distance2: mi.Float
    density: mi.Float  # of the direction, in solid angle


@dataclass(frozen=True, eq=False)
class DirectionNumbers:
    """Random numbers of a direction: 32-bit integers for the first coordinate, [0, 1) for the second."""

    bits_u: mi.UInt32
    v: mi.Float

    @classmethod
    def drawn(cls, generator: mi.PCG32, active: mi.Bool) -> DirectionNumbers:
        """Draw them on the active lanes only: on the others, draws would depend on how launches are cut."""
        return cls(generator.next_uint32(active), unit_interval(generator.next_uint32(active)))


def unit_interval(bits: mi.UInt32) -> mi.Float:
    """Return numbers in [0, 1), exact in float32."""
    return mi.Float(bits >> 8) * 2.0**-24


def intersect(settings: PathSettings, built: BuiltScene, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
    """Return the nearest hit. Plain diffuse surfaces take any shading frame around the normal, which is faster."""
    if not settings.is_plain_diffuse:
        return built.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
    si = built.scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=active)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.to_local(-ray.d)
    return si


def arrive(settings: PathSettings, params: PathParams, way: Departure, active: mi.Bool) -> Arrival:
    """Trace a ray to the next vertex and return it with the density of the direction."""
    built, sampler, q = params.built, params.sampler, settings.p_hidden_sampling
    si = intersect(settings, built, way.ray, active)
    is_reached = active & si.is_valid()
    leg = dr.select(way.has_target, si.p - way.origin, leg_to_tangent_plane(built, si, way.origin, way.ray.d))
    si.p = way.origin + leg
    distance2 = dr.squared_norm(leg)
    distance = dr.sqrt(distance2)
    if q > 0:
        # occluded: the ray met something in front of the sampled point
        is_reached &= ~way.has_target | sampler.reached(si, way.target, way.target_shape, way.target_primitive)
    on_wall = built.is_wall(si.shape)
    if built.wall.is_planar:
        si.p.z = dr.select(on_wall, 0, si.p.z)  # exactly: rays that leave the wall there need no offset
    density = mi.Float(way.bsdf_density)
    if q > 0:
        # by the leg, not the ray: the ray's offset origin matters for hidden geometry close to the wall
        cosine = dr.abs(dr.dot(si.n, leg)) / distance
        jacobian = dr.select(sampler.covers(si, on_wall), distance2 / dr.maximum(cosine, 1e-9), 0)
        density += way.hidden_density * jacobian
    return Arrival(si, is_reached, on_wall, leg, distance, distance2, density)


def leave(
    settings: PathSettings,
    params: PathParams,
    generator: mi.PCG32,
    vertex: mi.SurfaceInteraction3f,
    on_wall: mi.Bool,
    numbers: DirectionNumbers,
    sample: SurfaceSample | None,
    by_bsdf: mi.Bool,
    has_target: mi.Bool,
    is_specular: mi.Bool,
) -> tuple[Departure, mi.Float, mi.Float]:
    """Sample the direction in which a path leaves a vertex.

    Parameters
    ----------
    vertex, on_wall
        The vertex, and whether it lies on the relay wall.
    numbers, generator
        Choose the direction, and the lobe of the BSDF.
    sample
        Points of the hidden geometry for the lanes ``has_target``; None where the technique is not used.
    by_bsdf, has_target
        Which of the two techniques a lane uses; lanes of neither have ended.
    is_specular
        Whether a delta lobe is on the path, where paths without one are not deposited.

    Returns
    -------
    tuple
        The departure; the survival probability of the roulette, which is the albedo, 1 towards a target; the factor of
        the refractive index along the ray.
    """
    built, q = params.built, settings.p_hidden_sampling
    context = mi.BSDFContext()
    way = Departure.none(built)
    wo, survival, eta = mi.Vector3f(0, 0, 1), mi.Float(1), mi.Float(1)
    if q < 1 or settings.goes_on:
        lobe = generator.next_float32(by_bsdf)
        square = mi.Point2f(unit_interval(numbers.bits_u), numbers.v)
        bs, weight = _bsdf_sample(settings, vertex, lobe, square, by_bsdf, ~on_wall & ~is_specular)
        wo = bs.wo
        weight = vertex.to_world_mueller(weight, -wo, vertex.wi)
        way.is_delta = by_bsdf & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        share = dr.select(on_wall, 1 - q, 1.0)
        way.bsdf_density = dr.select(way.is_delta, share, share * bs.pdf)
        way.value = dr.select(way.is_delta, weight, weight * bs.pdf)
        survival = dr.select(by_bsdf, dr.minimum(dr.max(mi.unpolarized_spectrum(weight)), MAX_SURVIVAL), 1)
        if settings.has_transmission:
            eta = dr.select(by_bsdf & (bs.eta > 0), bs.eta, 1)
    if sample is not None:
        way.has_target = mi.Bool(has_target)
        way.target, way.target_shape, way.target_primitive = sample.p, sample.shape, sample.primitive
        to_target = sample.p - vertex.p
        local = vertex.to_local(to_target * dr.rsqrt(dr.squared_norm(to_target)))
        f, pdf = built.bsdf_at(vertex).eval_pdf(context, vertex, local, has_target)
        f = vertex.to_world_mueller(f, -local, vertex.wi)
        wo = dr.select(has_target, local, wo)
        way.value = dr.select(has_target, f, way.value)
        way.bsdf_density = dr.select(has_target, (1 - q) * pdf, way.bsdf_density)
        way.hidden_density = dr.select(on_wall & ~way.is_delta, q / params.sampler.area, 0)
    world = vertex.to_world(wo)
    way.origin = mi.Point3f(vertex.p)
    ray_origin = offset_origin(built, vertex, world)
    if sample is not None:
        # from the offset origin: a parallel ray would land beside the target, in another triangle of a fine mesh
        world = dr.select(has_target, dr.normalize(sample.p - ray_origin), world)
    way.ray = mi.Ray3f(ray_origin, world)
    return way, survival, eta


def _bsdf_sample(
    settings: PathSettings,
    vertex: mi.SurfaceInteraction3f,
    lobe: mi.Float,
    square: mi.Point2f,
    active: mi.Bool,
    needs_delta: mi.Bool,
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
    """Sample the BSDF; lanes that ``needs_delta`` take its delta lobes with probability ``delta_share``.

    By itself a smooth coat is sampled in one of twelve cases (plastic of albedo 0.5).
    """
    bsdf, context, share = vertex.bsdf(), mi.BSDFContext(), settings.delta_share
    if not share:
        return bsdf.sample(context, vertex, lobe, square, active)
    flags = bsdf.flags()
    chooses = active & needs_delta & mi.has_flag(flags, mi.BSDFFlags.Delta) & mi.has_flag(flags, mi.BSDFFlags.Smooth)
    takes = chooses & (lobe < share)
    own_lobe = dr.select(chooses, (lobe - share) / (1 - share), lobe)
    bs, weight = bsdf.sample(context, vertex, own_lobe, square, active & ~takes)
    drops = chooses & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    weight = dr.select(drops, 0, weight / dr.select(chooses, 1 - share, 1))
    context.type_mask = int(mi.BSDFFlags.Delta)
    delta, of_delta = bsdf.sample(context, vertex, lobe / share, square, takes)
    return dr.select(takes, delta, bs), dr.select(takes, of_delta / share, weight)


def is_imaged(
    params: PathParams, vertex: mi.SurfaceInteraction3f, before: Departure, way: Departure, active: mi.Bool
) -> mi.Bool:
    """Return whether a vertex is a mirror that reflects a scattered ray: ``before`` the ray to it, ``way`` on."""
    is_reflected = mi.Frame3f.cos_theta(vertex.wi) * dr.dot(vertex.sh_frame.n, way.ray.d) > 0
    is_first = active & way.is_delta & ~before.is_delta & is_reflected
    found = mi.Bool(False)
    for mirrors in params.mirrors:
        found |= mirrors.is_met(vertex, is_first)
    return is_first & found


def turns_away(params: PathParams, sample: SurfaceSample, origin: mi.Point3f) -> mi.Bool:
    """Return whether a sampled point faces away from ``origin`` with a black side: the path ends without a ray."""
    if not params.sampler.dark_behind:
        return mi.Bool(False)
    return dr.dot(sample.n, sample.p - origin) >= 0


def misses_hidden(params: PathParams, ray: mi.Ray3f) -> mi.Bool:
    """Return whether a ray from a planar wall misses the box of the hidden geometry: the path ends without a ray."""
    if params.hidden_aabb is None:
        return mi.Bool(False)
    return params.hidden_aabb.is_missed(ray)
