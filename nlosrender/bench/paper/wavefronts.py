"""Figures 1 and 4: a captured wavefront, and its arrival marked against the geometry it came from."""

from __future__ import annotations

import numpy as np

from nlosrender.analysis.theme import MARK
from nlosrender.bench.paper.drawing import frames_at, new_figure, save, show_row, show_wall
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture
from nlosrender.bench.paper.study import Float64, Rendered, Study, sensor_grid
from nlosrender.capture.grids import build_capture
from nlosrender.rendering import stages
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

SPACING = 0.01  # m between the points that arrivals are looked for at: ways of 2 m are then right to 0.02 mm
FRAMES = 4


def z_letter(study: Study) -> PaperFigure:
    """Figure 4: the first light of every sensor point lands in the bin of the shortest way over the letter."""
    grid = sensor_grid(*study.pick((48, 40), (128, 128)))
    rendered = study.render("z-letter", "z-letter", grid)
    light, edges = rendered.light()[0, 0], rendered.bin_edges()
    first, last = arrivals(study, "z-letter", grid)
    row = light.shape[0] // 2
    lit = light > 0
    found_first = lit.argmax(axis=-1)
    found_last = lit.shape[-1] - 1 - lit[..., ::-1].argmax(axis=-1)
    width = edges[1] - edges[0]
    off_first = found_first - np.floor((first - edges[0]) / width)
    off_last = found_last - np.floor((last - edges[0]) / width)
    worst = int(max(np.abs(off_first).max(), np.abs(off_last).max()))
    exact = float((off_first == 0).mean())
    return PaperFigure(
        name="Figure 4",
        title="a letter Z and its wavefronts",
        reported="The capture of a letter Z on the relay wall over time: the wavefronts of its strokes, one after "
        "the other.",
        measured=f"{rendered.report.engine}, error estimate {rendered.report.error_estimate:.2%}, "
        f"{rendered.seconds:.2f} s. The first and the last light of {first.size} sensor points are at most {worst} "
        f"bin(s) of {1000 * width:g} mm from the shortest and the longest way over the letter; the first in exactly "
        f"its bin at {exact:.1%} of the points.",
        pictures=(_picture(study, "z-letter", rendered, "figure-4-z-letter", first[row], last[row]),),
        checks=(Check("first and last light within one bin of the geometry's at every sensor point", worst <= 1),),
        configurations=("z-letter",),
    )


def captured_letters(study: Study) -> PaperFigure:
    """Figure 1: what a capture of hidden letters looks like."""
    grid = sensor_grid(study.pick(64, 256))
    rendered = study.render("letters-near", "letters-virtual-lights", grid)
    ny, nx = rendered.light().shape[2:4]
    middle = ny // 2
    first, last = arrivals(study, "letters-near", grid, rows=slice(middle, middle + 1))
    return PaperFigure(
        name="Figure 1",
        title="captured data of hidden letters",
        reported="A laser and a sensor look at a relay wall; the light of the hidden letters crosses it as wavefronts.",
        measured=f"{rendered.report.engine}, error estimate {rendered.report.error_estimate:.2%}, "
        f"{rendered.seconds:.2f} s for {ny * nx} sensor points of {len(rendered.bin_edges()) - 1} bins.",
        pictures=(_picture(study, "letters-near", rendered, "figure-1-letters", first[0], last[0]),),
        configurations=("letters-near",),
    )


def arrivals(study: Study, name: str, *overrides: str, rows: slice = slice(None)) -> tuple[Float64, Float64]:
    """Return the shortest and the longest way laser point -> hidden surface -> sensor point, (y, x) each [m].

    Of the sensor points in ``rows``. Occlusion is not looked at: of a thick letter the sides count as well.
    """
    config = study.config(name, *overrides)
    wall, surfaces = stages.place_scene(config)
    capture = build_capture(config.capture, wall)
    meshes = [surface.shape for surface in surfaces if isinstance(surface.shape, TriangleMesh)]
    points = np.concatenate([_points_on(mesh) for mesh in meshes])
    to_laser = np.linalg.norm(points - capture.laser_grid.positions.reshape(-1, 3)[0], axis=-1)
    sensors = capture.sensor_grid.positions[rows]
    ends = np.empty((2, sensors.shape[0] * sensors.shape[1]))
    for number, sensor in enumerate(sensors.reshape(-1, 3)):  # one by one: all ways at once may be 10 GB
        ways = np.linalg.norm(points - sensor, axis=-1) + to_laser
        ends[:, number] = ways.min(), ways.max()
    first, last = ends.reshape(2, *sensors.shape[:2])
    return first, last


def _points_on(mesh: TriangleMesh) -> Float64:
    """Return points all over the faces, corners and edges among them, (n, 3)."""
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    parts = np.ceil(edges / SPACING).astype(int)
    points = []
    for count in np.unique(parts):
        steps = np.arange(count + 1) / count
        u, v = (side.ravel()[:, None] for side in np.meshgrid(steps, steps))
        inside = (u + v <= 1 + 1e-9)[:, 0]
        a, b, c = np.moveaxis(corners[parts == count], 1, 0)[:, :, None]
        points.append((a + (b - a) * u[inside] + (c - a) * v[inside]).reshape(-1, 3))
    return np.unique(np.concatenate(points).round(9), axis=0)


def _picture(study: Study, configuration: str, rendered: Rendered, name: str, first: Float64, last: Float64) -> Picture:
    light, edges = rendered.light()[0, 0], rendered.bin_edges()
    figure, axes = new_figure(1, FRAMES + 1, 15, 3.6)
    half_width = study.half_width(configuration)
    row = light.shape[0] // 2
    frames = frames_at(light, np.linspace(0.08, 0.75, FRAMES), light.sum(axis=(0, 1)), 0.01)
    for part, (moment, frame) in zip(axes[0], frames, strict=False):
        show_wall(part, frame, half_width, f"wall at {edges[moment]:.2f} m")
    show_row(axes[0, -1], light[row], edges, half_width, "middle row over time")
    x = (np.arange(light.shape[1]) + 0.5) / light.shape[1] * 2 * half_width - half_width
    axes[0, -1].plot(first, x, color=MARK, lw=1, label="first")
    axes[0, -1].plot(last, x, color=MARK, lw=1, ls=":", label="last")
    caption = (
        "The wall at four moments, and its middle row over time; lines: the shortest (solid) and longest (dotted) "
        "way over the hidden geometry."
    )
    return Picture(save(figure, study.picture(name)), caption)
