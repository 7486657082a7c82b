"""Time estimate of a render: its engine's estimate, bounded by render.time_limit_s."""

from __future__ import annotations

from dataclasses import replace

from nlosrender.capture.plan import Plan
from nlosrender.engine.interface import Budget, Engine, PilotSeconds, TimeEstimate

DEFAULT_PILOT = PilotSeconds()


def estimate_render_time(
    engine: Engine, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds = DEFAULT_PILOT
) -> TimeEstimate:
    """Return the seconds of calibration and rendering, without start, compilation and writing.

    Parameters
    ----------
    engine, plan
        As set up for the capture, and its batches.
    budget
        When the render will stop.
    lanes
        Lanes that keep the backend busy.
    pilot
        How long pilots may take.
    """
    estimate, limit = engine.cost_estimate(plan, budget, lanes, pilot), budget.time_limit_s
    if limit is None or (estimate.seconds is not None and estimate.seconds <= limit):
        return estimate
    return replace(estimate, seconds=limit, basis=f"render.time_limit_s; {estimate.basis}")
