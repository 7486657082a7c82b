"""How long a render will take: a pilot of the engine on part of the capture, extrapolated.

The path engine's error falls as 1 / sqrt(paths), and cost is linear in them; what the virtual lights need for a target
error they find out themselves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from nlosrender.capture.bounces import FIRST_BOUNCE, LINE_OF_SIGHT, THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch, Plan, Tile
from nlosrender.engine.engines import Engine, SamplingEngine
from nlosrender.engine.histogram import Histogram, relative_l2_error
from nlosrender.engine.memory import n_pairs
from nlosrender.engine.sampling import DEFAULT_TARGET, FIRST_SAMPLES, Budget
from nlosrender.engine.skipped import makes_walks, traces_paths
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
from nlosrender.engine.virtual_lights.third_bounce import FIRST_COARSENESS, REFINEMENT

PILOT_SECONDS = 0.5
PILOT_BYTES = 128e6  # of histograms: a forecast must not take the memory of the render
PILOT_DEPOSITS = 5e8  # of the gather, patches times bins they cover: a fraction of a second
MOST_PILOTS = 20.0  # pilots' worth of deposits for one sensor point above which no pilot is run
LAUNCH_OVERHEAD = 0.01  # s per batch at most that does not grow with the batch
SECOND_LOOK = 1.1  # the engines look at the error now and then only, and overshoot by so much


@dataclass(frozen=True)
class TimeEstimate:
    """Seconds a render will take."""

    seconds: float | None  # None: the pilot saw too little light to tell
    basis: str  # what was measured and how it was extrapolated
    lit_shares: tuple[float | None, ...] | None = None  # per bounce slot: bins with light in the pilot; None: no pilot


def estimate_render_time(engine: Engine, plan: Plan, budget: Budget, lanes: int) -> TimeEstimate:
    """Run a pilot of about ``PILOT_SECONDS`` per technique and extrapolate it to the whole capture.

    Parameters
    ----------
    engine
        As set up for the capture.
    plan
        Its batches.
    budget
        When the render will stop.
    lanes
        Lanes that keep the backend busy.

    Returns
    -------
    TimeEstimate
        Rendering alone: no start, no compilation, no writing.
    """
    limit = budget.time_limit_s
    goes_on = traces_paths(engine) or makes_walks(engine)  # as long as there is time
    if limit is not None and budget.spp is None and budget.target_error is None and goes_on:
        return TimeEstimate(limit, "render.time_limit_s")
    pilot = pilot_batch(engine, plan)
    if isinstance(engine, VirtualLightEngine) and _deposits_per_sensor(engine, pilot) > MOST_PILOTS * PILOT_DEPOSITS:
        return TimeEstimate(limit, "no pilot: the bins are so fine that the gather of one sensor point takes too long")
    seconds, known_squares, lit_shares = 0.0, 0.0, None
    parts = []
    paths = engine.paths if isinstance(engine, VirtualLightEngine) else engine
    if isinstance(engine, VirtualLightEngine):
        gather, known_squares = _light_seconds(engine, plan, pilot, budget)
        seconds += gather
        parts.append("patches and walks settled")
    if traces_paths(engine):
        traced, rays = _path_seconds(paths, plan, pilot, budget, lanes, known_squares)
        lit_shares = _lit_shares(rays, engine.options.bounces)
        parts.append("error ~ 1 / sqrt(paths)" if budget.spp is None else "time ~ paths")
        seconds = math.inf if traced is None else seconds + traced
    points = "pixels" if engine.capture.scan_type == LINE_OF_SIGHT else "sensor points"
    basis = f"pilot of {pilot.sensors.size} of {engine.capture.n_sensors} {points}, {' and '.join(parts)}"
    if limit is not None and seconds >= limit:
        return TimeEstimate(limit, f"render.time_limit_s; {basis}", lit_shares)
    if math.isinf(seconds):
        return TimeEstimate(None, f"{basis}: nothing but noise so far", lit_shares)
    return TimeEstimate(seconds, basis if parts else "nothing to compute", lit_shares)


def pilot_batch(engine: Engine, plan: Plan) -> Batch:
    """Return the middle of the plan's middle batch: as many sensor points as a pilot can take, then as many lasers."""
    batch = plan.batches[len(plan.batches) // 2]
    most = PILOT_BYTES / (plan.bytes_per_batch / max(b.sensors.size for b in plan.batches))
    if isinstance(engine, VirtualLightEngine):
        most = min(most, PILOT_DEPOSITS / _deposits_per_sensor(engine, batch))
    sensors = _middle(batch.sensors, max(1, int(most)))
    if engine.capture.scan_type == "confocal":
        return Batch(sensors, sensors)
    return Batch(
        sensors, _middle(batch.lasers, max(1, int(most * batch.lasers.size)) if most < 1 else batch.lasers.size)
    )


def _deposits_per_sensor(engine: VirtualLightEngine, batch: Batch) -> float:
    """Return a bound on the deposits for one sensor point at the first two resolutions.

    The size of a patch at distance d is 2 sqrt(d w) with w the bin width, so that it covers 2 sqrt(d / w) bins.
    """
    patches = engine.tessellator.count(FIRST_COARSENESS) * (1 + REFINEMENT)
    farthest = float(engine.built.hidden_bounds[1][2]) if engine.built.hidden_bounds is not None else 0.0
    bins = 1 + 2 * math.sqrt(max(farthest, 0.0) / engine.time_axis.bin_width_opl)
    lasers = batch.lasers.size if engine.capture.scan_type == "exhaustive" else 1
    return max(1.0, patches * bins * lasers)


def _middle(tile: Tile, most: int) -> Tile:
    """Return a part of ``tile`` with at most ``most`` points, about its centre."""
    rows, columns = tile.shape
    columns = min(columns, max(1, most // rows, math.isqrt(most)))
    rows = min(rows, max(1, most // columns))
    y0, x0 = tile.y0 + (tile.shape[0] - rows) // 2, tile.x0 + (tile.shape[1] - columns) // 2
    return Tile(y0, y0 + rows, x0, x0 + columns)


def _path_seconds(
    paths: SamplingEngine, plan: Plan, pilot: Batch, budget: Budget, lanes: int, known_squares: float
) -> tuple[float | None, Histogram]:
    """Return the seconds of path tracing, None when the pilot is nothing but noise, and what the pilot saw."""
    paths.render(pilot, Budget(spp=1))  # compiles
    begun = time.perf_counter()
    first = paths.render(pilot, Budget(spp=1))
    overhead = time.perf_counter() - begun
    second = paths.render(pilot, Budget(time_limit_s=PILOT_SECONDS))
    seconds = time.perf_counter() - begun - overhead
    per_path = max(seconds - overhead, 1e-6) / max(second.samples - first.samples, 1) / pilot.sensors.size
    if budget.spp is not None:
        needed = float(math.ceil(budget.spp / plan.replicas) * plan.replicas)
    else:
        error = _error(second, known_squares * paths.scale**2)
        if math.isinf(error):
            return None, second
        needed = second.samples * (error / (budget.target_error or DEFAULT_TARGET)) ** 2 * SECOND_LOOK
        needed = max(needed, FIRST_SAMPLES * plan.replicas)
    largest = max(batch.sensors.size for batch in plan.batches)
    # A pilot of a few sensor points leaves processors idle that the render will use; a quarter of the lanes fills
    # their vector units, the rest only evens out the load.
    idle = min(1.0, pilot.sensors.size / min(largest, max(1.0, lanes / 4 / plan.replicas)))
    points = _sensor_visits(paths.capture, plan, pilot)
    growing = max(overhead - LAUNCH_OVERHEAD, 0.0) * _all_pairs(paths.capture, plan) / n_pairs(paths.capture, pilot)
    fixed = min(overhead, LAUNCH_OVERHEAD) * len(plan.batches)
    return needed * points * per_path * idle + growing + fixed, second


def _sensor_visits(capture: Capture, plan: Plan, pilot: Batch) -> float:
    """Return the sensor points of all batches, as many times as each has more lasers than the pilot.

    The cost of a path or patch is taken as linear in the lasers it is connected to: with few of them it is less.
    """
    lasers = pilot.lasers.size if capture.scan_type == "exhaustive" else 1
    return _all_pairs(capture, plan) / lasers


def _lit_shares(pilot: Histogram, bounces: BounceAxis) -> tuple[float | None, ...] | None:
    """Return the share of bins with light per bounce slot; the third bounce's is known better from geometry."""
    if not bounces.split:
        return None
    if bounces.first != FIRST_BOUNCE:
        return tuple(float((pilot.mean[:, slot] > 0).mean()) for slot in range(bounces.n_slots))
    shares = [float((pilot.mean[:, slot] > 0).mean()) for slot in range(bounces.n_slots)]
    third = bounces.slot(THIRD_BOUNCE)
    return tuple(None if slot == third else share for slot, share in enumerate(shares))


def _light_seconds(engine: VirtualLightEngine, plan: Plan, pilot: Batch, budget: Budget) -> tuple[float, float]:
    """Return the seconds of settling, the gather and the walks, and the pilot's sum of squares of the third bounce."""
    begun = time.perf_counter()
    settled = engine.settle_lights(budget)
    settling = time.perf_counter() - begun
    part = _middle(pilot.sensors, max(1, pilot.sensors.size // 4))
    quarter = Batch(part, part if engine.capture.scan_type == "confocal" else pilot.lasers)
    fineness = settled.fineness or FIRST_COARSENESS
    third = engine.third.gather(pilot, fineness)
    if traces_paths(engine):
        seconds = _extrapolated(engine, plan, pilot, quarter, lambda batch: engine.third.pair(batch, fineness))
    else:  # all that a render does, with one round of walks; the other rounds add up
        once = replace(settled, rounds=1, target_error=None, time_limit_s=None)
        engine.render(quarter, once)  # compiles
        seconds = _extrapolated(engine, plan, pilot, quarter, lambda batch: engine.render(batch, once))
    further, rounds = engine.further, settled.rounds or 0
    if further is not None and rounds > 1:

        def walk(batch: Batch) -> None:
            further.accumulate(batch, further.histogram(batch, plan.replicas), 0)
            dr.sync_thread()

        seconds += (rounds - 1) * _extrapolated(engine, plan, pilot, quarter, walk)
    return settling + seconds, third.squares


def _extrapolated(
    engine: VirtualLightEngine, plan: Plan, pilot: Batch, quarter: Batch, work: Callable[[Batch], object]
) -> float:
    """Return the seconds of ``work`` for the whole plan: what every batch pays, and what every sensor point adds."""
    seconds, of_quarter = _timed(work, pilot), _timed(work, quarter)
    more = pilot.sensors.size - quarter.sensors.size
    per_point = max(seconds - of_quarter, 0.0) / more if more else seconds / pilot.sensors.size
    per_batch = max(seconds - per_point * pilot.sensors.size, 0.0)
    return per_batch * len(plan.batches) + per_point * _sensor_visits(engine.capture, plan, pilot)


def _timed(work: Callable[[Batch], object], batch: Batch) -> float:
    begun = time.perf_counter()
    work(batch)
    return time.perf_counter() - begun


def _error(histogram: Histogram, known_squares: float = 0.0) -> float:
    return relative_l2_error(float(histogram.variance.sum()), float((histogram.mean**2).sum()) + known_squares)


def _all_pairs(capture: Capture, plan: Plan) -> int:
    return sum(n_pairs(capture, batch) for batch in plan.batches)
