"""Figure 12: reconstructions of what each technique captures in the same time."""

from __future__ import annotations

import numpy as np

from nlosrender.analysis.reconstruction.picture import draw_reconstruction
from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.analysis.reconstruction.score import Score, score_front_view
from nlosrender.analysis.reconstruction.silhouette import true_silhouette
from nlosrender.bench.paper.ablation import SPOT, TECHNIQUES
from nlosrender.bench.paper.drawing import new_figure, save, show_wall
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.study import Float64, Rendered, Study, sensor_grid

SCENE = "letters-near"
WAVELENGTH = 0.06  # m, of the virtual wave: the same for all, twice the spacing of 64 points on 2 m


def silhouettes(study: Study) -> PaperFigure:
    """Render for the same time with every technique, reconstruct with phasor fields, compare with the true outline."""
    side, seconds, voxels = study.pick((48, 2.0, 96), (64, 20.0, 128))
    wavelength = max(WAVELENGTH, 2 * 2.0 / side)
    common = (
        "capture.scan_type=confocal",
        sensor_grid(side),
        "time_axis={start_opl: 1.8, bin_width_opl: 0.005, n_bins: 400}",
    )
    rows: list[tuple[str, ...]] = []
    views: list[tuple[str, Float64, Float64]] = []
    scores: dict[str, Score] = {}
    limit = f"render.time_limit_s={seconds}"
    for technique in TECHNIQUES:
        run = study.render(SCENE, f"confocal-{technique.label}", *common, SPOT, *technique.overrides, limit)
        scores[technique.name] = _reconstruct(study, run, technique.name, wavelength, voxels, rows, views)
    run = study.render(SCENE, "confocal-virtual-lights", *common, "render.target_error=0.01")
    scores["virtual lights"] = _reconstruct(study, run, "virtual lights", wavelength, voxels, rows, views)
    figure, axes = new_figure(1, len(views) + 1, 3 * (len(views) + 1), 3.6)
    for part, (title, view, _) in zip(axes[0], views, strict=False):
        show_wall(part, view, 1.0, title, float(view.max()))
    show_wall(axes[0, -1], views[0][2], 1.0, "true silhouette")
    columns = ("technique", "render [s]", "paths", "correlation", "IoU", "reconstruction [s]")
    best, worst = scores["both"].correlation, scores["forward path tracing"].correlation
    return PaperFigure(
        name="Figure 12",
        title="reconstruction of the hidden letters",
        reported="Phasor-field reconstructions of simulated captures: with the two techniques the hidden geometry is "
        "recovered, without them noise hides it.",
        measured=f"Correlation with the true silhouette after {seconds:g} s of rendering: both techniques {best:.3f}, "
        f"forward path tracing {worst:.3f}; virtual lights {scores['virtual lights'].correlation:.3f}.",
        pictures=(
            Picture(save(figure, study.picture("figure-12-reconstructions")), "Front views of the volumes."),
            Picture(study.picture("reconstruction-virtual-lights"), "The virtual lights' reconstruction in full."),
        ),
        tables=(Table(columns, tuple(rows), f"confocal, {side} x {side} points, wavelength {wavelength:.3g} m"),),
        checks=(
            Check("both techniques reconstruct better than forward path tracing", best > worst),
            Check("the letters are recovered: correlation of both techniques at least 0.6", best >= 0.6),
        ),
        differs="Confocal captures here; equal time instead of equal paths.",
        configurations=(SCENE,),
    )


def _reconstruct(
    study: Study,
    run: Rendered,
    name: str,
    wavelength: float,
    voxels: int,
    rows: list[tuple[str, ...]],
    views: list[tuple[str, Float64, Float64]],
) -> Score:
    study.progress(f"reconstruct {name}")
    found = reconstruct_capture(run.path, ReconstructionSettings(wavelength=wavelength, voxels=voxels))
    silhouette = true_silhouette(found.source, found.source_attributes, found.grid)
    score = score_front_view(found.front_view(), silhouette)
    draw_reconstruction(found, study.picture(f"reconstruction-{name.replace(' ', '-')}"), silhouette, score)
    views.append((f"{name}, {score.correlation:.2f}", found.front_view().astype(np.float64), silhouette))
    rows.append(
        (
            name,
            f"{run.seconds:.1f}",
            str(run.report.samples),
            f"{score.correlation:.3f}",
            f"{score.iou:.3f}",
            f"{found.seconds:.1f}",
        )
    )
    return score
