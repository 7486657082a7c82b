"""Figures 8 and 9 and Table 2: what laser sampling and hidden geometry sampling are worth, apart and together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlosrender.bench.paper.drawing import BRIGHT, new_figure, save, show_row, show_wall
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.study import Rendered, Study, relative_error, sensor_grid

SPOT_RADIUS = 0.01  # m: a laser without extent is never found by chance
SPOT = f"capture.laser_spot_radius={SPOT_RADIUS}"
PAPER_SAMPLES = 200_000  # of the paper's Table 2
LIT = 0.2  # of the bins that light reaches: what forward path tracing finds less of
REFERENCE_TIMES = 16  # samples of the reference over those of the contenders


@dataclass(frozen=True)
class Technique:
    """One of the paper's four ways to sample."""

    name: str
    laser_sampling: bool
    hidden_geometry_sampling: bool

    @property
    def label(self) -> str:
        """Its name as a part of a file's."""
        return self.name.replace(" ", "-")

    @property
    def overrides(self) -> tuple[str, ...]:
        """Keys of the configuration."""
        return (
            "render.engine=path",
            "render.target_error=null",
            f"render.laser_sampling={str(self.laser_sampling).lower()}",
            f"render.hidden_geometry_sampling={str(self.hidden_geometry_sampling).lower()}",
        )


TECHNIQUES = (
    Technique("forward path tracing", False, False),
    Technique("laser sampling", True, False),
    Technique("hidden geometry sampling", False, True),
    Technique("both", True, True),
)
FORWARD, BOTH = TECHNIQUES[0], TECHNIQUES[-1]


def ablation(study: Study, name: str, figure: str, title: str) -> PaperFigure:
    """Figures 8 and 9: the same number of paths by every technique."""
    side, spp = study.pick((48, 2048), (128, 20_000))
    common = (sensor_grid(side), SPOT)
    reference = study.render(
        name, f"{name}-reference", *common, *BOTH.overrides,
        f"render.spp={REFERENCE_TIMES * spp}", f"render.seed={study.seed + 1}",
    )  # fmt: skip
    truth = reference.light()
    rows, runs, errors, lit = [], [], {}, {}
    for technique in TECHNIQUES:
        run = study.render(name, f"{name}-{technique.label}", *common, *technique.overrides, f"render.spp={spp}")
        light = run.light()
        error = relative_error(light, truth)
        errors[technique.name] = error
        lit[technique.name] = float(np.count_nonzero(light) / np.count_nonzero(truth))
        runs.append((technique.name, run))
        rows.append(
            (
                technique.name,
                f"{run.seconds:.1f}",
                f"{error:.1%}",
                f"{error * math.sqrt(spp / PAPER_SAMPLES):.2%}",
                f"{light.sum() / truth.sum():.3f}",
                f"{lit[technique.name]:.1%}",
            )
        )
    columns = ("technique", "seconds", "relative L2 error", f"at {PAPER_SAMPLES} spp", "energy / reference", "bins lit")
    table = Table(columns, tuple(rows), f"{side} x {side} sensor points, {spp} paths each; fourth column by 1/sqrt(N)")
    order = sorted(errors, key=lambda key: errors[key])
    gain = (errors["laser sampling"] / errors["both"]) ** 2
    return PaperFigure(
        name=figure,
        title=title,
        reported="At the same number of paths forward path tracing shows almost nothing; laser sampling and hidden "
        "geometry sampling each help, and both together give a clean capture.",
        measured=f"Errors from least to most: {', '.join(f'{key} {errors[key]:.1%}' for key in order)}. Both together "
        f"need {gain:.0f} times fewer paths than laser sampling alone. The reference has an error of "
        f"{reference.report.error_estimate:.2%} ({REFERENCE_TIMES * spp} paths).",
        pictures=(_pictures(study, name, runs, reference),),
        tables=(table,),
        checks=(
            Check("both techniques together have the smallest error", order[0] == "both"),
            Check(
                f"forward path tracing leaves at least {1 - LIT:.0%} of the bins dark", lit[TECHNIQUES[0].name] < LIT
            ),
        ),
        differs="The paper's numbers are of its own scene files and machine; letters, distances and the spot of "
        f"{1000 * SPOT_RADIUS:g} mm are ours. Hidden geometry sampling is weighted against BSDF sampling by the "
        "density of the vertex that a ray really reaches, so no technique is biased by occlusion.",
        configurations=(name,),
    )


def _pictures(study: Study, name: str, runs: list[tuple[str, Rendered]], reference: Rendered) -> Picture:
    everything = [*runs, ("reference", reference)]
    figure, axes = new_figure(2, len(everything), 3.1 * len(everything), 6.4)
    edges, truth = reference.bin_edges(), reference.light()[0, 0]
    row, half_width = truth.shape[0] // 2, study.half_width(name)
    row_top, wall_top = (float(np.percentile(part, BRIGHT)) for part in (truth[row], truth.sum(axis=-1)))
    for column, (title, run) in enumerate(everything):
        light = run.light()[0, 0]
        show_row(axes[0, column], light[row], edges, half_width, title, row_top)
        show_wall(axes[1, column], light.sum(axis=-1), half_width, "sum over time", wall_top)
    caption = "Middle row over time and sum over time, on the scale of the reference, " + ", ".join(
        f"{title}: {run.seconds:.1f} s" for title, run in everything
    )
    return Picture(save(figure, study.picture(name)), caption + ".")
