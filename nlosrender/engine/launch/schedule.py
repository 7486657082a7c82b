"""Schedule of a sampling engine: the number of samples of each launch, until a budget is met."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from nlosrender.engine.interface import Budget
from nlosrender.engine.launch.passes import PASS_SECONDS, Passes

DEFAULT_TARGET = 0.01  # relative error aimed at if neither an error nor samples are given
PILOT_LANES = 512  # 4 vectors of 16 lanes on each of 8 threads: replicas are added until a pilot has as many


@dataclass(frozen=True)
class ScheduleTuning:
    """Numbers of the schedule; none changes what an estimate converges to."""

    pass_seconds: float = PASS_SECONDS
    # Samples per lane before the error is first estimated. The variance over two replicas has a relative error of
    # sqrt(2), which averages out over the bins of a capture, but not below about 32 samples, where most bins that will
    # hold light are still empty: with 4 to 16, captures of few points stated 1.3 to 1.5 times the error asked for
    # (tests/statistical/test_honest_errors.py).
    first_samples: int = 32
    # Pairs of a path and a laser point in the first launch, whose speed is not known yet. Measured pairs per CPU second
    # of bench scenes: closed room, all bounces 5e6, letters 4e7, 12 x 12 lasers 5e7, plate 7e7; so at most 1.6 s.
    max_first_pairs: int = 2**23
    # The same of the gathers: a patch (1 s at 30 ns) or a contribution of a VPL (1 s at 15 ns), sensor and laser point.
    first_gather_pairs: int = 2**25
    first_vpl_pairs: int = 2**26
    # Share of the target error aimed at, because the pilot's points are not the whole capture; its own scatter between
    # seeds is small, 0.2 to 0.8 % in error (bench scenes plate, letters, room). Renders with the calibrated samples
    # state 0.73 to 0.82 of the target (those, 5 bounces, 8 x 8 lasers): extrapolation by 1 / sqrt(n) is conservative.
    aim: float = 0.9
    # Error over the aim at which a pilot stops. Low-discrepancy points converge faster than the 1 / sqrt(n) it is
    # extrapolated by: from 1.5 the samples are at most 1.5^(2 - 1 / 0.8) = 1.36 times too many, at power 0.8 below.
    pilot_error: float = 1.5
    # Largest power p of error ~ n^-p that extrapolation assumes (Monte Carlo: 0.5; a rank-1 lattice on a smooth
    # integrand: 1), and the factor in samples over which it does; beyond it the power is 0.5.
    max_power: float = 0.8
    max_extrapolation: float = 16.0


DEFAULT_SCHEDULE = ScheduleTuning()


class _PilotEndedError(Exception):
    """The pilot has used its time."""


def pilot_replicas(replicas: int, n_sensors: int) -> int:
    """Return the replicas of a pilot of ``n_sensors`` points: at least the render's, up to ``PILOT_LANES`` lanes."""
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
        Of the render, whose lanes take at least ``first_samples`` each, and of the pilot.
    look
        Runs the pilot with a schedule and passes.
    known_squares, tuning
        As for ``Schedule``.
    seconds
        After which the pilot ends and its error is extrapolated; ``spp`` stays None if it is infinite: no signal yet.
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
    if error > enough:  # the pilot ran out of time
        per_lane, error = schedule.samples_at(enough), enough
    min_spp = tuning.first_samples * replicas[0]
    return replace(budget, spp=max(min_spp, math.ceil(per_lane * replicas[1] * (error / goal) ** 2)))


class Schedule:
    """The number of samples of each launch; sample counts depend on time only with a time limit.

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
        self.block = range(0)  # samples that systematic sampling spreads evenly; complete whatever the launches
        self._next_look = self.tuning.first_samples

    def numbers(self) -> dict[str, object]:
        """Return the state as JSON can hold it."""
        speed = self.speed if math.isfinite(self.speed) else None
        return {"errors": [list(error) for error in self.errors], "speed": speed, "next_look": self._next_look}

    def restore(self, numbers: Mapping[str, Any]) -> None:
        """Restore the state from ``numbers()`` of an earlier schedule."""
        self.errors = [(done, error) for done, error in numbers["errors"]]
        # maybe of another machine: the first launch is small again
        self.speed = (numbers["speed"] or 1.0) / 4
        self._next_look = numbers["next_look"]
        if "block" in numbers:
            self.block = range(*numbers["block"])

    def next_samples(self, done: int, seconds: float) -> int:
        """Return the samples per lane of the next launch; 0 when the budget is met."""
        budget = self.budget
        if done == 0:
            first = min(self.tuning.first_samples, self.limit or self.tuning.first_samples)
            if self.limit is not None or budget.time_limit_s is not None:  # launch sizes change no result
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
        if budget.time_limit_s is not None:  # each launch may be the last
            self.block = range(done, done + more)
        elif done == self.block.stop:
            self.block = range(done, goal)
        return more

    def wants_error(self, done: int) -> bool:
        """Return whether to estimate the error now: at sample counts that follow from the errors so far."""
        return self.budget.target_error is not None and done >= self._next_look

    def record_error(self, done: int, error: float) -> None:
        """Record the error after ``done`` samples, and the sample count of the next estimate, by 1 / sqrt(samples)."""
        self.errors.append((done, error))
        target = self.budget.target_error or error
        needed = done * (error / target) ** 2 if target > 0 else done
        self._next_look = int(min(max(needed * 1.05, done * 1.25), done * 4)) + 1

    def samples_at(self, error: float) -> int:
        """Return the samples per lane for ``error`` below the last one, by the power of the last two estimates."""
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
