"""Our HDF5_TAL files in y-tal itself (make peers)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.point_captures import cells, point_light, points_header, write_points

from nlosrender.files.export.export import export_capture

PEER = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
READ = """
import sys, numpy as np
from tal.io.capture_data import NLOSCaptureData
d = NLOSCaptureData(sys.argv[1])
np.savez(sys.argv[2], H=d.H, sensor=d.sensor_grid_xyz, laser=d.laser_grid_xyz, confocal=d.is_confocal(),
         delta_t=d.delta_t, t_start=d.t_start, legs=d.t_accounts_first_and_last_bounces,
         center=d.scene_info["volume"]["center"])
"""

pytestmark = [
    pytest.mark.peers,
    pytest.mark.skipif(not PEER.exists(), reason="y-tal is not installed: make peers puts it into .venv-peers"),
]


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_y_tal_reads_the_export(tmp_path: Path, scan: str) -> None:
    """Samples, positions, time axis and whether it is confocal arrive as they are meant."""
    header = points_header(scan, cells(5, 4, 1.0, 0.8), bins=(0.7, 0.02, 260), legs=True)
    path = write_points(tmp_path / "x.hdf5", header, [(0.1, -0.2, 0.8)])
    export_capture(path, tmp_path / "tal.hdf5", "tal", "3", legs="keep")
    environment = {"HOME": str(tmp_path), "PATH": os.environ.get("PATH", "")}
    command = [PEER, "-c", READ, tmp_path / "tal.hdf5", tmp_path / "found.npz"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr
    found = np.load(tmp_path / "found.npz")
    light = point_light(header, [(0.1, -0.2, 0.8)]).astype(np.float32).transpose(4, 1, 0, 3, 2)
    np.testing.assert_array_equal(found["H"], light if scan == "exhaustive" else light[:, 0, 0])
    np.testing.assert_allclose(found["sensor"], header.sensor_positions.transpose(1, 0, 2), atol=1e-6)
    assert found["confocal"] == (scan == "confocal")
    assert (found["delta_t"], found["t_start"], bool(found["legs"])) == (0.02, 0.7, True)
    np.testing.assert_allclose(found["center"], [0.05, 0.05, 0.85], atol=1e-6)
