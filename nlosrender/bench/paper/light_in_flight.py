"""Figures 2 and 7: what a camera sees, frame by frame; the sum of the frames is Mitsuba's steady picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.analysis.frames import FrameOptions, write_frames
from nlosrender.analysis.theme import INK
from nlosrender.bench.paper.drawing import frames_at, new_figure, save
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.steady import steady_picture, worst_deviation
from nlosrender.bench.paper.study import Float64, Rendered, Study
from nlosrender.files.layout import VARIANCE

SHOWN = 6  # frames side by side
SCENES = {
    "cornell-box": ("Figure 2", "light in flight in a Cornell box"),
    "interior-mirror": ("Figure 7", "an interior with a mirror and glass"),
    "../mitsuba-scene": ("Figure 7", "any Mitsuba scene file"),
}
REPORTED = (
    "Frames of a line-of-sight capture show light spreading over the scene; a mirror shows it later than the scene "
    "itself."
)


def light_in_flight(study: Study, name: str) -> PaperFigure:
    """Render one scene over time, compare its sum with Mitsuba's ``path``, write frames and an animation."""
    number, title = SCENES[name]
    label = name.rpartition("/")[2]
    spp = study.pick(64, 1024)
    # long enough for all bounces: the file does not say which pixel the light outside the window belongs to
    run = study.render(name, label, "render.target_error=null", f"render.spp={spp}", "time_axis.n_bins=1024")
    outside = run.report.out_of_window / (run.report.out_of_window + sum(run.report.energy.values()))
    config = study.config(name)
    study.progress(f"{label}: Mitsuba's steady picture")
    theirs, noise = steady_picture(config, 4 * spp)
    ours, variance = steady_sum(run)
    channels = len(ours)
    worst, limit, count = worst_deviation(ours, variance, theirs[:channels], noise[:channels])
    difference = float(ours.sum() / theirs[:channels].sum() - 1)
    frames = study.folder / "frames" / label
    written = write_frames(run.path, frames, FrameOptions(kind="gif"))
    write_frames(run.path, frames, FrameOptions(kind="exr", every=study.pick(16, 4)))
    rows = ((f"{worst:.2f}", f"{limit:.2f}", str(count), f"{difference:+.2%}", f"{run.report.error_estimate:.1%}"),)
    columns = ("largest |z|", "chance allows", "blocks", "difference of energy", "error of H stated")
    return PaperFigure(
        name=number,
        title=title,
        reported=REPORTED,
        measured=f"{ours.shape[2]} x {ours.shape[1]} pixels, {spp} paths each, {run.seconds:.1f} s. The sum over time "
        f"and Mitsuba's path integrator differ by {difference:+.2%} of all light ({outside:.2%} arrives too late for "
        f"the window), and by at most {worst:.2f} standard deviations in {count} blocks of 8 x 8 pixels.",
        pictures=(
            Picture(_montage(study, run, label), "Moments of the capture, each on a scale of its own."),
            Picture(written[0], "The capture as an animation."),
            Picture(frames / "steady.png", "The sum over time."),
        ),
        tables=(
            Table(columns, rows, "the sum over time against Mitsuba's steady path integrator, 4 times as many paths"),
        ),
        checks=(Check("the sum over time is Mitsuba's steady picture within noise", worst <= limit),),
        differs="The Cornell box is the one measured in 1985; the interior is generated: the paper's scenes are not "
        "ours to give on.",
        configurations=(name,),
    )


def steady_sum(run: Rendered) -> tuple[Float64, Float64]:
    """Return the sum over bounces and time and its variance, (channel, row, column) each, rows upwards."""
    return run.summed((1, 6))[:, 0, 0], run.summed((1, 6), VARIANCE)[:, 0, 0]


def _montage(study: Study, run: Rendered, label: str) -> Path:
    light, edges = run.summed(1)[:, 0, 0], run.bin_edges()  # (channel, row, column, bin)
    figure, axes = new_figure(1, SHOWN, 15, 3)
    frames = frames_at(light, np.linspace(0.05, 0.9, SHOWN), light.sum(axis=(0, 1, 2)), 0.005)
    for part, (moment, channels) in zip(axes[0], frames, strict=True):
        frame = np.moveaxis(channels, 0, -1)
        top = np.percentile(frame[frame > 0], 98) if (frame > 0).any() else 1.0
        shown = np.clip(frame / top, 0, 1) ** (1 / 2.2)
        part.imshow(np.repeat(shown, 3, axis=-1) if shown.shape[-1] == 1 else shown, origin="lower")
        part.set_title(f"{edges[moment]:.2f} m", color=INK, size=10)
        part.set(xticks=[], yticks=[])
    return save(figure, study.picture(f"light-in-flight-{label}"))
