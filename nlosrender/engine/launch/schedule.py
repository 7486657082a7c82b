"""The schedule of a sampling engine: how many samples each launch takes until a budget is met."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from nlosrender.engine.interface import Budget
from nlosrender.engine.launch.passes import PASS_SECONDS, Passes

DEFAULT_TARGET = 0.01  # where neither an error nor samples are asked for
PILOT_LANES = 512  # four vector units of 16 lanes on each of 8 threads: a pilot of few points still fills a machine


@dataclass(frozen=True)
class ScheduleTuning:
    """Numbers of the schedule; none changes what an estimate converges to."""

    pass_seconds: float = PASS_SECONDS
    # Samples per lane before the first look at the error. The variance over two replicas of n samples has a relative
    # error of sqrt(2); over all bins of a capture it averages out, but not below about 32 samples, where most bins
    # that will hold light are still empty: captures of few points stated 1.3 to 1.5 times the error asked for with 4
    # to 16 (pytest tests/statistical/test_honest_errors.py).
    first_samples: int = 32
    # Pairs of a path and a laser point in the first launch, whose speed is not known: 1 s at the 8e6 pairs per second
    # of the slowest scene of the benchmark (room.yaml on 2 cores).
    max_first_pairs: int = 2**23
    # The same of the gathers: a patch (1 s at 30 ns) or a contribution of a VPL (1 s at 15 ns), sensor and laser point.
    first_gather_pairs: int = 2**25
    first_vpl_pairs: int = 2**26
    # Share of the target error aimed at: the pilot's own estimate scatters by 5 to 10 % (256 points, 2 replicas).
    aim: float = 0.9
    # Times the aim: error at which a pilot has seen enough. Low-discrepancy points beat 1 / sqrt(n), and more so the
    # further one extrapolates; by 1.5 in error the extrapolation is off by at most 1.5^(2 - 1 / 0.8) = 1.36 in samples.
    pilot_error: float = 1.5
    # Exponent of the error's fall with samples that extrapolations trust at most (1 / sqrt(n): 0.5; the rank-1 lattice
    # of smooth integrands reaches 1), and the factor in samples over which they do.
    max_power: float = 0.8
    max_extrapolation: float = 16.0


DEFAULT_SCHEDULE = ScheduleTuning()


class _PilotEndedError(Exception):
    """The time for a pilot is over."""


def pilot_replicas(replicas: int, n_sensors: int) -> int:
    """Return how many replicas a pilot of ``n_sensors`` points takes: enough of them to keep any machine busy."""
    return max(replicas, PILOT_LANES // n_sensors // 2 * 2)


def calibrated_by_pilot(
    budget: Budget,
    replicas: tuple[int, int],
    look: Callable[[Schedule, Passes], object],
    known_squares: float = 0.0,
    seconds: float = math.inf,
    tuning: ScheduleTuning = DEFAULT_SCHEDULE,
) -> Budget:
    """Return a budget of samples that meets a target error, found by a pilot.

    Parameters
    ----------
    budget
        With a target error.
    replicas
        Of the render, whose lanes take ``first_samples`` each at least, and of the pilot.
    look
        Runs the pilot with a schedule.
    known_squares, tuning
        As for ``Schedule``.
    seconds
        After which the pilot ends: what it has seen is extrapolated, and ``spp`` is None where that is nothing but
        noise.
    """
    goal = tuning.aim * (budget.target_error or DEFAULT_TARGET)
    enough = tuning.pilot_error * goal
    schedule = Schedule(Budget(target_error=enough), replicas[1], known_squares, tuning=tuning)
    begun = time.perf_counter()

    def end_in_time(take: object) -> None:
        if time.perf_counter() - begun > seconds:
            raise _PilotEndedError

    with suppress(_PilotEndedError):
        look(schedule, Passes(look=end_in_time))
    per_lane, error = schedule.errors[-1]
    if math.isinf(error):
        return budget
    if error > enough:  # it ended before it had seen enough
        per_lane, error = schedule.samples_at(enough), enough
    fewest = tuning.first_samples * replicas[0]
    return replace(budget, spp=max(fewest, math.ceil(per_lane * replicas[1] * (error / goal) ** 2)))


class Schedule:
    """How many samples each launch takes. Only the last launches depend on time, and only with a time limit.

    Parameters
    ----------
    budget, replicas
        When to stop; replicas of the histogram, which share the samples of ``budget.spp``.
    known_squares
        Sum of the squares of the part of H that is known from elsewhere, which the relative error counts in.
    lanes
        Lanes times the laser points that each path is connected to.
    tuning
        Numbers of the schedule.
    """

    def __init__(
        self,
        budget: Budget,
        replicas: int,
        known_squares: float = 0.0,
        lanes: int = 1,
        tuning: ScheduleTuning = DEFAULT_SCHEDULE,
    ):
        self.budget, self.known_squares, self.tuning = budget, known_squares, tuning
        self.lanes = lanes  # times the laser points that each path is connected to
        self.limit = math.ceil(budget.spp / replicas) if budget.spp is not None else None
        self.errors: list[tuple[int, float]] = []  # (samples per lane, relative L2 error)
        self.speed = math.inf  # samples per lane and second
        self.block = range(0)  # samples that are going to be complete, whatever the launches
        self._next_look = self.tuning.first_samples

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
        if "block" in numbers:
            self.block = range(*numbers["block"])

    def next_samples(self, done: int, seconds: float) -> int:
        """Return the samples per lane of the next launch; 0 when the budget is met."""
        budget = self.budget
        if done == 0:
            first = min(self.tuning.first_samples, self.limit or self.tuning.first_samples)
            if self.limit is not None or budget.time_limit_s is not None:  # what a launch takes changes no result
                first = max(1, min(first, self.tuning.max_first_pairs // self.lanes))
            self.block = range(first if budget.time_limit_s is not None or self.limit is None else self.limit)
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
        launch = max(1.0, self.speed * self.tuning.pass_seconds)
        if budget.time_limit_s is not None:
            launch = min(launch, max(1.0, self.speed * (budget.time_limit_s - seconds)))
        more = int(min(goal - done, launch if math.isfinite(launch) else 4 * done))
        if budget.time_limit_s is not None:  # there may be no other launch
            self.block = range(done, done + more)
        elif done == self.block.stop:
            self.block = range(done, goal)
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
            power = min(max(math.log(e / seen) / math.log(count / n), 0.5), self.tuning.max_power)
        quickly = min((seen / error) ** (1 / power), self.tuning.max_extrapolation)
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
