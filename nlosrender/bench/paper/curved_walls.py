"""Relay walls that are no planes: sphere, cylinder and mesh, by both engines."""

from __future__ import annotations

from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
from nlosrender.analysis.theme import FAINT
from nlosrender.bench.paper.drawing import new_figure, save, show_row
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.study import Rendered, Study

WALLS = {"sphere-wall": "sphere, from within", "cylinder-wall": "column", "../mesh-wall": "wavy mesh"}
SIGNIFICANCE = 0.01


def curved_walls(study: Study) -> PaperFigure:
    """Render every wall with both engines and hold them against each other, bounce by bounce."""
    target = study.pick(0.03, 0.01)
    rows, checks, pictures = [], [], []
    figure, axes = new_figure(len(WALLS), 2, 11, 3.2 * len(WALLS))
    for line, (name, title) in zip(axes, WALLS.items(), strict=True):
        label = name.rpartition("/")[2]
        common = f"render.target_error={target}"
        lights = study.render(name, f"{label}-lights", common, "render.engine=virtual_lights")
        paths = study.render(name, f"{label}-paths", common, "render.engine=path", f"render.seed={study.seed + 1}")
        found = compare_captures(lights.path, paths.path, Tolerances(significance=SIGNIFICANCE))
        total, other = (sum(run.report.energy.values()) for run in (lights, paths))
        z, limit = (found.test.z, found.test.limit) if found.test else (0.0, 0.0)
        rows.append(
            (
                title,
                lights.report.engine,
                _times(lights),
                _times(paths),
                f"{total / other - 1:+.2%}",
                f"{z:.2f} of {limit:.2f}",
            )
        )
        checks.append(Check(f"{title}: the engines agree in every bin, point and bounce", not found.failures))
        for part, run in zip(line, (lights, paths), strict=True):
            light = run.light()[0, 0]
            show_row(part, light[light.shape[0] // 2], run.bin_edges(), 0.5, f"{title}: {run.report.engine}")
            part.set_ylabel("middle row, share of its width", color=FAINT)
    pictures.append(Picture(save(figure, study.picture("curved-walls")), "The middle row of each wall over time."))
    columns = ("wall", "engine", "virtual lights", "path engine", "difference of energy", "largest |z|")
    return PaperFigure(
        name="Section 4",
        title="relay walls that are no planes",
        reported="The method takes any parametrisable surface as relay wall.",
        measured="Both engines, bounce by bounce: "
        + "; ".join(f"{row[0]}: energy {row[4]}, largest |z| {row[5]}" for row in rows)
        + ".",
        pictures=tuple(pictures),
        tables=(Table(columns, tuple(rows), f"times for a relative L2 error of {target:.0%}, and the error stated"),),
        checks=tuple(checks),
        configurations=tuple(WALLS),
    )


def _times(run: Rendered) -> str:
    return f"{run.seconds:.1f} s, {run.report.error_estimate:.2%}"
