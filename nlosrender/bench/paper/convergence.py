"""Figure 11: mean squared error against paths, and against seconds, with the virtual lights beside the paper's four."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nlosrender.analysis.theme import MARK
from nlosrender.bench.curve import power_law
from nlosrender.bench.paper.ablation import BOTH, SPOT, SPOT_RADIUS, TECHNIQUES, Technique
from nlosrender.bench.paper.drawing import log_log, new_figure, save
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.study import Float64, Rendered, Study, relative_error, sensor_grid

SCENE = "letters-near"
REFERENCE_TIMES = 16  # samples of the reference over the largest count: its own squared error is known and taken off
SLOPE_TOLERANCE = 0.2  # a fit through four or more points whose errors are known to a few percent each


def convergence(study: Study) -> PaperFigure:
    """Render with more and more paths, and with the virtual lights for smaller and smaller target errors."""
    grid = sensor_grid(study.pick(24, 64))
    counts = [4**k for k in study.pick(range(3, 7), range(3, 8))]
    reference = _path_reference(study, grid, REFERENCE_TIMES * counts[-1], SPOT)
    truth, floor = reference.light(), float(reference.variance().mean())
    curves = {technique: _curve(study, technique, grid, counts, truth, floor) for technique in TECHNIQUES}
    slopes = {}
    figure, axes = new_figure(1, 2, 13, 5)
    for technique, (mses, seconds) in curves.items():
        slope = power_law(counts, mses)
        slopes[technique.name] = math.nan if slope is None else slope
        axes[0, 0].plot(
            counts, mses, marker="o", ms=4, label=f"{technique.name}, slope {_shown(slopes[technique.name])}"
        )
        axes[0, 1].plot(seconds, mses, marker="o", ms=4, label=technique.name)
    targets = study.pick((0.2, 0.1, 0.05, 0.02), (0.2, 0.1, 0.05, 0.02, 0.01, 0.005))
    lights_mses, lights_seconds, table, agreement = _virtual_lights(study, grid, targets, REFERENCE_TIMES * counts[-1])
    axes[0, 1].plot(lights_seconds, lights_mses, marker="s", ms=5, color=MARK, label="virtual lights")
    log_log(axes[0, 0], "mean squared error against paths", "paths per sensor point", "MSE of H")
    log_log(axes[0, 1], "mean squared error against seconds of rendering", "s", "MSE of H")
    return PaperFigure(
        name="Figure 11",
        title="convergence",
        reported="The mean squared error of all techniques falls as 1/N; they differ by a factor, and both together "
        "are lowest.",
        measured="Fitted slopes: " + ", ".join(f"{name} {_shown(slope)}" for name, slope in slopes.items()) + ". The "
        f"virtual lights differ from the path engine by {agreement:.2%} of H, whose own error is part of that.",
        pictures=(Picture(save(figure, study.picture("figure-11-convergence")), "Mean squared error of H."),),
        tables=(table,),
        checks=tuple(
            Check(f"{name}: slope within {SLOPE_TOLERANCE} of -1", abs(slopes[name] + 1) < SLOPE_TOLERANCE)
            for name in ("laser sampling", "both")
        ),
        differs="The time axis and the virtual lights are additions. The virtual lights take a laser point instead of "
        f"a spot of {1000 * SPOT_RADIUS:g} mm, and are measured against their own finest run.",
        configurations=(SCENE,),
    )


def _shown(slope: float) -> str:
    """Return a slope in words; what hardly any path finds has none yet: its first hits raise the error."""
    return f"{slope:.2f}" if slope < 0 else "none yet (hardly any path finds the spot)"


def _path_reference(study: Study, grid: str, spp: int, *overrides: str) -> Rendered:
    seed = f"render.seed={study.seed + 1}"
    return study.render(SCENE, "convergence-reference", grid, *BOTH.overrides, f"render.spp={spp}", seed, *overrides)


def _curve(
    study: Study, technique: Technique, grid: str, counts: Sequence[int], truth: Float64, floor: float
) -> tuple[list[float], list[float]]:
    """Return mean squared errors, the reference's own taken off, and seconds."""
    mses, seconds = [], []
    for count in counts:
        run = study.render(SCENE, "convergence", grid, SPOT, *technique.overrides, f"render.spp={count}")
        mses.append(max(float(np.square(run.light() - truth).mean()) - floor, 1e-300))
        seconds.append(run.seconds)
    return mses, seconds


def _virtual_lights(
    study: Study, grid: str, targets: Sequence[float], spp: int
) -> tuple[list[float], list[float], Table, float]:
    """Return mean squared errors, seconds, a table of them, and the difference from the path engine."""
    finest = study.render(SCENE, "convergence-lights", grid, f"render.target_error={targets[-1] / 4}").light()
    rows, mses, seconds = [], [], []
    for target in targets:
        run = study.render(SCENE, "convergence", grid, f"render.target_error={target}")
        light = run.light()
        mses.append(float(np.square(light - finest).mean()))
        seconds.append(run.seconds)
        stated, true = run.report.error_estimate, relative_error(light, finest)
        rows.append((f"{target:.1%}", f"{run.seconds:.2f}", f"{stated:.2%}", f"{true:.2%}"))
    paths = _path_reference(study, grid, spp).light()
    table = Table(
        ("asked for", "seconds", "error stated", "error against the finest"), tuple(rows), "the virtual lights"
    )
    return mses, seconds, table, relative_error(finest, paths)
