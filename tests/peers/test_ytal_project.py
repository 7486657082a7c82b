"""A project of y-tal from import to its own reader and back-projection (make peers)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.commands import run

PEER = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
PROJECT = """
name: plate
scan_type: exhaustive
sensor_width: 7
sensor_height: 5
laser_width: 3
laser_height: 2
laser_aperture_start_x: 0.1
laser_aperture_end_x: APERTURE
num_bins: 200
bin_width_opl: 0.02
start_opl: 0.5
geometry:
- name: plate
  mesh: {type: obj, filename: plate.obj}
  displacement_x: 0.3
  displacement_y: -0.2
  displacement_z: 0.8
  rot_degrees_x: 180
  scale_x: 0.1
  scale_y: 0.1
  material: {id: white}
- name: wall
  mesh: {type: rectangle}
  scale_x: 1
  scale_y: 0.8
  material: {id: white}
relay_wall: wall
"""
READ = """
import sys, numpy as np
from tal.io import read_capture
from tal.reconstruct import bp
from tal.render.util import get_grid_xyz
d, end = read_capture(sys.argv[1]), float(sys.argv[3])
x, y, z = (np.linspace(a, b, n) for a, b, n in ((-0.7, 0.7, 15), (-0.6, 0.6, 13), (0.5, 1.1, 7)))
volume = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
found = bp.solve(d, volume, progress=False)
np.savez(sys.argv[2], H=d.H, sensors=d.sensor_grid_xyz, lasers=d.laser_grid_xyz, delta_t=d.delta_t, t_start=d.t_start,
         legs=d.t_accounts_first_and_last_bounces, peak=volume[np.unravel_index(np.abs(found).argmax(), found.shape)],
         its_sensors=get_grid_xyz(7, 5, 1, 0.8), its_lasers=get_grid_xyz(3, 2, 1, 0.8, 0.1, end))
"""

pytestmark = [
    pytest.mark.peers,
    pytest.mark.skipif(not PEER.exists(), reason="y-tal is not installed: make peers puts it into .venv-peers"),
]


@pytest.mark.parametrize("end", [0.9, 0.7])
def test_a_project_goes_through(tmp_path: Path, end: float) -> None:
    """Points and time are those that y-tal gives the project, and its back-projection finds the plate in our H."""
    (tmp_path / "plate").mkdir()
    (tmp_path / "plate.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n")
    (tmp_path / "plate/plate.yaml").write_text(PROJECT.replace("APERTURE", str(end)))
    for words in (
        ("import", "plate/plate.yaml", "-o", "z.yaml"),
        ("plan", "z.yaml"),
        ("render", "z.yaml", "-o", "z.hdf5", "-q"),
        ("export", "z.hdf5", "-o", "tal.hdf5", "--format", "tal"),
    ):
        done = run(tmp_path, *words)
        assert done.returncode == 0, done.stderr
    environment = {"HOME": str(tmp_path), "PATH": os.environ.get("PATH", "")}
    command = [PEER, "-c", READ, tmp_path / "tal.hdf5", tmp_path / "found.npz", str(end)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "found.npz")
    lasers = (3, 2) if end == 0.9 else (6, 1)  # a list where the aperture is not centred: row by row
    assert found["H"].shape == (200, *lasers, 7, 5)
    np.testing.assert_allclose(found["sensors"], found["its_sensors"], atol=1e-6)
    np.testing.assert_allclose(found["lasers"].reshape(*lasers, 3), as_list(found["its_lasers"], lasers), atol=1e-6)
    assert (found["delta_t"], found["t_start"], bool(found["legs"])) == (0.02, 0.5, False)
    np.testing.assert_allclose(found["peak"], [0.3, -0.2, 0.8], atol=0.1)  # a voxel


def as_list(grid: np.ndarray, lasers: tuple[int, int]) -> np.ndarray:
    """Return a grid (x, y, 3) as it is, or row by row as (n, 1, 3)."""
    return grid if grid.shape[:2] == lasers else grid.transpose(1, 0, 2).reshape(*lasers, 3)
