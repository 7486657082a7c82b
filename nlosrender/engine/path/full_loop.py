"""The transient path tracer: a Mitsuba integrator plugin whose one loop is the whole of Royo et al. 2022, section 4.

Paths start at sensor points. A lane belongs to one sensor point; when its path ends it starts the next one in
the same iteration, so lanes stay busy whatever the path lengths. At every vertex the path is connected to the
laser points (laser sampling) and goes on in a direction from the BSDF or, on the relay wall, towards a point
sampled on the hidden geometry (hidden geometry sampling); see ``path_steps``. A sampled point that turns out to be
occluded contributes nothing. Where hidden geometry sampling does alone, ``direct_paths`` has a quicker loop.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE, BounceAxis
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaneRandomness, LaunchParams, PathSettings
from nlosrender.engine.launch.recurrence import recurrence_steps
from nlosrender.engine.launch.systematic_sequence import SystematicSequence, first_coordinate
from nlosrender.engine.launch.time_gate import time_gate_roulette
from nlosrender.engine.path.laser_connections import connect_to_lasers, deposit_spot
from nlosrender.engine.path.third_bounce_loop import are_direct, trace_direct_paths
from nlosrender.engine.path.vertex_steps import (
    Departure,
    DirectionNumbers,
    arrive,
    leave,
    misses_hidden,
    turns_away,
    unit_interval,
)

PLUGIN_NAME = "nlos_path"
MOST_TRIES = 4  # of a lane whose paths miss everything, before the others of its packet go on


@dr.syntax
def trace_paths(
    settings: PathSettings,
    params: LaunchParams,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    systematic: SystematicSequence,
    n_samples: mi.UInt32,
) -> tuple[LaneRandomness, SystematicSequence]:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; return the advanced random state.

    Throughput is in units of radiance per (engine unit)^-2; the caller scales by energy and unit.
    """
    built, sampler, sensors = params.built, params.sampler, params.sensors
    wall = mi.ShapePtr(built.wall_shape)
    lane = params.row_of_lane
    q = settings.p_hidden_sampling  # probability of hidden geometry sampling at a wall vertex
    steps = recurrence_steps(2) if 0 < q < 1 else (*recurrence_steps(1), 1)  # the second chooses the technique
    stride = systematic.stride
    max_bounces, last_vertex = settings.bounces.max_bounces, settings.last_vertex
    time_gate = params.time_gate if settings.has_time_gate else None
    further_share = 1.0 / mi.Float(params.continuation_period)

    # ---- State -------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    at = mi.UInt64(systematic.at)
    seq_v, seq_t = (mi.UInt32(start) for start in randomness.sequence[1:])
    started = mi.UInt32(0)  # paths begun by this lane
    alive = mi.Bool(False)  # a ray is under way
    way = Departure.none(built)  # that ray
    bounce = mi.UInt32(FIRST_BOUNCE)  # bounce index that a laser connection at the last vertex has
    throughput = mi.Spectrum(0)  # of the path up to the last vertex
    opl = mi.Float(0)  # optical path length from the sensor point [engine units]
    medium = mi.Float(1)  # refractive index along the ray
    is_past_gate = mi.Bool(False)  # the path can only bring light after the window, and has survived that roulette

    # what a launch reads is no state of the loop
    while dr.hint(
        alive | (started < n_samples),
        exclude=[settings, params, histogram, built, sampler, sensors, time_gate, further_share],
    ):
        # ---- Intersect -----------------------------------------------------------------------------------------
        there = arrive(settings, params, way, alive)
        si, hit = there.si, there.is_reached
        opl += medium * there.distance

        # ---- Laser spot found by chance --------------------------------------------------------------------------
        if dr.hint(settings.finds_spot, mode="scalar"):
            deposit_spot(
                settings,
                params,
                histogram,
                lane,
                si,
                way.ray,
                hit & there.on_wall,
                way.is_delta,
                bounce,
                opl,
                throughput,
                way.value,
                there.density,
                there.distance2,
            )

        throughput = dr.select(hit, throughput * way.value / there.density, 0)
        bounce += 1
        hit &= dr.any(mi.unpolarized_spectrum(throughput) != 0)

        # ---- Thin out what comes after the window, once a path ---------------------------------------------------
        hit, is_past_gate, throughput = time_gate_roulette(
            time_gate, generator, hit, is_past_gate, opl, si.p, there.on_wall, throughput
        )

        # ---- Connect to the lasers and deposit ---------------------------------------------------------------------
        if dr.hint(settings.laser_sampling, mode="scalar"):
            in_reach = mi.Bool(hit)
            if dr.hint(settings.first_bounce > FIRST_BOUNCE + 1, mode="scalar"):
                in_reach &= bounce >= settings.first_bounce
            if dr.hint(settings.goes_on and max_bounces is not None, mode="scalar"):
                in_reach &= bounce <= max_bounces
            leg = there.leg
            connect_to_lasers(
                settings, params, histogram, generator, lane, si, in_reach, bounce, opl, throughput, way.origin, leg
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
            is_past_gate &= ~start
        else:
            vertex = sensors.interaction
            throughput = _at_sensor(sensors.interaction)
            opl, bounce, medium = mi.Float(0), mi.UInt32(FIRST_BOUNCE), mi.Float(1)
        on_wall = vertex.shape == wall

        # ---- Sample the next direction -----------------------------------------------------------------------------
        numbers, t = DirectionNumbers(first_coordinate(at), unit_interval(seq_v)), unit_interval(seq_t)
        if dr.hint(settings.goes_on, mode="scalar"):
            further = DirectionNumbers.drawn(generator, go_on)
            numbers = dr.select(start, numbers, further)
            t = dr.select(start, t, unit_interval(generator.next_uint32(go_on)))
        at = dr.select(start, at + stride, at)
        seq_v = dr.select(start, seq_v + steps[0], seq_v)
        seq_t = dr.select(start, seq_t + steps[1], seq_t)
        has_target = alive & on_wall & (t < q)
        by_bsdf = alive & ~has_target
        sample = None
        if dr.hint(q > 0, mode="scalar"):
            sample = sampler.sample(numbers.bits_u, numbers.v, has_target)
            dark = has_target & turns_away(params, sample, vertex.p)
            if dr.hint(q == 1 and sampler.dark_behind, mode="scalar"):
                # the next path starts at once
                while dr.hint(dark & start & (started < n_samples), exclude=[params, sampler, vertex, start]):
                    started += 1
                    again = sampler.sample(first_coordinate(at), unit_interval(seq_v), dark)
                    at += stride
                    seq_v += steps[0]
                    sample = again
                    dark = turns_away(params, again, vertex.p)
            alive &= ~dark
            has_target &= ~dark
        way, survival, eta = leave(settings, params, generator, vertex, on_wall, numbers, sample, by_bsdf, has_target)
        if dr.hint(params.hidden_aabb is not None, mode="scalar"):
            # before a planar wall all surfaces lie in the box: the next path starts at once
            misses, tries = start & by_bsdf & misses_hidden(params, way.ray), mi.UInt32(0)
            while dr.hint(
                misses & (started < n_samples) & (tries < MOST_TRIES),
                exclude=[settings, params, sensors, on_wall, start],
            ):
                started += 1
                tries += 1
                following = DirectionNumbers(first_coordinate(at), unit_interval(seq_v))
                at += stride
                seq_v += steps[0]
                seq_t += steps[1]
                point, nowhere = sensors.interaction, mi.Bool(False)
                way, survival, eta = leave(
                    settings, params, generator, point, on_wall, following, None, misses, nowhere
                )
                misses &= misses_hidden(params, way.ray)
            alive &= ~misses
        medium *= eta

        # ---- Stop ----------------------------------------------------------------------------------------------------
        if dr.hint(settings.goes_on and settings.russian_roulette, mode="scalar"):
            # after the connections of this vertex, by the albedo just met; never before it could deposit;
            # after the third bounce by a share besides (``further_paths``)
            if dr.hint(settings.first_bounce == THIRD_BOUNCE, mode="scalar"):
                survival *= dr.select(bounce == THIRD_BOUNCE, further_share, 1)
            survival = dr.select(start | (bounce < settings.first_bounce), 1, survival)
            alive &= generator.next_float32(alive & ~start) < survival
            way.value /= dr.maximum(survival, 1e-9)
        alive &= dr.any(mi.unpolarized_spectrum(way.value) != 0)

    return replace(
        randomness, generator=generator, sequence=[randomness.sequence[0], seq_v, seq_t]
    ), SystematicSequence(at, stride)


def _at_sensor(point: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return the throughput paths start with: polarised, the turn from the implicit Stokes frame to the sensor's.

    The reference direction is the sensor's horizontal: across the ray from the sensor and the wall's y axis.
    """
    if not mi.is_polarized:
        return mi.Spectrum(1)
    out = point.to_world(point.wi)
    horizontal = dr.normalize(dr.cross(-out, mi.Vector3f(0, 1, 0)))
    return mi.Spectrum(mi.mueller.rotate_stokes_basis_m(out, mi.mueller.stokes_basis(out), horizontal))


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
                p_hidden_sampling=float(properties.get("hidden_fraction", 1.0)),
                laser_sampling=bool(properties.get("laser_sampling", True)),
                russian_roulette=bool(properties.get("russian_roulette", True)),
                spot_radius=float(properties.get("spot_radius", 0.0)),
                needs_visibility=bool(properties.get("needs_visibility", True)),
                has_transmission=bool(properties.get("has_transmission", False)),
                is_plain_diffuse=bool(properties.get("only_normals_matter", False)),
            )

        def accumulate(
            self,
            params: LaunchParams,
            histogram: DeviceHistogram,
            randomness: LaneRandomness,
            systematic: SystematicSequence,
            n_samples: int,
        ) -> tuple[LaneRandomness, SystematicSequence]:
            """Trace ``n_samples`` more paths per lane into ``histogram``; return the advanced random state."""
            trace = trace_direct_paths if are_direct(self.settings, params.sampler) else trace_paths
            count = dr.opaque(mi.UInt32, n_samples)
            advanced, systematic = trace(self.settings, params, histogram, randomness, systematic, count)
            dr.eval(histogram.sums, advanced.generator, advanced.sequence, advanced.phase, systematic.at)
            return advanced, systematic

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
            "hidden_fraction": settings.p_hidden_sampling,
            "laser_sampling": settings.laser_sampling,
            "russian_roulette": settings.russian_roulette,
            "spot_radius": settings.spot_radius,
            "needs_visibility": settings.needs_visibility,
            "has_transmission": settings.has_transmission,
            "only_normals_matter": settings.is_plain_diffuse,
        }
    )
