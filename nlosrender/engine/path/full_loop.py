"""Full loop: transient path tracing with hidden geometry and laser sampling (Royo et al. 2022, section 4).

Paths start at sensor points. A lane belongs to one sensor point; when its path ends it starts the next one in the same
iteration (``PathStarts.begin``), so lanes stay busy whatever the path lengths. ``third_bounce_loop`` is
faster where hidden geometry sampling alone suffices.

The estimator. A path x_0 (sensor point), x_1, ..., x_k is extended from x_k in a direction w of density p(w), and its
throughput (product of BSDF f, cosines and 1 / p, the wall's f at x_0 included) is

    T_0 = 1,    T_{k+1} = T_k  f(x_k, w) cos(w) / p(w)                        [``way.value`` / ``there.density``]

At a vertex of the wall p is a mixture of two techniques, q = ``p_hidden_sampling`` (one-sample MIS with the balance
heuristic, Veach 1997, 9.2.4), elsewhere q = 0:

    p(w) = (1 - q) p_bsdf(w) + q (1 / A) |x_{k+1} - x_k|^2 / cos(x_{k+1})     [A: area of the hidden geometry]

Every vertex x_k is connected to every laser point l of the lane (laser sampling), whose wall reflects the laser's
energy E with f_l; V is visibility. With bounce index b = k + 2 the deposit, in the bin of the path's length, is

    H_b += E  T_k  f(x_k) cos  f_l cos_l  V / |x_k - l|^2                     [``laser_connections``]

and the same by one mirror reflection, one bounce later (``connect_by_mirrors``). Of pixels that stand for all that they
see x_0 is connected, too: b = 2, which elsewhere has no noise (``DeviceCapture.exact_light``).

Russian roulette divides T by the survival probability (``_survival``): at every bounce from the first deposited one on
the albedo, at bounce 3 over the period n (``continuation_period``); and, once, that of the time gate where a path can
only bring light after the time window.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.second_bounce import deposit_second_bounce
from nlosrender.engine.launch.sequences import SystematicSequence, first_coordinate, recurrence_steps
from nlosrender.engine.launch.surface_sampler import SurfaceSample
from nlosrender.engine.launch.time_gate import time_gate_roulette
from nlosrender.engine.path.laser_connections import (
    PathVertex,
    connect_by_mirrors,
    connect_to_lasers,
    deposit_spot,
    disk_point,
)
from nlosrender.engine.path.settings import PathParams, PathSettings
from nlosrender.engine.path.vertex_steps import (
    Departure,
    DirectionNumbers,
    arrive,
    is_imaged,
    leave,
    misses_hidden,
    turns_away,
    unit_interval,
)


@dataclass(eq=False)
class PathStarts:
    """Paths that a lane has begun, and where its low-discrepancy sequence is; not frozen, for it is state of a loop."""

    count: mi.UInt32
    position: mi.UInt64  # first coordinate, see ``SystematicSequence``
    seq_v: mi.UInt32  # second coordinate
    seq_t: mi.UInt32  # third: chooses the technique

    def begin(
        self, stride: mi.UInt64, steps: tuple[int, ...], active: mi.Bool | bool = True
    ) -> tuple[PathStarts, DirectionNumbers, mi.Float]:
        """Begin a path on the lanes ``active``: the one place that does.

        Returns
        -------
        tuple
            The advanced state; what the first direction is sampled with; the number that chooses its technique.
        """
        numbers = DirectionNumbers(first_coordinate(self.position), unit_interval(self.seq_v))
        advanced = PathStarts(
            dr.select(active, self.count + 1, self.count),
            dr.select(active, self.position + stride, self.position),
            dr.select(active, self.seq_v + steps[0], self.seq_v),
            dr.select(active, self.seq_t + steps[1], self.seq_t),
        )
        return advanced, numbers, unit_interval(self.seq_t)


@dr.syntax
def trace_paths(
    settings: PathSettings,
    params: PathParams,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    systematic: SystematicSequence,
    n_samples: mi.UInt32,
) -> tuple[LaneRandomness, SystematicSequence]:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; return the advanced random state.

    Throughput is in units of radiance per (engine unit)^-2; the caller scales by energy and unit.
    """
    built, sampler = params.built, params.sampler
    q = settings.p_hidden_sampling
    steps = recurrence_steps(2) if 0 < q < 1 else (*recurrence_steps(1), 1)
    stride = systematic.stride
    time_gate = params.time_gate if settings.has_time_gate else None

    # ---- State ------------------------------------------------------------------------------------------------------
    generator = mi.PCG32(randomness.generator)
    seq_v, seq_t = (mi.UInt32(start) for start in randomness.sequence[1:])
    starts = PathStarts(mi.UInt32(0), mi.UInt64(systematic.position), seq_v, seq_t)
    alive = mi.Bool(False)  # a ray is under way
    way = Departure.none(built)  # that ray
    bounce = mi.UInt32(FIRST_BOUNCE)  # bounce index that a laser connection at the last vertex has
    throughput = mi.Spectrum(0)  # of the path up to the last vertex
    opl = mi.Float(0)  # optical path length from the sensor point [engine units]
    medium = mi.Float(1)  # refractive index along the ray
    is_past_gate = mi.Bool(False)  # the path can only bring light after the window, and has survived that roulette
    is_specular = mi.Bool(False)  # a delta lobe is on the path
    sensor_delay = mi.Float(params.sensors.delay_fraction)  # of the place in the footprint that the path started from

    # excluded: arrays that the loop reads but does not change
    while dr.hint(
        alive | (starts.count < n_samples),
        exclude=[settings, params, histogram, built, sampler, time_gate, n_samples, stride],
    ):
        placed = params.delayed(sensor_delay)
        # ---- Intersect ----------------------------------------------------------------------------------------------
        there = arrive(settings, params, way, alive)
        opl += medium * there.distance
        hit = mi.Bool(there.is_reached)
        if dr.hint(settings.finds_spot, mode="scalar"):
            deposit_spot(settings, placed, histogram, there, way, bounce, opl, throughput)
        throughput = dr.select(hit, throughput * way.value / there.density, 0)
        bounce += 1
        hit &= dr.any(mi.unpolarized_spectrum(throughput) != 0)
        hit, is_past_gate, throughput = time_gate_roulette(
            time_gate, generator, hit, is_past_gate, opl, there.si.p, there.on_wall, throughput
        )

        # ---- Connect to the lasers and deposit ----------------------------------------------------------------------
        if dr.hint(settings.laser_sampling, mode="scalar"):
            lit_vertex = PathVertex(there.si, way.origin, there.leg, opl, throughput, bounce)
            is_deposited = hit & settings.is_deposited(bounce)
            if dr.hint(settings.only_specular, mode="scalar"):
                is_deposited &= is_specular
            connect_to_lasers(settings, placed, histogram, generator, lit_vertex, is_deposited)
            connect_by_mirrors(settings, placed, histogram, generator, lit_vertex, hit)

        # ---- Continue, or start the next path -----------------------------------------------------------------------
        go_on = hit & settings.may_go_on(bounce)
        start = ~go_on & (starts.count < n_samples)
        alive = go_on | start
        placed = params.in_footprint(starts.seq_v, start)
        starts, numbers, t = starts.begin(stride, steps, start)
        sensor = placed.sensors.interaction
        if dr.hint(params.footprint is not None, mode="scalar"):
            sensor_delay = dr.select(start, placed.sensors.delay_fraction, sensor_delay)
        if dr.hint(settings.samples_second_bounce, mode="scalar"):
            deposit_second_bounce(placed, histogram, start)
        vertex = dr.select(start, sensor, there.si) if settings.goes_on else sensor
        throughput = dr.select(start, _at_sensor(sensor), throughput)
        opl, medium = dr.select(start, 0, opl), dr.select(start, 1, medium)
        bounce = dr.select(start, mi.UInt32(FIRST_BOUNCE), bounce)
        is_past_gate &= ~start
        is_specular &= ~start
        on_wall = built.is_wall(vertex.shape)

        # ---- Sample the next direction ------------------------------------------------------------------------------
        if dr.hint(settings.goes_on, mode="scalar"):
            further = DirectionNumbers.drawn(generator, go_on)
            numbers = dr.select(start, numbers, further)
            t = dr.select(start, t, unit_interval(generator.next_uint32(go_on)))
        if dr.hint(settings.mirrors_spot, mode="scalar"):
            at_sensor = PathVertex(
                sensor, sensor.p, mi.Vector3f(0), mi.Float(0), mi.Spectrum(1), mi.UInt32(FIRST_BOUNCE)
            )
            in_spot = settings.spot_radius * disk_point(mi.Point2f(unit_interval(numbers.bits_u), numbers.v))
            connect_by_mirrors(settings, placed, histogram, generator, at_sensor, start, in_spot)
        has_target = alive & on_wall & (t < q)
        by_bsdf = alive & ~has_target
        sample = None
        if dr.hint(q > 0, mode="scalar"):
            sample = sampler.sample(numbers.bits_u, numbers.v, has_target)
            dark = has_target & turns_away(params, sample, vertex.p)
            # with a footprint, places that see more dark points would start more paths: a bias
            may_skip = q == 1 and sampler.dark_behind and not settings.mirrors_spot and params.footprint is None
            if dr.hint(may_skip, mode="scalar"):
                starts, sample, dark = _begin_until_lit(
                    params, starts, stride, steps, n_samples, vertex.p, start, sample, dark
                )
            alive &= ~dark
            has_target &= ~dark
        before = way
        way, survival, eta = leave(
            settings, params, generator, vertex, on_wall, numbers, sample, by_bsdf, has_target, is_specular
        )
        if dr.hint(settings.mirrors_spot, mode="scalar"):
            way.is_imaged = is_imaged(params, vertex, before, way, by_bsdf & ~start)
        if dr.hint(params.hidden_aabb is not None, mode="scalar"):
            misses = start & by_bsdf & misses_hidden(params, way.ray)
            generator, starts, way, survival, eta, misses = _begin_until_near(
                settings, params, generator, starts, stride, steps, n_samples, on_wall, way, survival, eta, misses
            )
            alive &= ~misses
        medium *= eta
        if dr.hint(settings.only_specular, mode="scalar"):
            is_specular |= way.is_delta

        # ---- Stop ---------------------------------------------------------------------------------------------------
        if dr.hint(settings.goes_on and settings.russian_roulette, mode="scalar"):
            survival = _survival(settings, params, survival, start, bounce)
            alive &= generator.next_float32(alive & ~start) < survival
            way.value /= dr.maximum(survival, 1e-9)
        alive &= dr.any(mi.unpolarized_spectrum(way.value) != 0)

    advanced = replace(randomness, generator=generator, sequence=[randomness.sequence[0], starts.seq_v, starts.seq_t])
    return advanced, SystematicSequence(starts.position, stride)


@dr.syntax
def _begin_until_lit(
    params: PathParams,
    starts: PathStarts,
    stride: mi.UInt64,
    steps: tuple[int, ...],
    n_samples: mi.UInt32,
    origin: mi.Point3f,
    start: mi.Bool,
    sample: SurfaceSample,
    dark: mi.Bool,
) -> tuple[PathStarts, SurfaceSample, mi.Bool]:
    """Begin further paths on lanes whose first sampled point faces away, until one does not; they take no rays."""
    while dr.hint(dark & start & (starts.count < n_samples), exclude=[params, stride, n_samples, origin, start]):
        starts, numbers, _ = starts.begin(stride, steps)
        sample = params.sampler.sample(numbers.bits_u, numbers.v, dark)
        dark = turns_away(params, sample, origin)
    return starts, sample, dark


@dr.syntax
def _begin_until_near(
    settings: PathSettings,
    params: PathParams,
    generator: mi.PCG32,
    starts: PathStarts,
    stride: mi.UInt64,
    steps: tuple[int, ...],
    n_samples: mi.UInt32,
    on_wall: mi.Bool,
    way: Departure,
    survival: mi.Float,
    eta: mi.Float,
    misses: mi.Bool,
) -> tuple[mi.PCG32, PathStarts, Departure, mi.Float, mi.Float, mi.Bool]:
    """Begin further paths, at most ``max_tries``, on lanes whose first ray misses the box of the hidden geometry.

    In front of a planar wall all surfaces lie in the box, so those paths end without a ray being traced.
    """
    sensor, nowhere, tries = params.sensors.interaction, mi.Bool(False), mi.UInt32(0)
    while dr.hint(
        misses & (starts.count < n_samples) & (tries < settings.max_tries),
        exclude=[settings, params, stride, n_samples, sensor, nowhere, on_wall],
    ):
        starts, numbers, _ = starts.begin(stride, steps)
        tries += 1
        way, survival, eta = leave(
            settings, params, generator, sensor, on_wall, numbers, None, misses, nowhere, nowhere
        )
        misses &= misses_hidden(params, way.ray)
    return generator, starts, way, survival, eta, misses


def _survival(
    settings: PathSettings, params: PathParams, albedo: mi.Float, start: mi.Bool, bounce: mi.UInt32
) -> mi.Float:
    """Return the survival probability of Russian roulette after the connections of a vertex:

        1                               at a sensor point (``start``) and where bounce < ``first_bounce``
        albedo / continuation_period    at bounce 3, where that is ``first_bounce``
        albedo                          at every other bounce

    ``albedo`` is the largest component of the BSDF sample's weight, at most ``MAX_SURVIVAL``; 1 towards a target.
    """
    survival = albedo
    if settings.first_bounce == THIRD_BOUNCE:
        survival *= dr.select(bounce == THIRD_BOUNCE, 1.0 / mi.Float(params.continuation_period), 1)
    return dr.select(start | (bounce < settings.first_bounce), 1, survival)


def _at_sensor(point: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return the throughput paths start with: polarised, the turn from the implicit Stokes frame to the sensor's.

    The reference direction is the sensor's horizontal: across the ray from the sensor and the wall's y axis.
    """
    if not mi.is_polarized:
        return mi.Spectrum(1)
    out = point.to_world(point.wi)
    horizontal = dr.normalize(dr.cross(-out, mi.Vector3f(0, 1, 0)))
    return mi.Spectrum(mi.mueller.rotate_stokes_basis_m(out, mi.mueller.stokes_basis(out), horizontal))
