"""Table 1: the scenes, their triangles, and what stands in for those that are not shipped."""

from __future__ import annotations

from nlosrender.bench.paper.figure import PaperFigure, Table
from nlosrender.bench.paper.rooms import ROOMS, write_mesh
from nlosrender.bench.paper.study import Study
from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

OWN = {
    "z-letter": "the Z letter",
    "letters-near": "NLOS letters, close",
    "letters-far": "NLOS letters, three times as far",
    "room-statue": "a closed room with a scanned statue (Lucy, White room)",
    "room-furniture": "a closed, furnished room (Bathroom, Bistro)",
}
PLUG_IN = (
    "Bistro, Bathroom, Lucy and White room are not shipped: their licences are not ours to give on. A user who has "
    "them names the file: a mesh as hidden geometry, {type: mesh, filename: lucy.ply, scale: 0.001}; a whole Mitsuba "
    "scene of a line-of-sight capture as scene: {mitsuba: scene.xml}."
)


def scenes_table(study: Study) -> PaperFigure:
    """Load every scene and count its triangles."""
    rows = []
    meshes = {room.config: write_mesh(study, room) for room in ROOMS}
    for name, stands_for in OWN.items():
        overrides = (f"scene.hidden_geometry.1.filename={meshes[name]}",) if name in meshes else ()
        config = study.config(name, *overrides)
        start_backend(config.render.backend, colored=config.is_colored)
        built = stages.load_scene(config)
        grid = config.capture.sensor_grid
        points = "" if grid is None else f"{grid.nx} x {grid.ny}"
        rows.append((name, stands_for, f"{built.n_triangles:,}", points, str(config.time_axis.n_bins)))
    columns = ("configuration", "stands for", "triangles", "sensor points", "bins")
    total = len(rows)
    return PaperFigure(
        name="Table 1",
        title="the scenes",
        reported="The scenes with their triangle counts, from letters of a few triangles to interiors of a million.",
        measured=f"{total} scenes for captures of hidden geometry, counted as loaded.",
        tables=(Table(columns, tuple(rows)),),
        differs=PLUG_IN,
        configurations=tuple(OWN),
    )
