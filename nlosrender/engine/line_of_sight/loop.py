"""The transient path tracer of line-of-sight captures: paths from the camera to emitters that flash once at t = 0.

At every vertex the emitters are sampled, and the direction the path goes on in is sampled from the BSDF; what either
finds is weighted by the power heuristic (Veach 1997). A lane belongs to one pixel; when its path ends it starts the
next one in the same loop. Throughput is built from the camera on, so that in polarised variants, where it is a Mueller
matrix, every surface multiplies it from the right; the first factor turns the Stokes vector's reference to the
camera's horizontal. Everything else is the same code in every variant.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.launch_params import MAX_SURVIVAL
from nlosrender.engine.launch.sequences import recurrence_steps
from nlosrender.engine.line_of_sight.view_params import ViewLaunchParams, ViewSettings

ROULETTE_AFTER = 3  # surface interactions without Russian roulette; chosen, not measured


@dr.syntax
def trace_view(
    settings: ViewSettings,
    params: ViewLaunchParams,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    n_samples: mi.UInt32,
) -> LaneRandomness:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; return the advanced random state.

    Deposits are radiance [W m^-2 sr^-1] of the steady image, by the optical path length they have come.
    """
    scene = params.scene
    context = mi.BSDFContext()
    lane = dr.arange(mi.UInt32, dr.width(params.pixels))
    no_laser = mi.UInt32(0)
    steps = recurrence_steps(2)
    max_bounces = settings.bounces.max_bounces

    # ---- State ------------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    seq_u, seq_v = (mi.UInt32(start) for start in randomness.sequence[:2])
    started = mi.UInt32(0)  # paths begun by this lane
    alive = mi.Bool(False)  # a ray is under way
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1))  # not zeros: such a ray has no direction
    bounce = mi.UInt32(0)  # surface interactions so far
    throughput = mi.Spectrum(0)  # of the path up to the last vertex, and the direction under way over its density
    bsdf_density = mi.Float(0)  # of that direction [1/sr]
    is_delta = mi.Bool(True)  # no emitter sampling could have found it: the camera, or a delta lobe
    opl = mi.Float(0)  # optical path length from the camera [engine units]
    medium = mi.Float(1)  # refractive index along the ray
    before = dr.zeros(mi.Interaction3f)  # the last vertex

    while dr.hint(alive | (started < n_samples), exclude=[settings, params, histogram, scene]):
        # ---- Start the next path ------------------------------------------------------------------------------------
        start = ~alive
        started = dr.select(start, started + 1, started)
        seq_u = dr.select(start, seq_u + steps[0], seq_u)
        seq_v = dr.select(start, seq_v + steps[1], seq_v)
        first = _pixel_direction(params, seq_u, seq_v)
        ray.o = dr.select(start, params.camera, ray.o)
        ray.d = dr.select(start, first, ray.d)
        throughput = dr.select(start, _at_camera(params, first), throughput)
        bounce = dr.select(start, mi.UInt32(0), bounce)
        is_delta |= start
        opl = dr.select(start, 0, opl)
        medium = dr.select(start, 1, medium)
        before.p = dr.select(start, params.camera, before.p)

        # ---- Intersect ----------------------------------------------------------------------------------------------
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        hit = si.is_valid()
        leg = medium * dr.norm(si.p - before.p)
        if dr.hint(not settings.counts_last_leg, mode="scalar"):
            leg = dr.select(bounce == 0, 0, leg)
        opl = dr.select(hit, opl + leg, opl)
        slot = _slot(settings, bounce)

        # ---- An emitter found by chance: deposit --------------------------------------------------------------------
        emitter = si.emitter(scene)
        found = emitter != None  # noqa: E711  # an array of pointers
        direction = mi.DirectionSample3f(scene, si, before)
        emitter_density = scene.pdf_emitter_direction(before, direction, found & ~is_delta)
        share = _power_heuristic(bsdf_density, dr.select(is_delta, 0, emitter_density))
        carried = throughput * emitter.eval(si, found)
        arrival = params.bin_of(opl)
        if dr.hint(settings.has_sky, mode="scalar"):
            arrival = dr.select(hit, arrival, -1)  # from infinitely far away: outside any window
        histogram.deposit(lane, no_laser, slot, arrival, carried * dr.select(is_delta, 1, share), found)

        # ---- Connect to an emitter: deposit -------------------------------------------------------------------------
        bounce += 1
        go_on = mi.Bool(hit)
        if dr.hint(max_bounces is not None, mode="scalar"):
            go_on &= bounce <= max_bounces
        bsdf = si.bsdf(ray)
        connects = go_on & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        square = mi.Point2f(generator.next_float32(connects), generator.next_float32(connects))
        towards, emitted = scene.sample_emitter_direction(si, square, True, connects)
        connects &= towards.pdf > 0
        wo = si.to_local(towards.d)
        reflected, density = bsdf.eval_pdf(context, si, wo, connects)
        reflected = si.to_world_mueller(reflected, -wo, si.wi)
        share = dr.select(towards.delta, 1, _power_heuristic(towards.pdf, density))
        carried = throughput * reflected * emitted
        index = mi.Float(medium)
        if dr.hint(settings.bends, mode="scalar"):
            behind = dr.gather(mi.Float, params.indices, dr.reinterpret_array(mi.UInt32, si.shape), connects)
            crosses = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) < 0
            crossing = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, behind, dr.rcp(behind))
            index = dr.select(crosses, medium * crossing, medium)
        arrival = params.bin_of(opl + index * towards.dist)
        if dr.hint(settings.has_sky, mode="scalar"):
            arrival = dr.select(mi.has_flag(towards.emitter.flags(), mi.EmitterFlags.Infinite), -1, arrival)
        histogram.deposit(lane, no_laser, _slot(settings, bounce), arrival, carried * share, connects)

        # ---- Sample the next direction ------------------------------------------------------------------------------
        lobe = generator.next_float32(go_on)
        square = mi.Point2f(generator.next_float32(go_on), generator.next_float32(go_on))
        bs, weight = bsdf.sample(context, si, lobe, square, go_on)
        weight = si.to_world_mueller(weight, -bs.wo, si.wi)
        throughput = throughput * weight  # Mueller matrices: from the right
        bsdf_density = mi.Float(bs.pdf)
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        medium = dr.select(go_on & (bs.eta > 0), medium * bs.eta, medium)
        ray = si.spawn_ray(si.to_world(bs.wo))
        before.p = si.p
        before.n = si.n

        # ---- Stop ---------------------------------------------------------------------------------------------------
        brightness = dr.max(mi.unpolarized_spectrum(throughput))
        alive = go_on & (brightness > 0)
        if dr.hint(settings.russian_roulette, mode="scalar"):
            # radiance changes with the square of the index, which must not lower the survival probability
            survival = dr.minimum(brightness * dr.square(medium), MAX_SURVIVAL)
            survival = dr.select(bounce < ROULETTE_AFTER, 1, survival)
            alive &= generator.next_float32(alive) < survival
            throughput *= dr.rcp(dr.maximum(survival, 1e-9))

    return LaneRandomness(generator, [seq_u, seq_v, *randomness.sequence[2:]])


def _pixel_direction(params: ViewLaunchParams, bits_x: mi.UInt32, bits_y: mi.UInt32) -> mi.Vector3f:
    """Return the direction from the camera to a point of the lane's pixel, uniform over its area (box filter)."""
    x, y = (mi.Float(bits >> 8) * 2.0**-24 - 0.5 for bits in (bits_x, bits_y))
    return dr.normalize(params.pixels + x * params.pixel_x + y * params.pixel_y - params.camera)


def _at_camera(params: ViewLaunchParams, direction: mi.Vector3f) -> mi.Spectrum:
    """Return the throughput a path starts with: polarised, the turn from the implicit frame to the camera's."""
    if not mi.is_polarized:
        return mi.Spectrum(1)
    horizontal = dr.normalize(dr.cross(direction, params.up))
    turned = mi.mueller.rotate_stokes_basis_m(-direction, mi.mueller.stokes_basis(-direction), horizontal)
    return mi.Spectrum(turned)


def _slot(settings: ViewSettings, bounce: mi.UInt32) -> mi.UInt32:
    return dr.minimum(bounce, mi.UInt32(settings.bounces.n_slots - 1)) if settings.bounces.split else mi.UInt32(0)


def _power_heuristic(own: mi.Float, other: mi.Float) -> mi.Float:
    """Return the weight of a technique among two, by the squares of their densities."""
    # the ratio first: squares of densities overflow float32
    return dr.select(own > 0, dr.rcp(1 + dr.square(other / own)), 0)
