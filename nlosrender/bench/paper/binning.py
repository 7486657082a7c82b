"""Figure 6: bin width against samples for one point; and, beyond the paper, kernels in time with their bias."""

from __future__ import annotations

import numpy as np

from nlosrender.analysis.theme import GROUND, INK, MARK
from nlosrender.bench.curve import power_law
from nlosrender.bench.paper.drawing import log_log, new_figure, save
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.study import Float64, Rendered, Study, relative_error

SCENE = "letters-near"
WINDOW = (1.9, 3.1)  # m of optical path
PATHS = ("render.engine=path", "render.target_error=null", "capture.sensor_grid={nx: 1, ny: 1}")
KERNEL_RUNS = 16  # seeds whose mean shows the bias: it stands out where it is over a quarter of the noise
SLOPE_TOLERANCE = 0.15


def time_binning(study: Study) -> PaperFigure:
    """Render one sensor point with wider and wider bins, and more and more paths."""
    widths = (0.002, 0.005, 0.0125, 0.03)
    counts = [4**k * 1000 for k in range(study.pick(4, 6))]
    lights = ("render.engine=virtual_lights", "render.target_error=0.001")
    truths = {width: _histogram(_render(study, width, *lights)) for width in widths}
    errors = np.zeros((len(widths), len(counts)))
    figure, axes = new_figure(len(widths), len(counts), 2.9 * len(counts), 1.7 * len(widths))
    for line, width in enumerate(widths):
        for column, count in enumerate(counts):
            run = _render(study, width, *PATHS[:2], f"render.spp={count}")
            light, edges = _histogram(run), run.bin_edges()
            errors[line, column] = relative_error(light, truths[width])
            part = axes[line, column]
            part.stairs(light / width, edges, color="#f7b267", lw=0.7)
            part.set_title(f"{1000 * width:g} mm, {count} paths: {errors[line, column]:.0%}", color=INK, size=8)
            part.set_yticks([])
    by_count = [power_law(counts, row) or 0.0 for row in errors.tolist()]
    by_width = power_law(widths, np.exp(np.log(errors).mean(axis=1)).tolist()) or 0.0
    kernels, kernel_picture, best = _kernels(study, widths[0], counts[1])
    return PaperFigure(
        name="Figure 6",
        title="time binning, and kernels in time",
        reported="The histogram of one point: narrow bins resolve more and are noisier; more samples or wider bins "
        "lower the noise.",
        measured=f"The error falls as paths^{np.mean(by_count):.2f} and as width^{by_width:.2f} (independent samples: "
        f"-0.5 each, the width's exponent less steep where bins merge detail). {best}",
        pictures=(
            Picture(save(figure, study.picture("figure-6-binning")), "One sensor point: bin width down, paths across."),
            kernel_picture,
        ),
        tables=(kernels,),
        checks=(
            Check(
                f"error falls as 1/sqrt(paths): mean exponent within {SLOPE_TOLERANCE} of -0.5",
                abs(float(np.mean(by_count)) + 0.5) < SLOPE_TOLERANCE,
            ),
            Check("wider bins have less noise", by_width < 0),
        ),
        differs="Kernel density estimation (Jarabo et al. 2014) is an addition; the virtual lights are the truth.",
        configurations=(SCENE,),
    )


def _kernels(study: Study, bin_width: float, count: int) -> tuple[Table, Picture, str]:
    """Measure bias and noise of kernels of several widths; return a table, a picture, and which is best."""
    truth = _histogram(_render(study, bin_width, "render.engine=virtual_lights", "render.target_error=0.001"))
    edges: Float64 = np.zeros(0)
    rows, totals = [], {}
    figure, axes = new_figure(1, 2, 13, 4)
    for kernel in (0.0, 0.004, 0.008, 0.016, 0.032, 0.064):
        runs = []
        for number in range(KERNEL_RUNS):
            run = _render(
                study, bin_width, *PATHS[:2], f"render.spp={count}", f"render.temporal_kernel_opl={kernel}",
                f"render.seed={study.seed + 1 + number}",
            )  # fmt: skip
            runs.append(_histogram(run))
            edges = run.bin_edges()
        stack = np.array(runs)
        noise2 = stack.var(axis=0, ddof=1).sum()
        # the mean over the runs still has some of their noise in it
        bias2 = max(np.square(stack.mean(axis=0) - truth).sum() - noise2 / KERNEL_RUNS, 0.0)
        norm = np.linalg.norm(truth)
        bias, noise, total = (float(np.sqrt(part) / norm) for part in (bias2, noise2, bias2 + noise2))
        totals[kernel] = total
        rows.append((f"{1000 * kernel:g} mm" if kernel else "none", f"{noise:.2%}", f"{bias:.2%}", f"{total:.2%}"))
        if kernel in (0.0, 0.016):
            name = "histogram" if kernel == 0 else f"kernel of {1000 * kernel:g} mm"
            axes[0, 0].stairs(runs[0] / bin_width, edges, lw=0.8, label=name)
    axes[0, 0].stairs(truth / bin_width, edges, lw=1.2, color=MARK, label="virtual lights")
    axes[0, 0].legend(facecolor=GROUND, labelcolor=INK, fontsize=8)
    axes[0, 0].set_title(f"one point, {count} paths", color=INK, size=10)
    kernels = [kernel for kernel in totals if kernel > 0]
    for column, name in ((1, "noise"), (2, "bias"), (3, "both")):
        values = [float(row[column].rstrip("%")) / 100 for row in rows[1:]]
        axes[0, 1].plot(kernels, np.maximum(values, 1e-4), marker="o", ms=4, label=name)
    log_log(axes[0, 1], "kernel width against error", "m", "relative L2")
    caption = (
        f"{KERNEL_RUNS} seeds each, {count} paths, bins of {1000 * bin_width:g} mm, window {WINDOW[0]}-{WINDOW[1]} m"
    )
    table = Table(("kernel width", "noise", "bias", "both"), tuple(rows), f"Epanechnikov kernels in time: {caption}")
    least = min(totals, key=lambda kernel: totals[kernel])
    best = (
        f"With {count} paths and bins of {1000 * bin_width:g} mm the kernel of {1000 * least:g} mm is best: "
        f"{totals[least]:.1%} against {totals[0.0]:.1%} of the plain histogram."
    )
    picture = Picture(save(figure, study.picture("figure-6-kernels")), f"Kernels in time: {caption}.")
    return table, picture, best


def _render(study: Study, width: float, *overrides: str) -> Rendered:
    n_bins = round((WINDOW[1] - WINDOW[0]) / width)
    axis = f"time_axis={{start_opl: {WINDOW[0]}, bin_width_opl: {width}, n_bins: {n_bins}}}"
    return study.render(SCENE, f"one-point-{1000 * width:g}-mm", axis, PATHS[2], *overrides)


def _histogram(run: Rendered) -> Float64:
    return run.light()[0, 0, 0, 0]
