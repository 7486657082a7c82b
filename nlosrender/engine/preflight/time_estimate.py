"""How long a render will take: what the engine settles for the target error, and the speed on part of the capture.

Engines find out themselves what a target error takes, by a pilot of the capture's points that ends here after some
seconds: beyond it the error is taken to fall on as it has. Cost is linear in paths, patches and rounds of walks.
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
from nlosrender.engine.launch.histogram import Histogram
from nlosrender.engine.launch.passes import Passes, SavedStages
from nlosrender.engine.launch.sample_schedule import Budget
from nlosrender.engine.preflight.batch_memory import n_pairs
from nlosrender.engine.preflight.omitted_work import traces_paths, traces_vpls
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
from nlosrender.engine.virtual_lights.third_bounce import COARSEST_SCALE, REFINEMENT

PILOT_SECONDS = 1.0
CALIBRATION_SECONDS = 5.0  # of the pilot that says how many paths a target error takes
PILOT_BYTES = 512e6  # of histograms: a forecast must not take the memory of the render
PILOT_DEPOSITS = 5e8  # of the gather, patches times bins they cover: a fraction of a second
MOST_PILOTS = 20.0  # pilots' worth of deposits for one sensor point above which no pilot is run
LAUNCH_OVERHEAD = 0.01  # s per batch at most that does not grow with the batch


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
        Rendering alone, and what it takes to settle the target error: no start, no compilation, no writing.
    """
    limit = budget.time_limit_s
    goes_on = traces_paths(engine) or traces_vpls(engine)  # as long as there is time
    if limit is not None and budget.spp is None and budget.target_error is None and goes_on:
        return TimeEstimate(limit, "render.time_limit_s")
    pilot = pilot_batch(engine, plan)
    if isinstance(engine, VirtualLightEngine) and _deposits_per_sensor(engine, pilot) > MOST_PILOTS * PILOT_DEPOSITS:
        return TimeEstimate(limit, "no pilot: the bins are so fine that the gather of one sensor point takes too long")
    begun = time.perf_counter()
    free = budget if isinstance(engine, VirtualLightEngine) else replace(budget, time_limit_s=None)
    calibrated = engine.calibrate(free, seconds=CALIBRATION_SECONDS)
    seconds, lit_shares = time.perf_counter() - begun, None
    parts = []
    paths = engine.paths if isinstance(engine, VirtualLightEngine) else engine
    if isinstance(engine, VirtualLightEngine):
        seconds += _light_seconds(engine, plan, pilot, calibrated)
        parts.append("patches and walks settled")
    if traces_paths(engine):
        traced, rays = _path_seconds(paths, plan, pilot, calibrated, lanes)
        lit_shares = _lit_shares(rays, engine.options.bounces)
        cut_short = budget.spp is None and seconds > CALIBRATION_SECONDS
        parts.append("error extrapolated" if cut_short else "time ~ paths")
        seconds += math.inf if traced is None else traced
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
    patches = engine.tessellator.count(COARSEST_SCALE) * (1 + REFINEMENT)
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
    paths: SamplingEngine, plan: Plan, pilot: Batch, calibrated: Budget, lanes: int
) -> tuple[float | None, Histogram]:
    """Return the seconds of path tracing, None when the settled paths are not known, and what the pilot saw."""
    paths.render(pilot, Budget(spp=1))  # compiles
    begun = time.perf_counter()
    first = paths.render(pilot, Budget(spp=1))
    overhead = time.perf_counter() - begun
    launches = _Launches()
    second = paths.render(pilot, Budget(time_limit_s=PILOT_SECONDS), Passes(look=launches))
    seconds = time.perf_counter() - begun - overhead
    per_path = max(seconds - overhead, 1e-6) / max(second.samples - first.samples, 1) / pilot.sensors.size
    if launches.seconds_per_sample is not None:
        per_path = launches.seconds_per_sample / plan.replicas / pilot.sensors.size
    if calibrated.spp is None:
        return None, second
    needed = float(math.ceil(calibrated.spp / plan.replicas) * plan.replicas)
    largest = max(batch.sensors.size for batch in plan.batches)
    # A pilot of a few sensor points leaves processors idle that the render will use; a quarter of the lanes fills
    # their vector units, the rest only evens out the load.
    idle = min(1.0, pilot.sensors.size / min(largest, max(1.0, lanes / 4 / plan.replicas)))
    points = _sensor_visits(paths.capture, plan, pilot)
    growing = max(overhead - LAUNCH_OVERHEAD, 0.0) * _all_pairs(paths.capture, plan) / n_pairs(paths.capture, pilot)
    fixed = min(overhead, LAUNCH_OVERHEAD) * len(plan.batches)
    return needed * points * per_path * idle + growing + fixed, second


class _Launches:
    """Times the launches of a pilot; the first ones, of few paths, take longer for a path than those of a render."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, int]] = []  # when, and samples per lane so far

    def __call__(self, take: Callable[[], SavedStages]) -> None:
        (snapshot,) = take().values()
        self._marks.append((time.perf_counter(), snapshot.numbers["done"]))

    @property
    def seconds_per_sample(self) -> float | None:
        """Of a lane, in the second half of the samples; None: there were too few launches."""
        if len(self._marks) < 4:
            return None
        end, last = self._marks[-1]
        begin, first = next(mark for mark in self._marks if mark[1] >= last / 3 or mark is self._marks[-2])
        return (end - begin) / max(last - first, 1)


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


def _light_seconds(engine: VirtualLightEngine, plan: Plan, pilot: Batch, calibrated: Budget) -> float:
    """Return the seconds of the gather and the walks."""
    part = _middle(pilot.sensors, max(1, pilot.sensors.size // 4))
    quarter = Batch(part, part if engine.capture.scan_type == "confocal" else pilot.lasers)
    patch_scale = calibrated.patch_scale or COARSEST_SCALE
    engine.third.gather(pilot, patch_scale)  # compiles
    if traces_paths(engine):
        seconds = _extrapolated(engine, plan, pilot, quarter, lambda batch: engine.third.pair(batch, patch_scale))
    else:  # all that a render does, with one round of walks; the other rounds add up
        once = replace(calibrated, rounds=1, target_error=None, time_limit_s=None)
        engine.render(quarter, once)  # compiles
        seconds = _extrapolated(engine, plan, pilot, quarter, lambda batch: engine.render(batch, once))
    further, rounds = engine.further, calibrated.rounds or 0
    if further is not None and rounds > 1:

        def subpath(batch: Batch) -> None:
            further.accumulate(batch, further.histogram(batch, plan.replicas), 0)
            dr.sync_thread()

        seconds += (rounds - 1) * _extrapolated(engine, plan, pilot, quarter, subpath)
    return seconds


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


def _all_pairs(capture: Capture, plan: Plan) -> int:
    return sum(n_pairs(capture, batch) for batch in plan.batches)
