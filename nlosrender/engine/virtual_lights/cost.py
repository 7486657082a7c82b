"""What a render by virtual lights costs in memory and time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr

from nlosrender.capture.plan import BYTES_PER_SUM, Batch, Plan
from nlosrender.engine.interface import Budget, PilotSeconds, TimeEstimate
from nlosrender.engine.launch.accumulation import refuse_many_sums
from nlosrender.engine.launch.cost_pilot import (
    estimate_of,
    middle_of,
    pilot_basis,
    pilot_batch,
    sampling_basis,
    sampling_cost,
    seconds_of,
    sensor_visits,
)
from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram
from nlosrender.errors import ConfigError
from nlosrender.readable import readable_size

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.engine import VirtualLightEngine

PATCH_BYTES = 500  # float64 on the host while patches are cut and joined, and float32 on the device
PILOT_DEPOSITS = 5e8  # of the gather, patches times bins they cover: chosen for a fraction of a second
MAX_PILOTS = 20.0  # pilots' worth of deposits for one sensor point above which no pilot is run: chosen for about 10 s


def gather_batch_bytes(engine: VirtualLightEngine, plan: Plan, available: float) -> int:
    """Return the memory of the largest batch, rows for the lanes of the gather included; see ``Engine.batch_bytes``."""
    gathered = max(BlockHistogram.entries(engine.third.shape(batch)) for batch in plan.batches)
    refuse_many_sums(gathered)
    needed = engine.tessellator.count(engine.third.tuning.coarsest_scale) * engine.third.tuning.refinement
    if needed * PATCH_BYTES > available:
        raise ConfigError.at(
            "time_axis.bin_width_opl",
            f"bins of {engine.time_axis.bin_width_opl:.3g} m need {needed:.1e} patches of the hidden geometry, "
            f"{readable_size(needed * PATCH_BYTES)}, but render.memory_limit leaves {readable_size(available)}. "
            "Use wider bins, or render.engine: path.",
        )
    ways = 1 if engine.third.mirror is None else 3  # bounces that are gathered
    return max(engine.paths.batch_bytes(plan), ways * gathered * BYTES_PER_SUM)


def virtual_light_estimate(
    engine: VirtualLightEngine, plan: Plan, budget: Budget, lanes: int, seconds: PilotSeconds
) -> TimeEstimate:
    """Return the estimate of a render; see ``Engine.cost_estimate``."""
    if budget.lasts_until_its_time_limit and engine.has_further_bounces:
        return TimeEstimate(budget.time_limit_s, "render.time_limit_s")
    per_sensor = _deposits_per_sensor(engine, plan)
    if per_sensor > MAX_PILOTS * PILOT_DEPOSITS:
        return TimeEstimate(None, "no pilot: the bins are so fine that the gather of one sensor point takes too long")
    pilot = pilot_batch(engine.capture, plan, PILOT_DEPOSITS / per_sensor)
    begun = time.perf_counter()
    calibrated = engine.calibrate(budget, seconds.calibration)
    calibration = time.perf_counter() - begun
    total, lit_shares, parts = calibration + _light_seconds(engine, plan, pilot, calibrated), None, []
    parts.append("patch scale and VPL rounds calibrated")
    if engine.traces_paths:
        traced, lit_shares = sampling_cost(engine.paths, plan, calibrated, pilot, lanes, seconds.tracing)
        total += traced
        parts.append(sampling_basis(budget, total > seconds.calibration))
    return estimate_of(total, pilot_basis(engine.capture, pilot, parts), lit_shares)


def _deposits_per_sensor(engine: VirtualLightEngine, plan: Plan) -> float:
    """Return a bound on the deposits for one sensor point at the first two resolutions.

    The size of a patch at distance d is 2 sqrt(d w) with w the bin width, so that it covers 2 sqrt(d / w) bins.
    """
    patches = engine.tessellator.count(engine.third.tuning.coarsest_scale) * (1 + engine.third.tuning.refinement)
    farthest = float(engine.built.hidden_bounds[1][2]) if engine.built.hidden_bounds is not None else 0.0
    bins = 1 + 2 * math.sqrt(max(farthest, 0.0) / engine.time_axis.bin_width_opl)
    lasers = plan.batches[len(plan.batches) // 2].lasers.size if engine.device.is_exhaustive else 1
    return max(1.0, patches * bins * lasers)


def _light_seconds(engine: VirtualLightEngine, plan: Plan, pilot: Batch, calibrated: Budget) -> float:
    """Return the seconds of the gather and of the VPLs."""
    part = middle_of(pilot.sensors, max(1, pilot.sensors.size // 4))
    quarter = Batch(part, part if engine.capture.scan_type == "confocal" else pilot.lasers)
    scale = calibrated.patch_scale or engine.third.tuning.coarsest_scale

    def extrapolated(work: Callable[[Batch], object]) -> float:
        """Return the seconds of ``work`` for the whole plan: what every batch pays, and what every point adds."""
        of_pilot, of_quarter = seconds_of(work, pilot), seconds_of(work, quarter)
        more = pilot.sensors.size - quarter.sensors.size
        per_point = max(of_pilot - of_quarter, 0.0) / more if more else of_pilot / pilot.sensors.size
        per_batch = max(of_pilot - per_point * pilot.sensors.size, 0.0)
        return per_batch * len(plan.batches) + per_point * sensor_visits(engine.capture, plan, pilot)

    engine.third.gather(pilot, scale)  # compiles
    # all that a render does, with one round of VPLs and a path; the others add up
    spp = 1 if engine.traces_paths else None
    once = replace(calibrated, rounds=1, spp=spp, target_error=None, time_limit_s=None)
    engine.render(quarter, once)  # compiles
    seconds = extrapolated(lambda batch: engine.render(batch, once))
    further, rounds = engine.further, calibrated.rounds or 0
    if further is not None and rounds > 1:

        def one_round(batch: Batch) -> None:
            histogram, steps = further.histogram(batch, plan.replicas), calibrated.bins_per_step or 1
            further.accumulate(batch, histogram, 0, bins_per_step=steps)
            dr.sync_thread()

        seconds += (rounds - 1) * extrapolated(one_round)
    return seconds
