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
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import FIRST_BOUNCE, BounceAxis
from nlosrender.engine.device_arrays import WallPoints
from nlosrender.engine.histogram import DeviceHistogram
from nlosrender.engine.low_discrepancy import recurrence_steps
from nlosrender.engine.surface_sampler import SurfaceSampler
from nlosrender.scene.build import BuiltScene

PLUGIN_NAME = "nlos_path"
RAY_OFFSET = 2e-5  # engine units; float32 positions of a scene of size 1 are good to 1e-7
HIGHEST_SURVIVAL = 0.95  # of the roulette: even a white closed room ends


@dataclass(frozen=True)
class PathSettings:
    """What the integrator computes and how; part of the compiled kernel."""

    bounces: BounceAxis
    first_bounce: int  # lowest bounce that is deposited, >= 3
    hidden_fraction: float  # share of wall vertices that sample the hidden geometry; 0 = BSDF only, 1 = hidden only
    laser_sampling: bool
    russian_roulette: bool
    spot_radius: float  # of the laser on the wall [engine units]; 0 = a point
    has_transmission: bool  # some BSDF refracts: the optical path length needs the medium's index

    @property
    def goes_on(self) -> bool:
        """Whether paths have more than one vertex after the sensor point."""
        return self.last_vertex is None or self.last_vertex > FIRST_BOUNCE + 1

    @property
    def last_vertex(self) -> int | None:
        """Bounce index of the last vertex a path may have: one more than the bounces when rays look for the spot."""
        highest = self.bounces.max_bounces
        return highest + 1 if highest is not None and self.finds_spot else highest

    @property
    def finds_spot(self) -> bool:
        """Whether rays may find the laser's spot by chance."""
        return self.spot_radius > 0


@dataclass(frozen=True, eq=False)
class Transport:
    """Everything a launch reads: scene, points, and the conversion from engine units to bins."""

    built: BuiltScene
    sampler: SurfaceSampler
    sensors: WallPoints  # one per lane
    lasers: WallPoints  # all lasers of the batch
    first_laser: mi.UInt32  # per lane: confocal lanes have their own laser, others start at 0
    lasers_per_lane: int
    n_lasers: mi.UInt32  # opaque copy of ``lasers_per_lane``: its value is not part of the kernel
    bins_per_unit: mi.Float  # engine unit / bin width, opaque


@dataclass(frozen=True, eq=False)
class LaneRandomness:
    """Random state of every lane; carried from launch to launch, so that splitting a render changes no bit."""

    generator: mi.PCG32
    sequence: list[mi.UInt32]  # low-discrepancy state, three dimensions

    @classmethod
    def seeded(cls, seed: int, lane_key: mi.UInt32) -> LaneRandomness:
        """Seed every lane from the render's seed and the lane's identity, never from its place in a batch."""
        state_high, state_low = mi.sample_tea_32(mi.UInt32(seed), lane_key, 8)
        key_high, key_low = mi.sample_tea_32(lane_key, mi.UInt32(seed ^ 0x9E3779B9), 8)
        wide = mi.UInt64(2**32)
        generator = mi.PCG32(
            initstate=mi.UInt64(state_high) * wide + mi.UInt64(state_low),
            initseq=mi.UInt64(key_high) * wide + mi.UInt64(key_low),
        )
        starts = [generator.next_uint32() for _ in range(3)]
        dr.eval(generator, starts)
        return cls(generator, starts)


@dr.syntax
def trace_paths(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    n_samples: mi.UInt32,
) -> LaneRandomness:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; return the advanced random state.

    Throughput is in units of radiance per (engine unit)^-2; the caller scales by energy and unit.
    """
    built, sampler, sensors = transport.built, transport.sampler, transport.sensors
    scene, wall_bsdf = built.scene, built.wall_bsdf
    wall = mi.ShapePtr(built.wall_shape)
    context = mi.BSDFContext()
    lane = dr.arange(mi.UInt32, dr.width(sensors.delay_bins))
    q = settings.hidden_fraction  # probability of hidden geometry sampling at a wall vertex
    steps = recurrence_steps(3) if 0 < q < 1 else (*recurrence_steps(2), 1)  # the third chooses the technique
    max_bounces, last_vertex = settings.bounces.max_bounces, settings.last_vertex

    # ---- State -------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    seq_u, seq_v, seq_t = (mi.UInt32(start) for start in randomness.sequence)
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

    # what a launch reads is no state of the loop
    while dr.hint(alive | (started < n_samples), exclude=[settings, transport, histogram, built, sampler, sensors]):
        # ---- Intersect -----------------------------------------------------------------------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=alive)
        hit = alive & si.is_valid()
        distance2 = dr.squared_norm(si.p - origin)
        distance = dr.sqrt(distance2)
        if dr.hint(q > 0, mode="scalar"):
            # occluded: the ray met something in front of the sampled point
            hit &= ~has_target | sampler.reached(si, target, target_shape, target_primitive)
        on_wall = si.shape == wall
        density = mi.Float(bsdf_density)
        if dr.hint(q > 0, mode="scalar"):
            # not along the ray: its offset origin matters where hidden geometry comes close to the wall
            cosine = dr.abs(dr.dot(si.n, si.p - origin)) / distance
            jacobian = dr.select(sampler.covers(si, wall), distance2 / dr.maximum(cosine, 1e-9), 0)
            density += hidden_density * jacobian
        opl += medium * distance

        # ---- Laser spot found by chance --------------------------------------------------------------------------
        if dr.hint(settings.finds_spot, mode="scalar"):
            _deposit_spot(
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
        hit &= dr.any(throughput != 0)

        # ---- Connect to the lasers and deposit ---------------------------------------------------------------------
        if dr.hint(settings.laser_sampling, mode="scalar"):
            in_reach = mi.Bool(hit)
            if dr.hint(settings.first_bounce > FIRST_BOUNCE + 1, mode="scalar"):
                in_reach &= bounce >= settings.first_bounce
            if dr.hint(settings.goes_on and max_bounces is not None, mode="scalar"):
                in_reach &= bounce <= max_bounces
            _connect_to_lasers(settings, transport, histogram, generator, lane, si, in_reach, bounce, opl, throughput)

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
            throughput = dr.select(start, mi.Spectrum(1), throughput)
            opl = dr.select(start, 0, opl)
            bounce = dr.select(start, mi.UInt32(FIRST_BOUNCE), bounce)
            medium = dr.select(start, 1, medium)
        else:
            vertex = sensors.interaction
            throughput, opl, bounce, medium = mi.Spectrum(1), mi.Float(0), mi.UInt32(FIRST_BOUNCE), mi.Float(1)
        on_wall = vertex.shape == wall

        # ---- Sample the next direction -----------------------------------------------------------------------------
        seq_u = dr.select(start, seq_u + steps[0], seq_u)
        seq_v = dr.select(start, seq_v + steps[1], seq_v)
        seq_t = dr.select(start, seq_t + steps[2], seq_t)
        bits_u, bits_v, bits_t = mi.UInt32(seq_u), mi.UInt32(seq_v), mi.UInt32(seq_t)
        if dr.hint(settings.goes_on, mode="scalar"):
            # A lane draws only what its path uses: numbers drawn while it idles would depend on how launches are cut.
            bits_u = dr.select(start, seq_u, generator.next_uint32(go_on))
            bits_v = dr.select(start, seq_v, generator.next_uint32(go_on))
            bits_t = dr.select(start, seq_t, generator.next_uint32(go_on))
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
            is_delta = by_bsdf & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            share = dr.select(on_wall, 1 - q, 1.0)
            bsdf_density = dr.select(is_delta, share, share * bs.pdf)
            value = dr.select(is_delta, weight, weight * bs.pdf)
            survival = dr.select(by_bsdf, dr.minimum(dr.max(weight), HIGHEST_SURVIVAL), 1)
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
                    seq_u += steps[0]
                    seq_v += steps[1]
                    again = sampler.sample(seq_u, _unit_interval(seq_v), dark)
                    target, target_shape, target_primitive = again.p, again.shape, again.primitive
                    dark = dr.dot(again.n, target - vertex.p) >= 0
                alive &= ~dark
                has_target &= ~dark
            to_target = target - vertex.p
            direction = to_target * dr.rsqrt(dr.squared_norm(to_target))
            local = vertex.to_local(direction)
            f, pdf = wall_bsdf.eval_pdf(context, vertex, local, has_target)
            wo = dr.select(has_target, local, wo)
            value = dr.select(has_target, f, value)
            bsdf_density = dr.select(has_target, (1 - q) * pdf, bsdf_density)
            hidden_density = dr.select(on_wall & ~is_delta, q / sampler.area, 0)
        if dr.hint(settings.goes_on and settings.russian_roulette, mode="scalar"):
            # after the connections of this vertex, by the albedo just met; never before it could deposit
            survival = dr.select(start | (bounce < settings.first_bounce), 1, survival)
            alive &= generator.next_float32(alive & ~start) < survival
            value /= dr.maximum(survival, 1e-9)
        alive &= dr.any(value != 0)
        world = vertex.to_world(wo)
        origin = mi.Point3f(vertex.p)
        ray_origin = _offset_origin(vertex, world)
        if dr.hint(q > 0, mode="scalar"):
            # from the offset origin: a parallel ray would land beside the target, in another triangle of a fine mesh
            world = dr.select(has_target, dr.normalize(target - ray_origin), world)
        ray = mi.Ray3f(ray_origin, world)

    return LaneRandomness(generator, [seq_u, seq_v, seq_t])


@dr.syntax
def _connect_to_lasers(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    lane: mi.UInt32,
    si: mi.SurfaceInteraction3f,
    active: mi.Bool,
    bounce: mi.UInt32,
    opl: mi.Float,
    throughput: mi.Spectrum,
) -> None:
    """Laser sampling: connect the vertex to every laser of the lane and deposit (Royo et al. 2022, Eq. 12)."""
    slot = _slot(settings, bounce)
    # one place in the spot for all lasers: what a path draws must not depend on how many lasers a batch has
    in_spot = mi.Vector3f(0)
    if dr.hint(settings.finds_spot, mode="scalar"):
        in_spot = _on_disc(generator, active) * settings.spot_radius
    if dr.hint(transport.lasers_per_lane == 1, mode="scalar"):
        _connect(settings, transport, histogram, in_spot, lane, mi.UInt32(0), slot, si, active, opl, throughput)
    else:
        laser = mi.UInt32(0)
        while dr.hint(laser < transport.n_lasers, exclude=[settings, transport, histogram]):
            _connect(settings, transport, histogram, in_spot, lane, laser, slot, si, active, opl, throughput)
            laser += 1


def _connect(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    in_spot: mi.Vector3f,
    lane: mi.UInt32,
    laser: mi.UInt32,
    slot: mi.UInt32,
    si: mi.SurfaceInteraction3f,
    active: mi.Bool,
    opl: mi.Float,
    throughput: mi.Spectrum,
) -> None:
    built = transport.built
    context = mi.BSDFContext()
    points = transport.lasers.gather(transport.first_laser + laser)
    lit = points.interaction
    if settings.finds_spot:
        lit.p = lit.p + lit.to_world(in_spot)
        # what a spot loses over the wall's edge lights nothing
        active = active & built.wall_shape.ray_test(mi.Ray3f(lit.p + 1e-2 * lit.n, -lit.n), active=active)
    to_laser = lit.p - si.p
    distance2 = dr.squared_norm(to_laser)
    distance = dr.sqrt(distance2)
    direction = to_laser / distance
    bsdf = si.bsdf()
    reflected, pdf = bsdf.eval_pdf(context, si, si.to_local(direction), active)
    emitted = built.wall_bsdf.eval(context, lit, lit.to_local(-direction), active)  # includes the laser point's cosine
    value = throughput * reflected * emitted / distance2
    if settings.finds_spot:
        # balance heuristic against finding the same point of the spot by the next ray
        share = dr.select(si.shape == mi.ShapePtr(built.wall_shape), 1 - settings.hidden_fraction, 1.0)
        cosine = dr.maximum(dr.dot(lit.n, -direction), 0)
        value *= _balance(distance2, share * pdf * cosine * dr.pi * settings.spot_radius**2)
    active = active & dr.any(value > 0)  # not in place: the caller's mask serves the other lasers, too
    active &= ~built.scene.ray_test(connection_segment(si, direction, lit.p), coherent=False, active=active)
    bins = delay_bin(transport, points, opl + distance)
    histogram.deposit(lane, laser, slot, bins, value, active)


@dr.syntax
def _deposit_spot(
    settings: PathSettings,
    transport: Transport,
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
    while dr.hint(laser < transport.n_lasers, exclude=[settings, transport, histogram]):
        points = transport.lasers.gather(transport.first_laser + laser)
        lit = points.interaction
        inside = active & (dr.squared_norm(si.p - lit.p) < settings.spot_radius**2)
        emitted = transport.built.wall_bsdf.eval(context, lit, lit.to_local(-ray.d), inside) / (cosine * spot_area)
        carried = throughput * value * emitted / density
        if dr.hint(settings.laser_sampling, mode="scalar"):
            carried *= dr.select(is_delta, 1, _balance(density * cosine * spot_area, distance2))
        inside &= dr.any(carried > 0)
        histogram.deposit(lane, laser, slot, delay_bin(transport, points, opl), carried, inside)
        laser += 1


def _slot(settings: PathSettings, bounce: mi.UInt32) -> mi.UInt32:
    """Return the histogram's slot of a bounce; the second bounce is computed elsewhere and has none."""
    bounces = settings.bounces
    if not bounces.split:
        return mi.UInt32(0)
    return dr.minimum(bounce - (FIRST_BOUNCE + 1), mi.UInt32(bounces.n_slots - 2))


def delay_bin(transport: Transport, points: WallPoints, opl: mi.Float) -> mi.Int32:
    """Return the bin of a path: its length in bins, plus what laser and sensor point add."""
    sensors = transport.sensors
    delay = opl * transport.bins_per_unit + (points.delay_fraction + sensors.delay_fraction)
    return mi.Int32(dr.floor(dr.minimum(delay, 1e9))) + points.delay_bins + sensors.delay_bins


def _balance(own: mi.Float, other: mi.Float) -> mi.Float:
    return own / dr.maximum(own + other, 1e-30)


def _on_disc(generator: mi.PCG32, active: mi.Bool) -> mi.Vector3f:
    square = mi.Point2f(generator.next_float32(active), generator.next_float32(active))
    point = mi.warp.square_to_uniform_disk_concentric(square)
    return mi.Vector3f(point.x, point.y, 0)


def _unit_interval(bits: mi.UInt32) -> mi.Float:
    return mi.Float(bits >> 8) * 2.0**-24


def _offset_origin(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Point3f:
    scale = RAY_OFFSET * (1 + dr.max(dr.abs(si.p)))
    return si.p + si.n * dr.mulsign(mi.Float(scale), dr.dot(si.n, direction))


def connection_segment(si: mi.SurfaceInteraction3f, direction: mi.Vector3f, point: mi.Point3f) -> mi.Ray3f:
    """Ray from the surface to ``point``, which lies in ``direction``, ending just before it."""
    origin = _offset_origin(si, direction)
    # aimed from the offset origin: a parallel ray would pass beside the point, behind the wall at oblique incidence
    distance = dr.norm(point - origin)
    return mi.Ray3f(origin, (point - origin) / distance, distance - 2 * RAY_OFFSET * (1 + distance), mi.Float(0), [])


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
                has_transmission=bool(properties.get("has_transmission", False)),
            )

        def accumulate(
            self, transport: Transport, histogram: DeviceHistogram, randomness: LaneRandomness, n_samples: int
        ) -> LaneRandomness:
            """Trace ``n_samples`` more paths per lane into ``histogram``; return the advanced random state."""
            advanced = trace_paths(self.settings, transport, histogram, randomness, dr.opaque(mi.UInt32, n_samples))
            dr.eval(histogram.sums, advanced.generator, advanced.sequence)
            return advanced

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
            "has_transmission": settings.has_transmission,
        }
    )
