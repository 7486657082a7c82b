"""Cost pilots: short renders of a part of a capture, from which engines estimate the seconds of the whole.

Cost is linear in samples, patches and rounds, and in the pairs of laser and sensor points.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

from nlosrender.capture.bounces import FIRST_BOUNCE, LINE_OF_SIGHT, THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch, Plan
from nlosrender.capture.tile import Tile
from nlosrender.engine.interface import Budget, Engine, PilotSeconds, TimeEstimate
from nlosrender.engine.launch.accumulation import refuse_many_sums
from nlosrender.engine.launch.histogram import Histogram, HistogramShape
from nlosrender.engine.launch.passes import Passes, SavedStages

PILOT_BYTES = 512e6  # of histograms: an estimate must not take the memory of the render
# Seconds per batch that do not grow with it, at most. One launch of one path at 2 x 2 sensor points (bench scene plate)
# takes 8 ms of wall time and 3 ms of CPU time, the least of 40 runs on 2 busy cores; the median CPU time is 8 ms.
LAUNCH_OVERHEAD = 0.01


def pilot_batch(capture: Capture, plan: Plan, max_sensors: float = math.inf) -> Batch:
    """Return the middle of the plan's middle batch: as many sensor points as a pilot can take, then as many lasers."""
    batch = plan.batches[len(plan.batches) // 2]
    max_points = min(max_sensors, PILOT_BYTES / (plan.bytes_per_batch / max(b.sensors.size for b in plan.batches)))
    sensors = middle_of(batch.sensors, max(1, int(min(max_points, batch.sensors.size))))
    if capture.scan_type == "confocal":
        return Batch(sensors, sensors)
    lasers = max(1, int(max_points * batch.lasers.size)) if max_points < 1 else batch.lasers.size
    return Batch(sensors, middle_of(batch.lasers, lasers))


def middle_of(tile: Tile, max_points: int) -> Tile:
    """Return a part of ``tile`` with at most ``max_points`` points, about its centre."""
    rows, columns = tile.shape
    columns = min(columns, max(1, max_points // rows, math.isqrt(max_points)))
    rows = min(rows, max(1, max_points // columns))
    y0, x0 = tile.y0 + (tile.shape[0] - rows) // 2, tile.x0 + (tile.shape[1] - columns) // 2
    return Tile(y0, y0 + rows, x0, x0 + columns)


def n_pairs(capture: Capture, batch: Batch) -> int:
    """Return the pairs of laser and sensor points in a batch."""
    return batch.sensors.size * (batch.lasers.size if capture.scan_type == "exhaustive" else 1)


def sensor_visits(capture: Capture, plan: Plan, pilot: Batch) -> float:
    """Return the sensor points of all batches, each weighted by its lasers over those of the pilot.

    Takes the cost of a path or patch as linear in its lasers, which overestimates it with few of them.
    """
    lasers = pilot.lasers.size if capture.scan_type == "exhaustive" else 1
    return sum(n_pairs(capture, batch) for batch in plan.batches) / lasers


def seconds_of(work: Callable[[Batch], object], batch: Batch) -> float:
    """Return the seconds that ``work`` on a batch takes."""
    begun = time.perf_counter()
    work(batch)
    return time.perf_counter() - begun


def sampling_cost(
    engine: Engine, plan: Plan, calibrated: Budget, pilot: Batch, lanes: int, tracing_seconds: float
) -> tuple[float, tuple[float | None, ...] | None]:
    """Return the seconds of an engine that takes samples, inf where ``calibrated`` has no number of them.

    Returns
    -------
    tuple
        The seconds; the share of bins with light per bounce slot, as ``TimeEstimate.lit_shares``.
    """
    capture = engine.capture
    engine.render(pilot, Budget(spp=1))  # compiles
    begun = time.perf_counter()
    first = engine.render(pilot, Budget(spp=1))
    overhead = time.perf_counter() - begun
    launches = _LaunchClock()
    second = engine.render(pilot, Budget(time_limit_s=tracing_seconds), Passes(look=launches))
    seconds = time.perf_counter() - begun - overhead
    lit_shares = _lit_shares(second, engine.options.bounces)
    if calibrated.spp is None:
        return math.inf, lit_shares
    per_sample = max(seconds - overhead, 1e-6) / max(second.samples - first.samples, 1) / pilot.sensors.size
    if launches.seconds_per_sample is not None:
        per_sample = launches.seconds_per_sample / plan.replicas / pilot.sensors.size
    samples = float(math.ceil(calibrated.spp / plan.replicas) * plan.replicas)
    largest = max(batch.sensors.size for batch in plan.batches)
    # A pilot of few sensor points leaves processors idle that the render will use: a quarter of the lanes fills the
    # vector units, the rest evens out the load.
    busy = min(1.0, pilot.sensors.size / min(largest, max(1.0, lanes / 4 / plan.replicas)))
    all_pairs = sum(n_pairs(capture, batch) for batch in plan.batches)
    growing = max(overhead - LAUNCH_OVERHEAD, 0.0) * all_pairs / n_pairs(capture, pilot)
    fixed = min(overhead, LAUNCH_OVERHEAD) * len(plan.batches)
    return samples * sensor_visits(capture, plan, pilot) * per_sample * busy + growing + fixed, lit_shares


def sampling_estimate(engine: Engine, plan: Plan, budget: Budget, lanes: int, seconds: PilotSeconds) -> TimeEstimate:
    """Return the estimate of an engine that takes samples and nothing else; parameters as ``Engine.cost_estimate``."""
    if budget.lasts_until_its_time_limit:
        return TimeEstimate(budget.time_limit_s, "render.time_limit_s")
    pilot = pilot_batch(engine.capture, plan)
    begun = time.perf_counter()
    calibrated = engine.calibrate(replace(budget, time_limit_s=None), seconds.calibration)
    calibration = time.perf_counter() - begun
    sampling, lit_shares = sampling_cost(engine, plan, calibrated, pilot, lanes, seconds.tracing)
    basis = pilot_basis(engine.capture, pilot, [sampling_basis(budget, calibration > seconds.calibration)])
    return estimate_of(calibration + sampling, basis, lit_shares)


def estimate_of(seconds: float, basis: str, lit_shares: tuple[float | None, ...] | None = None) -> TimeEstimate:
    """Return the estimate of ``seconds``, inf where a pilot saw nothing but noise."""
    if math.isinf(seconds):
        return TimeEstimate(None, f"{basis}: nothing but noise so far", lit_shares)
    return TimeEstimate(seconds, basis, lit_shares)


def sampling_basis(budget: Budget, is_cut_short: bool) -> str:
    """Return what the number of samples rests on; ``is_cut_short``: the calibration ended for its time."""
    return "error extrapolated" if budget.spp is None and is_cut_short else "time ~ paths"


def pilot_basis(capture: Capture, pilot: Batch, parts: list[str]) -> str:
    """Return in words what was measured on which part of a capture."""
    return f"pilot of {pilot.sensors.size} of {capture.n_sensors} {points_of(capture)}, {' and '.join(parts)}"


def points_of(capture: Capture) -> str:
    """Return what sensor points are called: pixels before a camera."""
    return "pixels" if capture.scan_type == LINE_OF_SIGHT else "sensor points"


def sampled_batch_bytes(plan: Plan, shape_of: Callable[[Batch], HistogramShape]) -> int:
    """Return ``Engine.batch_bytes`` of an engine that needs the histograms which the plan has counted."""
    refuse_many_sums(max(shape_of(batch).size for batch in plan.batches))
    return plan.bytes_per_batch


def _lit_shares(pilot: Histogram, bounces: BounceAxis) -> tuple[float | None, ...] | None:
    """Return the share of bins with light per bounce slot; the third bounce's is known better from geometry."""
    if not bounces.split:
        return None
    shares = [float((pilot.mean[:, slot] > 0).mean()) for slot in range(bounces.n_slots)]
    third = bounces.slot(THIRD_BOUNCE) if bounces.first == FIRST_BOUNCE else None
    return tuple(None if slot == third else share for slot, share in enumerate(shares))


class _LaunchClock:
    """Times the launches of a pilot: the first ones have few paths and take longer per path than those of a render."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, int]] = []  # when, and samples per lane so far

    def __call__(self, take: Callable[[], SavedStages]) -> None:
        (snapshot,) = take().values()
        self._marks.append((time.perf_counter(), snapshot.numbers["done"]))

    @property
    def seconds_per_sample(self) -> float | None:
        """Seconds per sample of a lane, over the last two thirds of the samples; None: fewer than four launches."""
        if len(self._marks) < 4:
            return None
        end, last = self._marks[-1]
        begin, first = next(mark for mark in self._marks if mark[1] >= last / 3 or mark is self._marks[-2])
        return (end - begin) / max(last - first, 1)
