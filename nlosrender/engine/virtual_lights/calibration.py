"""Calibration of the virtual lights: patch scale and rounds of VPLs that meet a target error, tried on a few points.

How the target error is split between the third bounce and the rest: docs/virtual-lights.md, 8.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.engine.interface import Budget
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of, scattered
from nlosrender.engine.launch.schedule import DEFAULT_TARGET
from nlosrender.engine.virtual_lights.refinement import (
    Gathered,
    Refined,
    estimated_error,
    finer_scale,
    footprint_error,
)
from nlosrender.engine.virtual_lights.visibility_trials import VisibilityTrials

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce
    from nlosrender.engine.virtual_lights.vpls.rounds import VplBounces


def calibrated_lights(
    third: ThirdBounce, further: VplBounces | None, budget: Budget, *, share_squares: float
) -> tuple[Budget, float]:
    """Return ``budget`` with patch scale and rounds for its target error, or the patch scale for its time limit.

    ``further`` is None where the third bounce is the highest that is asked for. ``share_squares``: part of the target's
    square that both may use. Returns what they are expected to use of it, too.
    """
    device, tuning = third.device, third.tuning
    pilot, target = pilot_of(device.capture), budget.target_error or DEFAULT_TARGET
    share = tuning.third_share_alone if further is None else tuning.third_share_of_many
    if budget.time_limit_s is not None:
        return replace(
            budget, patch_scale=_patch_scale_in_time(third, budget.time_limit_s, share * target)
        ), share_squares
    if further is not None:
        share = max(share for share in tuning.third_shares if share**2 < share_squares * tuning.most_of_third)
    few = _pilot_of_patches(third)
    gather = cache(lambda scale: third.gather(few, scale))  # a smaller share goes on from these
    known_squares = device.exact_squares(few)
    refine = VisibilityTrials(third, few, gather, known_squares).refined_to
    share_of_places = 0.0
    if device.footprint is not None:
        share_of_places = tuning.share_of_places * share
        places = _places_of_footprint(third, few, share_of_places * target, known_squares)
        budget, share = replace(budget, footprint_places=places), math.sqrt(share**2 - share_of_places**2)
    refined = refine(share * target)
    if further is None:
        return _with_patches(budget, refined), (refined.error / target) ** 2 + share_of_places**2
    if further.shares_subpaths:
        pilot = few
    gathered, more = refined.gathered, pilot.sensors.size / few.sensors.size
    goal, squares = tuning.rest_share_of_many * target, gathered.squares * more
    squares += device.exact_squares(pilot)
    histogram = further.histogram(pilot, further.pilot_replicas(pilot.sensors.size))
    done, error = 0, math.inf
    while done < tuning.max_pilot_rounds and error > tuning.max_pilot_error * goal:
        further.accumulate(pilot, histogram, done, units=further.pilot_units)
        done += further.pilot_units
        mixed = 0.0  # in the square of the sum of all bounces
        if few is pilot and not device.options.bounces.split:
            mean = histogram.on_host(histogram.statistics(done)[0])
            mixed = 2 * float(np.einsum("csltb,csltb->", mean[..., :-1], gathered.values[..., :-1]))
        error = histogram.relative_error(done, squares + mixed)
    forecast = further.forecast
    steps = forecast.time_steps(histogram, done, squares + mixed, math.sqrt(share_squares - share**2) * target)
    finer, step = forecast.split(gathered.n_patches, share, share_squares, steps, done, target)
    if finer < share:
        share = finer
        refined = refine(share * target, refined.patch_scale)
    # patches come in steps: what they leave of their share is spent on rounds
    third_squares, of_steps = min(share, refined.error / target) ** 2 + share_of_places**2, (step.change / target) ** 2
    goal_squares = share_squares - third_squares - of_steps
    rounds = forecast.rounds_needed(step.error, done, math.sqrt(goal_squares) * target)
    of_vpls = (forecast.error_after(step.error, done, rounds) / target) ** 2
    steps_variance = of_steps / max(of_vpls, 1e-12) if of_steps else 0.0
    budget = replace(budget, rounds=rounds, bins_per_step=step.bins, steps_variance=steps_variance)
    return _with_patches(budget, refined), third_squares + of_steps + min(of_vpls, goal_squares)


def _places_of_footprint(third: ThirdBounce, few: Pilot, target: float, known_squares: float) -> int:
    """Return how many places in a footprint bring its error to ``target``, and leave them set for the pilot."""
    for places in third.tuning.footprint_places:
        third.footprint_places = places
        if footprint_error(third.gather(few, third.tuning.coarsest_scale), known_squares) <= target:
            break
    return places


def _with_patches(budget: Budget, refined: Refined) -> Budget:
    return replace(
        budget,
        patch_scale=refined.patch_scale,
        difference_divisor=refined.divisor,
        visibility_step=None if refined.lattice is None else refined.lattice.step,
        rays_per_node=None if refined.lattice is None else refined.lattice.rays,
    )


def _pilot_of_patches(third: ThirdBounce) -> Pilot:
    """Return the pilot that patches are tried on: few points, more where some surface is nearer than they are apart.

    Only some of the points see such a surface close up, or what lies behind it. Then it has up to one in 16 points of
    the capture: three resolutions of more cost as much as the render.
    """
    capture, built, tessellator = third.device.capture, third.device.built, third.tessellator
    nearest, (few, more) = tessellator.nearest, third.tuning.patch_pilot_sensors
    if built.wall.is_planar and built.hidden_bounds is not None:  # what faces away from it, too
        nearest = built.hidden_bounds[0][2] / built.metres_per_engine_unit
    if nearest <= 2 * tessellator.reach / few:
        lattice = capture.sensor_grid.lattice
        few = max(few, min(more, -(-max(lattice.nx, lattice.ny) // 4)))
    return pilot_of(capture, few, scattered)


def _patch_scale_in_time(third: ThirdBounce, time_limit_s: float, target: float) -> float:
    """Return the patch scale for ``target``, or the one that half of the time is predicted to suffice for.

    Of the pilot's seconds only what grows with the patches grows with the points, too: the rest is set-up.
    """
    capture = third.device.capture
    pilot = pilot_of(capture)
    pairs = capture.n_sensors * (capture.n_lasers if third.device.is_exhaustive else 1)
    more = pairs / (pilot.sensors.size * (pilot.lasers.size if third.device.is_exhaustive else 1))

    def timed(scale: float) -> tuple[Gathered, float]:
        begun = time.perf_counter()
        return third.gather(pilot, scale), time.perf_counter() - begun

    patch_scale, known_squares = third.tuning.coarsest_scale, third.device.exact_squares(pilot)
    coarse, before = timed(patch_scale)
    while True:
        finer = finer_scale(third.tessellator, patch_scale, third.tuning.refinement)
        fine, seconds = timed(finer)
        per_patch = max(seconds - before, 0.0) / max(fine.n_patches - coarse.n_patches, 1)
        both = 1 + 1 / third.tuning.refinement  # resolutions
        predicted = both * (seconds + per_patch * fine.n_patches * (more - 1))
        error = estimated_error(coarse, fine, known_squares)
        if error <= target or predicted > time_limit_s / 2 or 2 * fine.n_patches > third.tuning.max_patches:
            return finer if error <= target else patch_scale
        patch_scale, coarse, before = finer, fine, seconds
