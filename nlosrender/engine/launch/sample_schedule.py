"""Sampling until a budget is met: launches of a sampling engine, and how many samples they take.

An engine that traces paths has lanes that belong to a sensor point (or a pixel) each; this is what such engines share.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.energy_contrasts import contrasts_of_points
from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaneRandomness
from nlosrender.engine.launch.passes import PASS_SECONDS, Passes, Snapshot
from nlosrender.engine.launch.temporal_kernel import TemporalKernel

FIRST_SAMPLES = 32  # per lane, before the first look at the error
MOST_AT_FIRST = 2**23  # pairs of a path and a laser point in the first launch, whose speed is not known
DEFAULT_TARGET = 0.01  # where neither an error nor samples are asked for
CALIBRATED_SHARE = 0.9  # of the target error: the pilot's estimate has an error of its own
PILOT_ERROR = 1.5  # times the goal: when a pilot has seen enough. Low-discrepancy numbers beat the 1 / sqrt(N) beyond
PILOT_LANES = 512
MOST_QUICKLY = 16.0  # times the samples: how far errors are trusted to fall faster than as 1 / sqrt(samples)
MOST_POWER = 0.8  # of the samples that errors fall with, where low-discrepancy numbers serve best

Launch = Callable[[DeviceHistogram, LaneRandomness, int], LaneRandomness]


@dataclass(frozen=True)
class Budget:
    """When to stop: after ``spp`` samples per sensor point, at ``target_error`` (relative L2 of H), after seconds.

    An engine's ``calibrate`` turns a target error into fixed settings.
    """

    spp: int | None = None
    target_error: float | None = None
    time_limit_s: float | None = None
    patch_scale: float | None = None  # settled: coarseness of the patches of the virtual lights
    rounds: int | None = None  # settled: rounds of walks of the virtual lights

    @property
    def is_calibrated(self) -> bool:
        """Whether no pilot is needed: samples or a time are given, or nothing is."""
        return self.target_error is None or self.spp is not None or self.time_limit_s is not None


@dataclass(frozen=True, eq=False)
class Sampled:
    """What ``accumulate`` returns; mean and variance are (channel, slot, laser, sensor, row)."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]  # of the mean
    per_lane: int  # samples
    contrasts: NDArray[np.float64]  # of the energy, see ``energy_contrasts``
    compile_seconds: float


def accumulate(
    shape: HistogramShape,
    points: NDArray[np.uint32],
    seed: int,
    launch: Launch,
    schedule: Schedule,
    passes: Passes,
    scale: float = 1.0,
    slots: range | None = None,
    kernel: TemporalKernel | None = None,
    row_points: NDArray[np.uint32] | None = None,
) -> Sampled:
    """Launch until the schedule has enough.

    Parameters
    ----------
    shape
        Of the batch's histogram.
    points
        (sensors,) flat indices of the batch's sensor points, in the lanes' order: what their random numbers depend on.
    seed
        Of the render.
    launch
        Traces so many more paths per lane into a histogram and returns the advanced random state.
    schedule, passes
        How many; who is told how far it is between two launches, and may have kept a state to go on from.
    scale
        What sums are multiplied by.
    slots
        Bounce slots of the result, as for ``DeviceHistogram.statistics``.
    kernel
        As for ``DeviceHistogram``.
    row_points
        (sensors,) flat indices of the sensor points in the histogram's order; None: ``points``.
    """
    histogram = DeviceHistogram(shape, kernel)
    if (earlier := passes.resumed("sums")) is None:
        randomness = lane_randomness(shape, points, seed)
        done, before = 0, 0.0
    else:
        histogram.sums = on_device(mi.Float64, earlier.arrays["sums"])
        randomness = LaneRandomness.restored(earlier)
        done, before = earlier.numbers["done"], earlier.numbers["seconds"]
        schedule.restore(earlier.numbers)
    begun, compile_seconds, is_first = time.perf_counter() - before, 0.0, True
    while (more := schedule.next_samples(done, time.perf_counter() - begun)) > 0:
        launched = time.perf_counter()
        randomness = launch(histogram, randomness, more)
        dr.sync_thread()
        seconds = time.perf_counter() - launched
        if is_first:
            compile_seconds = seconds  # the first launch is small: nearly all of it is compilation
        else:
            schedule.speed = more / max(seconds, 1e-6)
        done, is_first = done + more, False
        if schedule.wants_error(done):
            schedule.record_error(done, histogram.relative_error(done, schedule.known_squares))
        seconds = time.perf_counter() - begun

        def take(random: LaneRandomness = randomness, done: int = done, seconds: float = seconds) -> Snapshot:
            own = random.snapshot()
            numbers = {"done": done, "seconds": seconds, **own.numbers, **schedule.numbers()}
            return Snapshot({"sums": np.asarray(histogram.sums.numpy()), **own.arrays}, numbers)

        passes.between(schedule.fraction(done, seconds), take)
    mean, variance = histogram.statistics(done, scale, slots)
    dr.eval(mean, variance)
    contrasts = contrasts_of_points(
        histogram,
        points if row_points is None else row_points,
        scale / (done * shape.replicas),
        range(shape.slots) if slots is None else slots,
    )
    return Sampled(histogram.on_host(mean), histogram.on_host(variance), done, contrasts, compile_seconds)


def lane_randomness(shape: HistogramShape, points: NDArray[np.uint32], seed: int) -> LaneRandomness:
    """Return the random state that lanes begin with; parameters as for ``accumulate``."""
    lane = dr.arange(mi.UInt32, shape.lanes)
    point = dr.gather(mi.UInt32, on_device(mi.UInt32, points), lane % shape.sensors)
    return LaneRandomness.seeded(seed, point * shape.replicas + lane // shape.sensors)


def pilot_replicas(replicas: int, n_sensors: int) -> int:
    """Return how many replicas a pilot of ``n_sensors`` points takes: enough of them to keep any machine busy."""
    return max(replicas, PILOT_LANES // n_sensors // 2 * 2)


class _PilotEndedError(Exception):
    """The time for a pilot is over."""


def calibrated_by_pilot(
    budget: Budget,
    replicas: int,
    look: Callable[[Schedule, Passes], object],
    known_squares: float = 0.0,
    seconds: float = math.inf,
    least: int = 1,
) -> Budget:
    """Return a budget of samples that meets a target error, found by a pilot.

    Parameters
    ----------
    budget
        With a target error.
    replicas
        Of the pilot.
    look
        Runs the pilot with a schedule.
    known_squares
        As for ``Schedule``.
    seconds
        After which the pilot ends: what it has seen is extrapolated, and ``spp`` is None where that is nothing but
        noise.
    least
        Samples: a pilot's lanes have ``FIRST_SAMPLES`` each at least, and fewer per lane err more than by the law.
    """
    goal = CALIBRATED_SHARE * (budget.target_error or DEFAULT_TARGET)
    schedule = Schedule(Budget(target_error=PILOT_ERROR * goal), replicas, known_squares)
    begun = time.perf_counter()

    def end_in_time(take: object) -> None:
        if time.perf_counter() - begun > seconds:
            raise _PilotEndedError

    with suppress(_PilotEndedError):
        look(schedule, Passes(look=end_in_time))
    per_lane, error = schedule.errors[-1]
    if math.isinf(error):
        return budget
    if error > PILOT_ERROR * goal:  # it ended before it had seen enough
        per_lane, error = schedule.samples_at(PILOT_ERROR * goal), PILOT_ERROR * goal
    return replace(budget, spp=max(least, math.ceil(per_lane * replicas * (error / goal) ** 2)))


class Schedule:
    """How many samples each launch takes. Only the last launches depend on time, and only with a time limit."""

    def __init__(self, budget: Budget, replicas: int, known_squares: float, lanes: int = 1):
        self.budget, self.known_squares = budget, known_squares
        self.lanes = lanes  # times the laser points that each path is connected to
        self.limit = math.ceil(budget.spp / replicas) if budget.spp is not None else None
        self.errors: list[tuple[int, float]] = []  # (samples per lane, relative L2 error)
        self.speed = math.inf  # samples per lane and second
        self.stage = range(0)  # samples that are going to be complete, whatever the launches
        self._next_look = FIRST_SAMPLES

    def numbers(self) -> dict[str, object]:
        """Return what has been found out, as JSON can hold it."""
        speed = self.speed if math.isfinite(self.speed) else None
        return {"errors": [list(error) for error in self.errors], "speed": speed, "next_look": self._next_look}

    def restore(self, numbers: Mapping[str, Any]) -> None:
        """Go on where the ``numbers`` of an earlier schedule leave off."""
        self.errors = [(done, error) for done, error in numbers["errors"]]
        # of another machine, maybe: the first launch is a small one again
        self.speed = (numbers["speed"] or 1.0) / 4
        self._next_look = numbers["next_look"]
        if "stage" in numbers:
            self.stage = range(*numbers["stage"])

    def next_samples(self, done: int, seconds: float) -> int:
        """Return the samples per lane of the next launch; 0 when the budget is met."""
        budget = self.budget
        if done == 0:
            first = min(FIRST_SAMPLES, self.limit or FIRST_SAMPLES)
            if self.limit is not None or budget.time_limit_s is not None:  # what a launch takes changes no result
                first = max(1, min(first, MOST_AT_FIRST // self.lanes))
            self.stage = range(first if budget.time_limit_s is not None or self.limit is None else self.limit)
            return first
        if budget.time_limit_s is not None and seconds >= budget.time_limit_s:
            return 0
        if self.limit is not None:
            goal = self.limit
        elif budget.target_error is not None:
            if self.errors and self.errors[-1][0] == done and self.errors[-1][1] <= budget.target_error:
                return 0
            goal = self._next_look
        else:
            goal = done * 2
        launch = max(1.0, self.speed * PASS_SECONDS)
        if budget.time_limit_s is not None:
            launch = min(launch, max(1.0, self.speed * (budget.time_limit_s - seconds)))
        more = int(min(goal - done, launch if math.isfinite(launch) else 4 * done))
        if budget.time_limit_s is not None:  # there may be no other launch
            self.stage = range(done, done + more)
        elif done == self.stage.stop:
            self.stage = range(done, goal)
        return more

    def wants_error(self, done: int) -> bool:
        """Return whether to look at the error now: at sample counts fixed by the errors seen so far."""
        return self.budget.target_error is not None and done >= self._next_look

    def record_error(self, done: int, error: float) -> None:
        """Note the error after ``done`` samples and when to look next: it falls at least as 1 / sqrt(samples)."""
        self.errors.append((done, error))
        target = self.budget.target_error or error
        needed = done * (error / target) ** 2 if target > 0 else done
        self._next_look = int(min(max(needed * 1.05, done * 1.25), done * 4)) + 1

    def samples_at(self, error: float) -> int:
        """Return the samples per lane for an error below the last one: at first it falls as between the last looks."""
        count, seen = self.errors[-1]
        earlier = [(n, e) for n, e in self.errors[:-1] if n <= count / 2 and seen < e < math.inf]
        power = 0.5
        if earlier:
            n, e = earlier[-1]
            power = min(max(math.log(e / seen) / math.log(count / n), 0.5), MOST_POWER)
        quickly = min((seen / error) ** (1 / power), MOST_QUICKLY)
        return math.ceil(count * quickly * (seen / error / quickly**power) ** 2)

    def fraction(self, done: int, seconds: float) -> float:
        """Return the share of the work that is done, estimated, in [0, 1]."""
        budget = self.budget
        shares = [0.0]
        if self.limit is not None:
            shares.append(done / self.limit)
        if budget.time_limit_s is not None:
            shares.append(seconds / budget.time_limit_s if budget.time_limit_s > 0 else 1.0)
        if budget.target_error is not None and self.errors:
            counted, error = self.errors[-1]
            shares.append((budget.target_error / error) ** 2 * done / counted if error > 0 else 1.0)
        return min(1.0, max(shares))
