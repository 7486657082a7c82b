"""The third bounce alone, by hidden geometry sampling alone: all vertices are known, only visibility is asked.

What ``trace_paths`` finds as the nearest hit of a ray is known beforehand: the sampled point lies on a known triangle.
Both legs are any-hit queries, and only points that face sensor and laser point take them. Every lane traces one path
per iteration, so that the lanes of a packet stay at neighbouring points of the hidden geometry (``strata``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.engine.connections import connect_to_lasers, connection_segment
from nlosrender.engine.histogram import DeviceHistogram
from nlosrender.engine.low_discrepancy import recurrence_steps
from nlosrender.engine.strata import Strata, first_coordinate
from nlosrender.engine.surface_sampler import SurfaceSample, SurfaceSampler
from nlosrender.engine.transport import LaneRandomness, PathSettings, Transport


def are_direct(settings: PathSettings, sampler: SurfaceSampler) -> bool:
    """Return whether all paths of these settings are of the kind traced here."""
    only_hidden = settings.hidden_fraction == 1 and settings.laser_sampling and not settings.finds_spot
    return only_hidden and not settings.goes_on and not sampler.has_analytic and not mi.is_polarized


@dr.syntax
def trace_direct_paths(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    randomness: LaneRandomness,
    strata: Strata,
    n_samples: mi.UInt32,
) -> tuple[LaneRandomness, Strata]:
    """Trace ``n_samples`` more paths per lane and deposit what they carry; as ``trace_paths``."""
    sampler, sensors, stride = transport.sampler, transport.sensors, strata.stride
    sensor = sensors.interaction
    lane = dr.arange(mi.UInt32, dr.width(sensors.delay_bins))
    own_laser = transport.lasers.gather(transport.first_laser).interaction.p
    (step,) = recurrence_steps(1)

    # ---- State -------------------------------------------------------------------------------------------------
    at = mi.UInt64(strata.at)
    seq_v = mi.UInt32(randomness.sequence[1])
    done = mi.UInt32(0)  # paths of this lane

    while dr.hint(done < n_samples, exclude=[settings, transport, histogram, sampler, sensors, sensor, own_laser]):
        # ---- Sample a point of the hidden geometry -------------------------------------------------------------
        sample = sampler.sample(first_coordinate(at), mi.Float(seq_v >> 8) * 2.0**-24, mi.Bool(True))
        leg = sample.p - sensor.p
        active = mi.Bool(True)
        if dr.hint(sampler.dark_behind, mode="scalar"):
            active = dr.dot(sample.n, leg) < 0
            if dr.hint(transport.lasers_per_lane == 1, mode="scalar"):
                active &= dr.dot(sample.n, own_laser - sample.p) > 0
        _connect_sample(settings, transport, histogram, lane, sample, leg, active)

        # ---- Next path -----------------------------------------------------------------------------------------
        at += stride
        seq_v += step
        done += 1

    return LaneRandomness(randomness.generator, [randomness.sequence[0], seq_v, randomness.sequence[2]]), Strata(
        at, stride
    )


@dr.syntax
def _connect_sample(
    settings: PathSettings,
    transport: Transport,
    histogram: DeviceHistogram,
    lane: mi.UInt32,
    sample: SurfaceSample,
    leg: mi.Vector3f,
    active: mi.Bool,
) -> None:
    """Connect a sampled point to its sensor point, ``leg`` away, and to the lasers; packets in the dark pass by."""
    if dr.hint(active, exclude=[settings, transport, histogram, lane, sample, leg]):
        built, sampler, sensor = transport.built, transport.sampler, transport.sensors.interaction
        distance = dr.norm(leg)
        direction = leg / distance
        received = built.wall_bsdf.eval(mi.BSDFContext(), sensor, sensor.to_local(direction), active)
        si = sampler.surface(sample, direction, active)
        throughput = received * (dr.abs(dr.dot(si.n, direction)) * sampler.area / dr.square(distance))
        lit = active & dr.any(throughput > 0)
        if dr.hint(settings.needs_visibility, mode="scalar"):
            segment = connection_segment(built, si, -direction, sensor)
            lit &= ~built.scene.ray_test(segment, coherent=False, active=lit)
        bounce = mi.UInt32(THIRD_BOUNCE)
        no_spot = mi.PCG32()
        connect_to_lasers(
            settings, transport, histogram, no_spot, lane, si, lit, bounce, distance, throughput, sensor.p, leg
        )
