"""How many rounds of VPLs a target error takes, and in which time steps: what a pilot's errors are extrapolated by.

docs/virtual-lights.md, 7.7 and 8.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.time_steps import TimeSteps
from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning
from nlosrender.engine.virtual_lights.vpls.step_sums import in_steps


@dataclass(frozen=True)
class RoundForecast:
    """What rounds cost and how their error falls.

    A round has 1 to ``max_units`` units of ``vpls_per_round`` VPLs, a pilot's ``pilot_units``.
    """

    tuning: VirtualLightTuning
    vpls_per_round: int
    max_units: int
    pilot_units: int
    shares_subpaths: bool
    rays_per_vpl: int  # of a sensor point, where VPLs do not share subpaths

    def time_steps(self, pilot: DeviceHistogram, done: int, known_squares: float, goal: float) -> list[TimeSteps]:
        """Return what a pilot of ``done`` units says of the time steps that may be taken; one bin first.

        ``goal``: the error that they are to reach. Smoothing saves nothing where one round does.
        """
        lengths = self.tuning.bins_per_step if self.shares_subpaths else self.tuning.bins_smoothed
        if not self.shares_subpaths and pilot.relative_error(done, known_squares) * math.sqrt(done) <= goal:
            lengths = ()
        lengthened = in_steps if self.shares_subpaths else None
        return TimeSteps.of_pilot(pilot, lengths, done, known_squares, lengthened)

    def split(
        self, patches: int, largest: float, share_squares: float, steps: list[TimeSteps], done: int, target: float
    ) -> tuple[float, TimeSteps]:
        """Return the one of ``third_shares``, and time steps, that take the fewest rays in all, then the least error.

        docs/virtual-lights.md, 8.

        Parameters
        ----------
        patches
            That the ``largest`` share takes: their number goes with the error to the power of -4/3.
        share_squares
            Part of the target's square that third bounce and VPLs share.
        steps
            What a pilot of ``done`` units says of time steps.
        target
            Target error.
        """
        tuning = self.tuning

        def rays_and_squares(of_third: float, step: TimeSteps) -> tuple[float, float]:
            left = share_squares - of_third**2 - (step.change / target) ** 2
            if left <= 0 or step.change > tuning.share_of_steps * target:
                return math.inf, math.inf
            cost = (
                tuning.connection_cost + tuning.histogram_cost / step.bins
                if self.shares_subpaths
                else self.rays_per_vpl
            )
            finer = patches * (largest / of_third) ** (4 / 3)
            rounds = self.rounds_needed(step.error, done, math.sqrt(left) * target)
            squares = self.error_after(step.error, done, rounds) ** 2 + step.change**2
            return finer * 4 / 3 + self.vpls_per_round * cost * rounds, squares

        shares = [share for share in tuning.third_shares if share <= largest]
        return min(itertools.product(shares, steps), key=lambda both: rays_and_squares(*both))

    def rounds_needed(self, error: float, done: int, target: float) -> int:
        """Return how many units bring the ``error`` of a pilot of ``done`` units to ``target``.

        It falls as 1 / sqrt(rounds), and faster with the units of one round, where VPLs are stratified. At most
        ``max_rounds``, where no light has been found as well.
        """
        tuning = self.tuning
        if not math.isfinite(error):
            return tuning.max_rounds
        largest = self.max_units / self.pilot_units
        of_round = error * math.sqrt(done / self.pilot_units)
        units = self.pilot_units * min((of_round / target) ** (1 / tuning.order_of_units), largest)
        of_largest = of_round * largest**-tuning.order_of_units
        units *= max((of_largest / target) ** 2, 1)
        return min(max(1, math.ceil(units)), tuning.max_rounds)

    def error_after(self, error: float, done: int, units: int) -> float:
        """Return the error after so many ``units``, by the law of ``rounds_needed``."""
        in_round = min(units, self.max_units) / self.pilot_units
        of_round = error * math.sqrt(done / self.pilot_units) * in_round**-self.tuning.order_of_units
        return of_round * math.sqrt(in_round * self.pilot_units / units)
