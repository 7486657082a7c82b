"""Third-bounce loop: hidden geometry sampling alone, for which any-hit rays suffice.

The vertex, which ``trace_paths`` finds as the nearest hit of a ray, is known beforehand: the sampled point. Both legs
are any-hit queries, made only for points that face the sensor point and the laser point. Every lane traces one path
per iteration, so the lanes of a packet stay at neighbouring points of the hidden geometry (``SystematicSequence``).

The estimator, with a point x of density 1 / A on the hidden geometry, sensor point s, laser point l:

    H_3 = E  f_s cos_s  [V(s, x) cos(x) A / |x - s|^2]  f(x) cos(x)  f_l cos_l  V(x, l) / |x - l|^2

Higher bounces by Russian roulette: one path in n continues with weight n (``follow_paths``; n:
``continuation_period``); the lanes of a packet continue together.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.ray_offsets import connection_segment
from nlosrender.engine.launch.sequences import SystematicSequence, first_coordinate, recurrence_steps
from nlosrender.engine.launch.surface_sampler import SurfaceSample, SurfaceSampler
from nlosrender.engine.launch.time_gate import time_gate_roulette
from nlosrender.engine.path.laser_connections import PathVertex, connect_by_mirrors, connect_to_lasers
from nlosrender.engine.path.settings import PathParams, PathSettings
from nlosrender.engine.path.vertex_steps import DirectionNumbers, arrive, leave, turns_away, unit_interval


def is_third_bounce_loop(settings: PathSettings, sampler: SurfaceSampler) -> bool:
    """Return whether this loop samples all paths of these settings: hidden geometry sampling of triangles alone."""
    only_hidden = settings.p_hidden_sampling == 1 and settings.laser_sampling and not settings.finds_spot
    only_hidden &= not settings.flashes
    is_first = settings.first_bounce == THIRD_BOUNCE
    return only_hidden and is_first and not sampler.has_analytic and not mi.is_polarized


@dr.syntax
def trace_third_bounce(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    systematic: SystematicSequence,
    n_samples: mi.UInt32,
) -> tuple[LaneRandomness, SystematicSequence]:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; as ``trace_paths``."""
    sampler, stride, period = params.sampler, systematic.stride, params.continuation_period
    own_laser = params.lasers.gather(params.first_laser).interaction.p
    (step,) = recurrence_steps(1)

    # ---- State ------------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    position = mi.UInt64(systematic.position)
    seq_v = mi.UInt32(randomness.sequence[1])
    phase = mi.UInt32(randomness.phase)  # paths until the next one that continues
    done = mi.UInt32(0)  # paths of this lane

    while dr.hint(done < n_samples, exclude=[settings, params, histogram, sampler, own_laser, period]):
        # ---- Sample a point of the hidden geometry ------------------------------------------------------------------
        sample = sampler.sample(first_coordinate(position), unit_interval(seq_v), mi.Bool(True))
        goes_on = mi.Bool(False)
        if dr.hint(settings.goes_on, mode="scalar"):
            goes_on = phase == 0
            phase = dr.select(goes_on, period, phase) - 1
        placed = params.in_footprint(seq_v, mi.Bool(True))
        active = ~turns_away(params, sample, placed.sensors.interaction.p)
        if dr.hint(sampler.dark_behind and params.lasers_per_lane == 1, mode="scalar"):
            active &= goes_on | ~turns_away(params, sample, own_laser)
        generator = _connect_sample(settings, placed, histogram, generator, sample, active, goes_on)

        # ---- Next path ----------------------------------------------------------------------------------------------
        position += stride
        seq_v += step
        done += 1

    sequence = [randomness.sequence[0], seq_v, randomness.sequence[2]]
    return LaneRandomness(generator, sequence, phase), SystematicSequence(position, stride)


@dr.syntax
def _connect_sample(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    sample: SurfaceSample,
    active: mi.Bool,
    goes_on: mi.Bool,
) -> mi.PCG32:
    """Connect a sampled point to sensor point and lasers, and continue; packets with no active lane skip the block."""
    if dr.hint(active, exclude=[settings, params, histogram, sample, goes_on]):
        built, sampler, sensor = params.built, params.sampler, params.sensors.interaction
        leg = sample.p - sensor.p
        distance = dr.norm(leg)
        direction = leg / distance
        received = built.bsdf_at(sensor).eval(mi.BSDFContext(), sensor, sensor.to_local(direction), active)
        si = sampler.surface(sample, direction, active, settings.is_plain_diffuse)
        throughput = received * (dr.abs(dr.dot(si.n, direction)) * sampler.area / dr.square(distance))
        seen = active & dr.any(throughput > 0)
        if dr.hint(settings.needs_visibility, mode="scalar"):
            segment = connection_segment(built, si, -direction, sensor)
            seen &= ~built.scene.ray_test(segment, coherent=True, active=seen)
        lit_vertex = PathVertex(si, sensor.p, leg, distance, throughput, mi.UInt32(THIRD_BOUNCE))
        connect_to_lasers(settings, params, histogram, mi.PCG32(), lit_vertex, seen, coherent=True)
        if dr.hint(settings.goes_on, mode="scalar"):
            generator = follow_paths(settings, params, histogram, generator, lit_vertex, seen & goes_on)
    return generator


@dr.syntax
def follow_paths(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    generator: mi.PCG32,
    first: PathVertex,
    alive: mi.Bool,
) -> mi.PCG32:
    """Follow one path in n beyond its ``first`` hidden vertex, which has been deposited; ``alive``: which lanes.

    Returns
    -------
    mi.PCG32
        The advanced random state.
    """
    built, sampler = params.built, params.sampler
    last_vertex = settings.last_vertex
    time_gate = params.time_gate if settings.has_time_gate else None

    # ---- State ------------------------------------------------------------------------------------------------------
    vertex, opl = first.si, mi.Float(first.opl)  # the vertex, and the path's length up to it [engine units]
    throughput = first.throughput * mi.Float(params.continuation_period)
    bounce = mi.UInt32(first.bounce)  # bounce index of the vertex's connections
    on_wall = mi.Bool(False)  # the vertex lies on the relay wall
    medium = mi.Float(1)  # refractive index along the ray
    is_past_gate = mi.Bool(False)  # as in ``trace_paths``
    connect_by_mirrors(settings, params, histogram, generator, replace(first, throughput=throughput), alive)

    while dr.hint(alive, exclude=[settings, params, histogram, built, sampler, time_gate]):
        # ---- Sample the next direction ------------------------------------------------------------------------------
        alive, is_past_gate, throughput = time_gate_roulette(
            time_gate, generator, alive, is_past_gate, opl, vertex.p, on_wall, throughput
        )
        numbers = DirectionNumbers.drawn(generator, alive)
        has_target = alive & on_wall
        sample = sampler.sample(numbers.bits_u, numbers.v, has_target)
        has_target &= ~turns_away(params, sample, vertex.p)
        by_bsdf = alive & ~on_wall
        way, survival, eta = leave(
            settings, params, generator, vertex, on_wall, numbers, sample, by_bsdf, has_target, mi.Bool(False)
        )
        alive = by_bsdf | has_target
        if dr.hint(settings.russian_roulette, mode="scalar"):
            # by the albedo of hidden vertices, that of bounce 3 included, which the period n has thinned out already;
            # 1 towards a target
            alive &= generator.next_float32(by_bsdf) < survival
            way.value /= dr.maximum(survival, 1e-9)
        alive &= dr.any(way.value != 0)
        medium *= eta

        # ---- Intersect ----------------------------------------------------------------------------------------------
        there = arrive(settings, params, way, alive)
        opl += medium * there.distance
        throughput = dr.select(there.is_reached, throughput * way.value / there.density, 0)
        bounce += 1
        alive = there.is_reached & dr.any(throughput != 0)

        # ---- Connect to the lasers and deposit ----------------------------------------------------------------------
        vertex, on_wall = there.si, there.on_wall
        lit_vertex = PathVertex(vertex, way.origin, there.leg, opl, throughput, bounce)
        connect_to_lasers(settings, params, histogram, generator, lit_vertex, alive)
        connect_by_mirrors(settings, params, histogram, generator, lit_vertex, alive)

        # ---- Stop ---------------------------------------------------------------------------------------------------
        if dr.hint(last_vertex is not None, mode="scalar"):
            alive &= bounce < last_vertex
    return generator
