"""However large the capture, the process stays within ``render.memory_limit``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from support.render_processes import plate_scene

LIMIT = 600e6
SCENE = plate_scene("""\
capture:
  scan_type: exhaustive
  sensor_grid: {nx: 32, ny: 24}
  laser_grid: {nx: 16, ny: 12}
time_axis: {bin_width_opl: 0.003, n_bins: 2048}
render: {max_bounces: 3, engine: ENGINE, spp: SPP, target_error: ERROR, memory_limit: 600MB}
output: {path: a.hdf5}
""")
# what the process itself says of its largest resident set, once the command is done
MEASURED = (
    "import resource, sys; from nlosrender.cli.app import app\n"
    "try: app()\n"
    "except SystemExit as end:\n"
    "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, file=sys.stderr); raise"
)


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "spp", "error"), [("path", "2", "null"), ("virtual_lights", "null", "0.5")])
def test_a_capture_ten_times_the_limit(tmp_path: Path, engine: str, spp: str, error: str) -> None:
    """147,456 pairs of points x 2048 bins x 6 bounces x 4 bytes are 7.2 GB, without the variance."""
    text = SCENE.replace("ENGINE", engine).replace("SPP", spp).replace("ERROR", error)
    (tmp_path / "scene.yaml").write_text(text)
    command = [sys.executable, "-c", MEASURED, "render", "scene.yaml", "--json"]
    done = subprocess.run(command, cwd=tmp_path, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["units"] > 10
    peak = float(done.stderr.strip().splitlines()[-1])
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].size * 4 > 10 * LIMIT
        assert file["data"].id.get_num_chunks() > 100
    assert peak < LIMIT
