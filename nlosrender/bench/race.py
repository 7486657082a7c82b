"""Contenders render the same scene level by level, in turns, so that a busy machine slows all of them alike."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from nlosrender.bench.curve import Curve, Point
from nlosrender.bench.references import Reference
from nlosrender.bench.runs import LoadedScene, Run, Timer, chosen_engine, render
from nlosrender.engine.interface import Budget

REPEATS = 3
SHORT_SECONDS = 1.5  # runs up to this long are repeated, and their median reported
FIRST_SAMPLES = 64  # paths per sensor point at level 0; each level takes four times as many
FIRST_TARGET = 0.08  # target error at level 0; each level asks for half of it
SIGNIFICANT = 4.0  # standard deviations
FIXED_POINT = 1.5  # an error this close to the reference's own says nothing about the contender


class Contender(Protocol):
    """Renders a loaded scene at increasing cost."""

    @property
    def name(self) -> str:
        """In the table."""

    @property
    def is_random(self) -> bool:
        """Whether its error is noise, which falls as 1 / sqrt of the time."""

    def run(self, level: int, seed: int) -> Run:
        """Render once at ``level``, 0 being the cheapest."""


@dataclass(frozen=True, eq=False)
class OwnContender:
    """One of our engines with fixed options."""

    name: str
    loaded: LoadedScene
    options: Mapping[str, Any]

    @property
    def is_random(self) -> bool:
        """All but the third bounce of the virtual lights."""
        return self.options["engine"] == "path" or self.loaded.scene.max_bounces != 3

    def run(self, level: int, seed: int) -> Run:
        """Render once: ``FIRST_SAMPLES * 4^level`` paths per sensor point, or to ``FIRST_TARGET / 2^level``.

        Raises
        ------
        RenderError
            The result is not finite, or does not fit the memory.
        """
        if self.options["engine"] == "path":
            budget = Budget(spp=FIRST_SAMPLES * 4**level)
        else:
            budget = Budget(target_error=FIRST_TARGET / 2**level)
        return render(self.loaded, budget, seed, self.options)


def own_contenders(loaded: LoadedScene) -> list[Contender]:
    """Return our engines for a scene: the one that ``auto`` takes, the virtual lights, the path engine both ways."""
    bsdf_only = {"engine": "path", "hidden_geometry_sampling": False}
    contenders: list[Contender] = [OwnContender("auto", loaded, {"engine": "auto"})]
    if chosen_engine(loaded) != "virtual_lights":
        contenders.append(OwnContender("virtual lights", loaded, {"engine": "virtual_lights"}))
    contenders.append(OwnContender("path", loaded, {"engine": "path"}))
    contenders.append(OwnContender("path, BSDF sampling", loaded, bsdf_only))
    return contenders


@dataclass(eq=False)
class _Lane:
    """A contender's progress."""

    contender: Contender
    curve: Curve
    spent: float = 0.0
    runs: list[Run] = field(default_factory=list)  # of the current level


def race(
    contenders: Sequence[Contender],
    reference: Reference,
    seconds: float,
    target: float,
    match: Callable[[Contender, Run, Reference], np.ndarray] = lambda contender, run, reference: run.values,
) -> list[Curve]:
    """Run all contenders, level by level, each for about its share of ``seconds``.

    Parameters
    ----------
    contenders, reference
        Who renders, and the truth.
    seconds
        For all of them together. A contender goes on while its next level can be expected to fit into its share.
    target
        A contender above this error may take twice its share.
    match
        Brings a result to the reference's scale, where a contender's unit is not ours.

    Returns
    -------
    list of Curve
        One per contender, with at least one point each.

    Raises
    ------
    RenderError
        A render failed.
    """
    lanes = [_Lane(contender, Curve(contender.name, contender.is_random)) for contender in contenders]
    for lane in lanes:  # compiles, or loads the kernels compiled before; never part of a point
        lane.curve.first_seconds = lane.contender.run(0, seed=99).seconds
    level, active = 0, list(lanes)
    while active:
        for repeat in range(REPEATS):
            for lane in active:
                if repeat and lane.runs[0].seconds > SHORT_SECONDS:
                    continue
                timer = Timer()
                lane.runs.append(lane.contender.run(level, seed=repeat))
                lane.spent += timer.read()[0]
        for lane in active:
            matched = [match(lane.contender, run, reference) for run in lane.runs]
            lane.curve.points.append(_point(lane.runs, matched, reference))
            lane.curve.engine = lane.runs[0].engine
            lane.runs = []
        done = sum(lane.spent for lane in lanes if lane not in active)
        share = (seconds - done) / len(active)  # what others left over is shared by those that go on
        active = [lane for lane in active if _goes_on(lane, share, target, reference.error)]
        level += 1
    return [lane.curve for lane in lanes]


def _goes_on(lane: _Lane, share: float, target: float, reference_error: float) -> bool:
    points = lane.curve.points
    if points[-1].error < FIXED_POINT * reference_error:
        return False
    growth = points[-1].seconds / points[-2].seconds if len(points) > 1 else 2.0
    expected = points[-1].seconds * min(max(growth, 1.5), 4.0 if lane.contender.is_random else 8.0)
    return lane.spent + expected < share * (2 if points[-1].error > target else 1)


def _point(runs: list[Run], matched: list[np.ndarray], reference: Reference) -> Point:
    truth = reference.values
    squares = float((truth**2).sum())
    errors = [math.sqrt(float(((values - truth) ** 2).sum()) / squares) for values in matched]
    systematic = _shared_error(matched[0] - truth, matched[1] - truth, reference) if len(matched) > 1 else None
    estimates = [run.estimate for run in runs if run.estimate is not None]
    return Point(
        seconds=statistics.median(run.seconds for run in runs),
        cpu_seconds=statistics.median(run.cpu_seconds for run in runs),
        error=statistics.median(errors),
        repeats=len(runs),
        estimate=statistics.median(estimates) if estimates else None,
        samples=runs[0].samples,
        systematic=systematic,
        energy=float(np.mean([run.values.sum() for run in runs])),
    )


def _shared_error(one: np.ndarray, other: np.ndarray, reference: Reference) -> float | None:
    """Return the relative L2 error that two independent runs share, None when it is lost in their noise.

    Independent noise cancels in the product of two runs' errors, which leaves the square of their common part. The
    reference's own error, a part of it, is subtracted; what is below that error is not significant.
    """
    squares = float((reference.values**2).sum())
    # per sensor point: the bins of one are not independent where numbers are low-discrepancy
    products = (one * other).sum(axis=-1)
    deviation, shared = math.sqrt(float((products**2).sum())), float(products.sum())
    rest = shared / squares - reference.error**2
    if shared < SIGNIFICANT * deviation or rest < reference.error**2:
        return None
    return math.sqrt(rest)
