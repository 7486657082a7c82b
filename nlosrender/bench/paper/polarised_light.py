"""Figure 13: Stokes components over time and in the steady state."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.analysis.frames import FrameOptions, write_frames
from nlosrender.analysis.pictures import degree_of_polarization, signed_colors
from nlosrender.analysis.theme import INK
from nlosrender.bench.paper.drawing import frames_at, new_figure, save
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.light_in_flight import steady_sum
from nlosrender.bench.paper.steady import steady_picture, worst_deviation
from nlosrender.bench.paper.study import Float64, Rendered, Study

SCENE = "polarised-cornell-box"
COMPONENTS = ("I", "Q", "U", "V")
MOMENTS = 4  # shown, and the steady state below them
SIGNED_SCALE = 10.0  # Q, U and V are shown so much brighter than I
ROUNDING = 1e-4  # of float32 Mueller matrices: a degree of polarisation may pass 1 by it


def polarised_light(study: Study) -> PaperFigure:
    """Render a box with glass, gold and a bubble; compare every Stokes component with Mitsuba's ``stokes``."""
    spp = study.pick(64, 1024)
    run = study.render(SCENE, SCENE, "render.target_error=null", f"render.spp={spp}", "time_axis.n_bins=512")
    study.progress(f"{SCENE}: Mitsuba's stokes integrator")
    theirs, noise = steady_picture(study.config(SCENE), 4 * spp)
    ours, variance = steady_sum(run)
    rows, checks = [], []
    for number, name in enumerate(COMPONENTS):
        part = slice(number, number + 1)
        worst, limit, count = worst_deviation(ours[part], variance[part], theirs[part], noise[part])
        size = float(np.abs(ours[number]).sum() / ours[0].sum())
        rows.append((name, f"{size:.2%}", f"{worst:.2f}", f"{limit:.2f}", str(count)))
        checks.append(Check(f"{name} summed over time is Mitsuba's within noise", worst <= limit))
    stokes = np.moveaxis(ours, 0, -1)
    highest = float((np.linalg.norm(stokes[..., 1:], axis=-1) / np.maximum(stokes[..., 0], 1e-30)).max())
    checks.append(Check("no pixel is more than fully polarised", highest <= 1 + ROUNDING))
    frames = study.folder / "frames" / SCENE
    written = write_frames(run.path, frames, FrameOptions(kind="gif"))
    columns = ("component", "share of the light", "largest |z|", "chance allows", "blocks")
    return PaperFigure(
        name="Figure 13",
        title="polarised light in flight",
        reported="Stokes components over time and in the steady state of a Cornell box with a dielectric, a conductor "
        "and a thin dielectric, in false colours: green above zero, red below.",
        measured=f"{ours.shape[2]} x {ours.shape[1]} pixels, {spp} paths each, {run.seconds:.1f} s. The most polarised "
        f"pixel has a degree of {highest:.3f}.",
        pictures=(
            Picture(_montage(study, run), "I, Q, U, V at four moments and in the steady state (below)."),
            Picture(written[0], "I, Q, U above; V, degree and angle of polarisation below, over time."),
        ),
        tables=(Table(columns, tuple(rows), "the sum over time against Mitsuba's stokes integrator, blocks of 8 x 8"),),
        checks=tuple(checks),
        configurations=(SCENE,),
    )


def _montage(study: Study, run: Rendered) -> Path:
    light, edges = run.summed(1)[:, 0, 0], run.bin_edges()  # (component, row, column, bin)
    frames = frames_at(light, np.linspace(0.3, 0.85, MOMENTS), light[0].sum(axis=(0, 1)), 0.005)
    shown = [(f"{edges[moment]:.2f} m", frame) for moment, frame in frames]
    shown.append(("steady", light.sum(axis=-1)))
    figure, axes = new_figure(len(shown), 5, 12, 2.4 * len(shown))
    for line, (title, stokes) in zip(axes, shown, strict=True):
        for part, name, picture in zip(line, (*COMPONENTS, "degree"), _colored(stokes), strict=True):
            part.imshow(picture, origin="lower", cmap="gray", vmin=0, vmax=1)
            part.set_title(f"{name}, {title}", color=INK, size=9)
            part.set(xticks=[], yticks=[])
    return save(figure, study.picture("figure-13-stokes"))


def _colored(stokes: Float64) -> list[np.ndarray]:
    """Return five pictures of (component, row, column): intensity, three signed components, degree."""
    lit = stokes[0][stokes[0] > 0]
    top = float(np.percentile(lit, 97)) if lit.size else 1.0
    signed = [signed_colors((SIGNED_SCALE * part / top).astype(np.float32)) for part in stokes[1:]]
    degree = degree_of_polarization(np.moveaxis(stokes, 0, -1).astype(np.float32))
    return [np.clip(stokes[0] / top, 0, 1) ** (1 / 2.2), *signed, degree]
