"""``validate``, ``plan`` and ``info`` say of each mesh what has been read, in a line and as JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from support.commands import run

CONFIG = """
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: mesh, filename: plate.obj, name: plate, bsdf: {type: diffuse, reflectance: 0.5}}
capture: {scan_type: single, sensor_grid: {nx: 3, ny: 2}}
time_axis: {bin_width_opl: 0.1, n_bins: 60}
render: {max_bounces: 3, spp: 4}
output: {path: a.hdf5}
"""
PLATE = (
    "v -0.1 -0.1 0.8\nv -0.1 0.3 0.8\nv 0.5 0.3 0.8\nv 0.5 -0.1 0.8\nusemtl red\nf 1 2 3\nusemtl blue\nf 1 4 3\nl 1 2\n"
)
LINE = (
    "plate (plate.obj): 2 triangles, 0.24 m^2, 0.6 x 0.4 x 0 m, 50 % of its area faces the wall, flat, faces disagree "
    "at 1 of 1 edges, no texture coordinates, materials not read: red, blue, left out: 1 lines"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A plate, one of whose two triangles is turned away from the wall."""
    (tmp_path / "plate.obj").write_text(PLATE)
    (tmp_path / "a.yaml").write_text(CONFIG)
    return tmp_path


def test_every_command_has_the_same_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the file's text, worked out by hand; the warnings come with each of them."""
    from nlosrender.engine.backend import start as backend

    backend.start_backend("llvm")
    from nlosrender.engine.interface import PilotSeconds
    from nlosrender.engine.preflight import time_estimate

    quick = partial(time_estimate.estimate_render_time, pilot=PilotSeconds(tracing=0.02))
    monkeypatch.setattr(time_estimate, "estimate_render_time", quick)
    checked, planned = run(folder, "validate", "a.yaml"), run(folder, "plan", "a.yaml")
    rendered = run(folder, "render", "a.yaml", "--quiet")
    for done in (checked, planned, rendered):
        assert done.returncode == 0
        assert "(plate): at 1 of its 1 edges the two faces disagree which side is the front" in done.stderr
        assert "its faces have 2 materials (red, blue), which are not read" in done.stderr
    for text in (checked.stdout, planned.stdout, run(folder, "info", "a.hdf5").stdout):
        assert LINE in text
    for command in (("validate", "a.yaml"), ("plan", "a.yaml"), ("info", "a.hdf5")):
        (mesh,) = json.loads(run(folder, *command, "--json").stdout)["meshes"]
        assert (mesh["name"], mesh["triangles"], mesh["disagreeing_edges"]) == ("plate", 2, 1)
        assert (mesh["materials"], mesh["facing_share"]) == (["red", "blue"], pytest.approx(0.5))


def test_validate_reads_meshes_without_mitsuba(folder: Path) -> None:
    """A damaged mesh is found with its place in the configuration and its line, in seconds."""
    (folder / "plate.obj").write_text(PLATE.replace("f 1 4 3", "f 1 4 9"))
    done = run(folder, "validate", "a.yaml")
    assert done.returncode == 3
    assert "a.yaml:5:30: scene.hidden_geometry.0.filename: " in done.stderr
    assert "line 8, 'f 1 4 9', refers to a vertex that is not there" in done.stderr
    (folder / "plate.obj").write_text(PLATE)
    code = (
        "import sys; from nlosrender.cli.app import app\nsys.argv = ['nlosrender', 'validate', 'a.yaml']\n"
        "try: app()\nexcept SystemExit as end: sys.exit(end.code or 'mitsuba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=folder, check=False, capture_output=True).returncode == 0
