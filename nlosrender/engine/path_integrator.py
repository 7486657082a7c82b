"""The transient path tracer: a Mitsuba integrator plugin whose one loop is the whole of Royo et al. 2022, section 4.

Paths start at sensor points. A lane belongs to one sensor point; when its path ends it starts the next one in
the same iteration, so lanes stay busy whatever the path lengths. At every vertex the path is connected to the
laser points (laser sampling) and goes on in a direction from the BSDF or, on the relay wall, towards a point
sampled on the hidden geometry (hidden geometry sampling). The two are combined as one mixture density
(one-sample MIS with the balance heuristic, Veach 1997), with the density of the vertex that the ray really
reached; a sampled point that turns out to be occluded contributes nothing.
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import FIRST_BOUNCE, BounceAxis
from nlosrender.engine.connections import connect_to_lasers, deposit_spot, leg_to_tangent_plane, offset_origin
from nlosrender.engine.deadline import thinned_out
from nlosrender.engine.direct_paths import are_direct, trace_direct_paths
from nlosrender.engine.histogram import DeviceHistogram
from nlosrender.engine.low_discrepancy import recurrence_steps
from nlosrender.engine.strata import Strata, first_coordinate
from nlosrender.engine.transport import HIGHEST_SURVIVAL, LaneRandomness, PathSettings, Transport

PLUGIN_NAME = "nlos_path"


@dr.syntax
def trace_paths(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    strata: Strata,
    n_samples: mi.UInt32,
) -> tuple[LaneRandomness, Strata]:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; return the advanced random state.

    Throughput is in units of radiance per (engine unit)^-2; the caller scales by energy and unit.
    """
    built, sampler, sensors = transport.built, transport.sampler, transport.sensors
    scene, wall_bsdf = built.scene, built.wall_bsdf
    wall = mi.ShapePtr(built.wall_shape)
    context = mi.BSDFContext()
    lane = dr.arange(mi.UInt32, dr.width(sensors.delay_bins))
    q = settings.hidden_fraction  # probability of hidden geometry sampling at a wall vertex
    steps = recurrence_steps(2) if 0 < q < 1 else (*recurrence_steps(1), 1)  # the second chooses the technique
    stride = strata.stride
    max_bounces, last_vertex = settings.bounces.max_bounces, settings.last_vertex
    deadline = transport.deadline if settings.thins_out else None

    # ---- State -------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    at = mi.UInt64(strata.at)
    seq_v, seq_t = (mi.UInt32(start) for start in randomness.sequence[1:])
    started = mi.UInt32(0)  # paths begun by this lane
    alive = mi.Bool(False)  # a ray is under way
    ray = dr.zeros(mi.Ray3f)
    bounce = mi.UInt32(FIRST_BOUNCE)  # bounce index that a laser connection at the last vertex has
    throughput = mi.Spectrum(0)  # of the path up to the last vertex
    value = mi.Spectrum(0)  # BSDF times cosine of the direction under way, undivided by its density
    bsdf_density = mi.Float(0)  # share of BSDF sampling in that direction's density [1/sr]; 1 for delta lobes
    hidden_density = mi.Float(0)  # share of hidden geometry sampling, before the Jacobian [1/area]
    is_delta = mi.Bool(False)  # the direction comes from a delta lobe
    opl = mi.Float(0)  # optical path length from the sensor point [engine units]
    medium = mi.Float(1)  # refractive index along the ray
    origin = mi.Point3f(0)  # last vertex, without ray offset
    target = mi.Point3f(0)  # the hidden point the ray was sent to
    target_shape = mi.ShapePtr(built.wall_shape)
    target_primitive = mi.UInt32(0)
    has_target = mi.Bool(False)
    is_thinned = mi.Bool(False)  # the path can only bring light after the window, and has survived that roulette

    # what a launch reads is no state of the loop
    while dr.hint(
        alive | (started < n_samples), exclude=[settings, transport, histogram, built, sampler, sensors, deadline]
    ):
        # ---- Intersect -----------------------------------------------------------------------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=alive)
        hit = alive & si.is_valid()
        leg = dr.select(has_target, si.p - origin, leg_to_tangent_plane(built, si, origin, ray.d))
        si.p = origin + leg
        distance2 = dr.squared_norm(leg)
        distance = dr.sqrt(distance2)
        if dr.hint(q > 0, mode="scalar"):
            # occluded: the ray met something in front of the sampled point
            hit &= ~has_target | sampler.reached(si, target, target_shape, target_primitive)
        on_wall = si.shape == wall
        if dr.hint(built.wall.is_planar, mode="scalar"):
            si.p.z = dr.select(on_wall, 0, si.p.z)  # exactly: rays that leave the wall there need no offset
        density = mi.Float(bsdf_density)
        if dr.hint(q > 0, mode="scalar"):
            # not along the ray: its offset origin matters where hidden geometry comes close to the wall
            cosine = dr.abs(dr.dot(si.n, leg)) / distance
            jacobian = dr.select(sampler.covers(si, wall), distance2 / dr.maximum(cosine, 1e-9), 0)
            density += hidden_density * jacobian
        opl += medium * distance

        # ---- Laser spot found by chance --------------------------------------------------------------------------
        if dr.hint(settings.finds_spot, mode="scalar"):
            deposit_spot(
                settings,
                transport,
                histogram,
                lane,
                si,
                ray,
                hit & on_wall,
                is_delta,
                bounce,
                opl,
                throughput,
                value,
                density,
                distance2,
            )

        throughput = dr.select(hit, throughput * value / density, 0)
        bounce += 1
        hit &= dr.any(mi.unpolarized_spectrum(throughput) != 0)

        # ---- Thin out what comes after the window, once a path ---------------------------------------------------
        hit, is_thinned, throughput = thinned_out(deadline, generator, hit, is_thinned, opl, si.p, on_wall, throughput)

        # ---- Connect to the lasers and deposit ---------------------------------------------------------------------
        if dr.hint(settings.laser_sampling, mode="scalar"):
            in_reach = mi.Bool(hit)
            if dr.hint(settings.first_bounce > FIRST_BOUNCE + 1, mode="scalar"):
                in_reach &= bounce >= settings.first_bounce
            if dr.hint(settings.goes_on and max_bounces is not None, mode="scalar"):
                in_reach &= bounce <= max_bounces
            connect_to_lasers(
                settings, transport, histogram, generator, lane, si, in_reach, bounce, opl, throughput, origin, leg
            )

        # ---- Continue, or start the next path ----------------------------------------------------------------------
        go_on = mi.Bool(hit)
        if dr.hint(not settings.goes_on, mode="scalar"):
            go_on = mi.Bool(False)
        elif dr.hint(last_vertex is not None, mode="scalar"):
            go_on &= bounce < last_vertex
        start = ~go_on & (started < n_samples)
        started = dr.select(start, started + 1, started)
        alive = go_on | start
        if dr.hint(settings.goes_on, mode="scalar"):
            vertex = dr.select(start, sensors.interaction, si)
            throughput = dr.select(start, _at_sensor(sensors.interaction), throughput)
            opl = dr.select(start, 0, opl)
            bounce = dr.select(start, mi.UInt32(FIRST_BOUNCE), bounce)
            medium = dr.select(start, 1, medium)
            is_thinned &= ~start
        else:
            vertex = sensors.interaction
            throughput = _at_sensor(sensors.interaction)
            opl, bounce, medium = mi.Float(0), mi.UInt32(FIRST_BOUNCE), mi.Float(1)
        on_wall = vertex.shape == wall

        # ---- Sample the next direction -----------------------------------------------------------------------------
        bits_u, bits_v, bits_t = first_coordinate(at), mi.UInt32(seq_v), mi.UInt32(seq_t)
        if dr.hint(settings.goes_on, mode="scalar"):
            # A lane draws only what its path uses: numbers drawn while it idles would depend on how launches are cut.
            bits_u = dr.select(start, bits_u, generator.next_uint32(go_on))
            bits_v = dr.select(start, seq_v, generator.next_uint32(go_on))
            bits_t = dr.select(start, seq_t, generator.next_uint32(go_on))
        at = dr.select(start, at + stride, at)
        seq_v = dr.select(start, seq_v + steps[0], seq_v)
        seq_t = dr.select(start, seq_t + steps[1], seq_t)
        u, v, t = _unit_interval(bits_u), _unit_interval(bits_v), _unit_interval(bits_t)
        has_target = alive & on_wall & (t < q)
        by_bsdf = alive & ~has_target
        wo = mi.Vector3f(0, 0, 1)
        value = mi.Spectrum(0)
        bsdf_density = mi.Float(0)
        is_delta = mi.Bool(False)
        survival = mi.Float(1)
        if dr.hint(q < 1 or settings.goes_on, mode="scalar"):
            bsdf = vertex.bsdf()
            lobe = generator.next_float32(by_bsdf)
            bs, weight = bsdf.sample(context, vertex, lobe, mi.Point2f(u, v), by_bsdf)
            wo = bs.wo
            weight = vertex.to_world_mueller(weight, -wo, vertex.wi)
            is_delta = by_bsdf & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            share = dr.select(on_wall, 1 - q, 1.0)
            bsdf_density = dr.select(is_delta, share, share * bs.pdf)
            value = dr.select(is_delta, weight, weight * bs.pdf)
            survival = dr.select(by_bsdf, dr.minimum(dr.max(mi.unpolarized_spectrum(weight)), HIGHEST_SURVIVAL), 1)
            if dr.hint(settings.has_transmission, mode="scalar"):
                medium = dr.select(by_bsdf & (bs.eta > 0), medium * bs.eta, medium)
        if dr.hint(q > 0, mode="scalar"):
            sample = sampler.sample(bits_u, v, has_target)
            target, target_shape, target_primitive = sample.p, sample.shape, sample.primitive
            if dr.hint(q == 1 and sampler.dark_behind, mode="scalar"):
                # A point that shows its dark side ends the path here, without a ray; the next path starts at once.
                dark = start & (dr.dot(sample.n, target - vertex.p) >= 0)
                while dr.hint(dark & (started < n_samples), exclude=[sampler, sensors, vertex]):
                    started += 1
                    again = sampler.sample(first_coordinate(at), _unit_interval(seq_v), dark)
                    at += stride
                    seq_v += steps[0]
                    target, target_shape, target_primitive = again.p, again.shape, again.primitive
                    dark = dr.dot(again.n, target - vertex.p) >= 0
                alive &= ~dark
                has_target &= ~dark
            to_target = target - vertex.p
            direction = to_target * dr.rsqrt(dr.squared_norm(to_target))
            local = vertex.to_local(direction)
            f, pdf = wall_bsdf.eval_pdf(context, vertex, local, has_target)
            f = vertex.to_world_mueller(f, -local, vertex.wi)
            wo = dr.select(has_target, local, wo)
            value = dr.select(has_target, f, value)
            bsdf_density = dr.select(has_target, (1 - q) * pdf, bsdf_density)
            hidden_density = dr.select(on_wall & ~is_delta, q / sampler.area, 0)
        if dr.hint(settings.goes_on and settings.russian_roulette, mode="scalar"):
            # after the connections of this vertex, by the albedo just met; never before it could deposit
            survival = dr.select(start | (bounce < settings.first_bounce), 1, survival)
            alive &= generator.next_float32(alive & ~start) < survival
            value /= dr.maximum(survival, 1e-9)
        alive &= dr.any(mi.unpolarized_spectrum(value) != 0)
        world = vertex.to_world(wo)
        origin = mi.Point3f(vertex.p)
        ray_origin = offset_origin(built, vertex, world)
        if dr.hint(q > 0, mode="scalar"):
            # from the offset origin: a parallel ray would land beside the target, in another triangle of a fine mesh
            world = dr.select(has_target, dr.normalize(target - ray_origin), world)
        ray = mi.Ray3f(ray_origin, world)

    return LaneRandomness(generator, [randomness.sequence[0], seq_v, seq_t]), Strata(at, stride)


def _at_sensor(point: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return the throughput paths start with: polarised, the turn from the implicit Stokes frame to the sensor's.

    The reference direction is the sensor's horizontal: across the ray from the sensor and the wall's y axis.
    """
    if not mi.is_polarized:
        return mi.Spectrum(1)
    out = point.to_world(point.wi)
    horizontal = dr.normalize(dr.cross(-out, mi.Vector3f(0, 1, 0)))
    return mi.Spectrum(mi.mueller.rotate_stokes_basis_m(out, mi.mueller.stokes_basis(out), horizontal))


def _unit_interval(bits: mi.UInt32) -> mi.Float:
    return mi.Float(bits >> 8) * 2.0**-24


@functools.cache
def _plugin_class(variant: str) -> type:
    """Return the plugin's class for an active variant: Mitsuba's base classes differ between variants."""

    class NlosPathIntegrator(mi.SamplingIntegrator):
        """``nlos_path``: the fields of ``PathSettings`` as plugin parameters.

        ``max_bounces`` is -1 for no limit; lengths are in engine units.
        """

        def __init__(self, properties: mi.Properties):
            super().__init__(properties)
            max_bounces = int(properties.get("max_bounces", -1))
            self.settings = PathSettings(
                bounces=BounceAxis(
                    None if max_bounces < 0 else max_bounces, bool(properties.get("split_bounces", True))
                ),
                first_bounce=int(properties.get("first_bounce", FIRST_BOUNCE + 1)),
                hidden_fraction=float(properties.get("hidden_fraction", 1.0)),
                laser_sampling=bool(properties.get("laser_sampling", True)),
                russian_roulette=bool(properties.get("russian_roulette", True)),
                spot_radius=float(properties.get("spot_radius", 0.0)),
                needs_visibility=bool(properties.get("needs_visibility", True)),
                has_transmission=bool(properties.get("has_transmission", False)),
            )

        def accumulate(
            self,
            transport: Transport,
            histogram: DeviceHistogram,
            randomness: LaneRandomness,
            strata: Strata,
            n_samples: int,
        ) -> tuple[LaneRandomness, Strata]:
            """Trace ``n_samples`` more paths per lane into ``histogram``; return the advanced random state."""
            trace = trace_direct_paths if are_direct(self.settings, transport.sampler) else trace_paths
            count = dr.opaque(mi.UInt32, n_samples)
            advanced, strata = trace(self.settings, transport, histogram, randomness, strata, count)
            dr.eval(histogram.sums, advanced.generator, advanced.sequence, strata.at)
            return advanced, strata

        def to_string(self) -> str:
            return f"NlosPathIntegrator[{self.settings}]"

    return NlosPathIntegrator


def load_path_integrator(settings: PathSettings) -> mi.Integrator:
    """Register the plugin with the active variant and load it with ``settings``."""
    mi.register_integrator(PLUGIN_NAME, _plugin_class(mi.variant()))
    bounces = settings.bounces
    return mi.load_dict(
        {
            "type": PLUGIN_NAME,
            "max_bounces": -1 if bounces.max_bounces is None else bounces.max_bounces,
            "first_bounce": settings.first_bounce,
            "split_bounces": bounces.split,
            "hidden_fraction": settings.hidden_fraction,
            "laser_sampling": settings.laser_sampling,
            "russian_roulette": settings.russian_roulette,
            "spot_radius": settings.spot_radius,
            "needs_visibility": settings.needs_visibility,
            "has_transmission": settings.has_transmission,
        }
    )
