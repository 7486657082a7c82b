"""Figure 10: closed rooms with half a million and with 1.2 million triangles, all bounces."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlosrender.bench.paper.drawing import new_figure, save, show_row, show_wall
from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.room_meshes import write_furniture, write_statue
from nlosrender.bench.paper.study import Rendered, Study, sensor_grid


@dataclass(frozen=True)
class Room:
    """A closed room: its configuration and what stands in it."""

    config: str
    n_triangles: int
    write: Callable[[Path, int], None]


ROOMS = (Room("room-statue", 500_000, write_statue), Room("room-furniture", 1_200_000, write_furniture))


def closed_rooms(study: Study) -> PaperFigure:
    """Render both rooms with all their bounces."""
    side = study.pick(24, 256)
    target = 0.1
    rows, runs = [], []
    for room in ROOMS:
        mesh = write_mesh(study, room)
        run = study.render(
            room.config,
            room.config,
            f"scene.hidden_geometry.1.filename={mesh}",
            sensor_grid(side),
            f"render.target_error={target}",
        )
        runs.append((room.config, run))
        report = run.report
        shares = [f"{energy / sum(report.energy.values()):.0%}" for energy in report.energy.values()]
        rows.append(
            (
                room.config,
                f"{report.n_triangles:,}",
                report.engine,
                f"{report.seconds['scene']:.1f}",
                f"{report.seconds['render']:.1f}",
                f"{report.error_estimate:.2%}",
                " ".join(shares[1:]),
            )
        )
    columns = ("room", "triangles", "engine", "load [s]", "render [s]", "error stated", "energy of bounce 3, 4, ...")
    return PaperFigure(
        name="Figure 10",
        title="closed rooms",
        reported="Captures of closed rooms with hundreds of thousands of triangles and all their bounces, the relay "
        "wall being one of the walls.",
        measured="; ".join(
            f"{name}: {run.report.n_triangles:,} triangles, {side} x {side} points, {run.seconds:.1f} s for an error "
            f"of {run.report.error_estimate:.1%} ({run.report.engine})"
            for name, run in runs
        )
        + ".",
        pictures=(_picture(study, runs),),
        tables=(Table(columns, tuple(rows), "all bounces; index 7 holds bounce 7 and above"),),
        checks=tuple(
            Check(
                f"{name}: the error stated is at most the {target:.0%} asked for", run.report.error_estimate <= target
            )
            for name, run in runs
        ),
        differs="The paper's models are scans and artists' scenes under licences of their own; a generated statue and "
        "generated furniture of as many triangles stand in for them.",
        configurations=tuple(room.config for room in ROOMS),
    )


def write_meshes(study: Study, rooms: Iterable[Room] = ROOMS) -> list[Path]:
    """Write the meshes that the rooms' configurations name, where they are not there yet, and return their paths.

    Raises
    ------
    FileError
        A folder or file cannot be written.
    """
    study.make_folders()
    return [write_mesh(study, room) for room in rooms]


def write_mesh(study: Study, room: Room) -> Path:
    """Write a room's mesh, whole or not at all, unless it is there; return its path.

    Raises
    ------
    FileError
        The file cannot be written.
    """
    path = study.folder / "meshes" / f"{room.config}.ply"
    if not path.exists():
        study.progress(str(path))
        room.write(path, room.n_triangles)
    return path.resolve()


def _picture(study: Study, runs: list[tuple[str, Rendered]]) -> Picture:
    figure, axes = new_figure(len(runs), 3, 12, 3.6 * len(runs))
    for line, (name, run) in zip(axes, runs, strict=True):
        light, edges = run.light()[0, 0], run.bin_edges()
        moment = int(np.argmax(light.sum(axis=(0, 1))))
        show_wall(line[0], light.sum(axis=-1), 1.0, f"{name}: sum over time")
        show_wall(line[1], light[..., moment : moment + 3].sum(axis=-1), 1.0, f"at {edges[moment]:.2f} m")
        show_row(line[2], light[light.shape[0] // 2], edges, 1.0, "middle row over time")
    return Picture(save(figure, study.picture("figure-10-rooms")), "The relay wall of the closed rooms.")
