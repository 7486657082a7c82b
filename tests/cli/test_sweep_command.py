"""``render``, ``plan`` and ``validate`` of a configuration with a sweep."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.commands import run

from nlosrender.config.load import config_hash, load_document
from nlosrender.config.sweep_load import sweep_of
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_OK, EXIT_USAGE

BASE = """\
name: plates
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9], bsdf: {type: diffuse, reflectance: 0.7}}
capture: {scan_type: single, sensor_grid: {nx: 4, ny: 3}}
time_axis: {bin_width_opl: 0.05, n_bins: 130}
render: {max_bounces: 3, spp: 32, engine: path}
"""
SWEEP = """\
sweep:
  keys: {capture.laser_point: [[0, 0], [0.3, 0.2]]}
  random: {count: 2, keys: {scene.hidden_geometry.0.center.2: {uniform: [0.7, 1.2]}}}
"""


def write(folder: Path, sweep: str = SWEEP, base: str = BASE) -> Path:
    """Write a configuration with a sweep."""
    path = folder / "set.yaml"
    path.write_text(base + sweep)
    return path


def index_of(folder: Path, name: str = "plates/index.json") -> dict[str, Any]:
    """Read an index."""
    return json.loads((folder / name).read_text())


def samples_of(path: Path) -> np.ndarray:
    """Read the samples of a capture."""
    with h5py.File(path) as file:
        return file["data"][...]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rendered sweep of 2 x 2 captures; not to be changed."""
    folder = tmp_path_factory.mktemp("sweep")
    done = run(folder, "render", write(folder), "--json")
    assert done.returncode == EXIT_OK, done.stderr
    report = json.loads(done.stdout)
    assert (report["captures"], report["rendered"], report["earlier"], report["failed"]) == (4, 4, 0, [])
    return folder


def test_captures_are_those_of_single_renders(dataset: Path, tmp_path: Path) -> None:
    """A capture of a sweep is, bit for bit, the one that --set makes of the same file."""
    entry = index_of(dataset)["captures"][3]
    overrides = [f"{key}={json.dumps(value)}" for key, value in entry["values"].items()]
    settings = [part for override in overrides for part in ("--set", override)]
    done = run(tmp_path, "render", write(tmp_path, ""), *settings, "-o", "alone.hdf5", "-q")
    assert done.returncode == EXIT_OK, done.stderr
    assert np.array_equal(samples_of(tmp_path / "alone.hdf5"), samples_of(dataset / "plates" / entry["file"]))


def test_the_index_tells_what_the_files_hold(dataset: Path) -> None:
    """Files, values, hashes, energies: the index says what is in the captures beside it."""
    index = index_of(dataset)
    assert index["keys"] == ["capture.laser_point", "scene.hidden_geometry.0.center.2"]
    assert [entry["file"] for entry in index["captures"]] == [f"{i:05d}.hdf5" for i in range(4)]
    sweep = sweep_of(load_document(dataset / "set.yaml"))
    assert sweep is not None
    for number, entry in enumerate(index["captures"]):
        assert entry["status"] == "done"
        assert entry["values"] == sweep.values(number)
        assert entry["config_hash"] == config_hash(sweep.config(number))
        energy = samples_of(dataset / "plates" / entry["file"]).sum(dtype=float)
        assert energy > 0
        # float32 samples: the sum of n of them is off by less than n * 6e-8 of it
        assert sum(entry["energy"].values()) == pytest.approx(energy, rel=1e-5)
        assert 0 < entry["error_estimate"] < 1
        assert entry["seconds"] > 0
    depths = [entry["values"]["scene.hidden_geometry.0.center.2"] for entry in index["captures"]]
    assert len({entry["capture_hash"] for entry in index["captures"]}) == 4
    assert depths[:2] == depths[2:]


def test_what_is_there_is_not_rendered_again(dataset: Path, tmp_path: Path) -> None:
    """A second run renders what is missing or damaged, and nothing else; what is of another configuration, or a part,
    is replaced when --overwrite says so."""
    subprocess.run(["cp", "-r", f"{dataset}/.", str(tmp_path)], check=True)
    files = sorted((tmp_path / "plates").glob("*.hdf5"))
    files[1].unlink()
    files[2].write_bytes(files[2].read_bytes()[:5000])
    with h5py.File(files[3], "r+") as file:
        file.attrs["part"] = "{}"
    stamp = files[0].stat().st_mtime_ns
    done = run(tmp_path, "render", "set.yaml", "--json")
    assert (done.returncode, "a part of it there, the whole capture now" in done.stderr) == (EXIT_BAD_INPUT, True)
    files[3].unlink()
    report = json.loads(run(tmp_path, "render", "set.yaml", "--json").stdout)
    assert (report["rendered"], report["earlier"]) == (3, 1)
    assert files[0].stat().st_mtime_ns == stamp
    for path in files:
        assert np.array_equal(samples_of(path), samples_of(dataset / "plates" / path.name))
    done = run(tmp_path, "render", "set.yaml", "--json", "--set", "render.spp=16")
    assert (done.returncode, "holds another capture (render.spp: " in done.stderr) == (EXIT_BAD_INPUT, True)
    report = json.loads(run(tmp_path, "render", "set.yaml", "--json", "--set", "render.spp=16", "--overwrite").stdout)
    assert (report["rendered"], report["earlier"]) == (4, 0)


def test_resume_needs_something(dataset: Path, tmp_path: Path) -> None:
    """--resume with nothing there is a mistake; with everything there it has nothing to do."""
    done = run(tmp_path, "render", write(tmp_path), "--resume")
    assert done.returncode == EXIT_BAD_INPUT
    assert "holds nothing of this sweep to resume" in done.stderr
    assert run(dataset, "render", "set.yaml", "--resume").returncode == EXIT_OK


def test_shards_deal_whole_captures(dataset: Path, tmp_path: Path) -> None:
    """Three shards render every capture once, each with an index of its own; a last run indexes them all."""
    config = write(tmp_path)
    for number, files in ((1, ["00000", "00003"]), (2, ["00001"]), (3, ["00002"])):
        done = run(tmp_path, "render", config, "--shard", f"{number}/3", "--json")
        assert done.returncode == EXIT_OK, done.stderr
        index = index_of(tmp_path, f"plates/index-{number}-of-3.json")
        assert [entry["file"] for entry in index["captures"]] == [f"{name}.hdf5" for name in files]
    assert not (tmp_path / "plates/index.json").exists()
    report = json.loads(run(tmp_path, "render", config, "--json").stdout)
    assert (report["rendered"], report["earlier"]) == (0, 4)
    for entry, other in zip(index_of(tmp_path)["captures"], index_of(dataset)["captures"], strict=True):
        assert entry["energy"] == other["energy"]
    done = run(tmp_path, "render", config, "--shard", "1/5")
    assert (done.returncode, "at most as many shards" in done.stderr) == (EXIT_USAGE, True)
    assert run(tmp_path, "render", config, "--lasers", "0:1").returncode == EXIT_USAGE


def test_one_capture_that_fails(tmp_path: Path) -> None:
    """A mesh that cannot be read fails its capture alone; the others are rendered, and the exit code is 1."""
    (tmp_path / "bad.ply").write_text("no mesh")
    sweep = """\
sweep:
  keys:
    scene.hidden_geometry.0:
      - {type: mesh, filename: bad.ply}
      - {type: sphere, center: [0, 0, 1], radius: 0.2}
"""
    done = run(tmp_path, "render", write(tmp_path, sweep))
    assert done.returncode == EXIT_FAILURE
    assert "1 of 2 captures failed" in done.stderr
    assert "bad.ply" in done.stderr
    assert [entry["status"] for entry in index_of(tmp_path)["captures"]] == ["failed", "done"]


def test_mistakes_come_before_the_first_render(tmp_path: Path) -> None:
    """All captures are validated first: nothing is created when the last one is wrong."""
    path = write(tmp_path, "sweep: {keys: {render.seed: [1, 2, -3]}}\n")
    for command in ("render", "plan", "validate"):
        done = run(tmp_path, command, path)
        assert done.returncode == EXIT_BAD_INPUT
        assert "set.yaml:9:36: render.seed: got -3" in done.stderr
    assert sorted(tmp_path.iterdir()) == [path]


def test_plan_and_validate(tmp_path: Path) -> None:
    """plan tells captures, total size and time; validate counts the captures; neither creates anything."""
    path = write(tmp_path)
    done = run(tmp_path, "validate", path)
    assert f"ok (a sweep of 4 captures in {tmp_path / 'plates'}" in done.stdout
    plan = json.loads(run(tmp_path, "plan", path, "--json").stdout)
    assert plan["captures"] == 4
    assert len(plan["pilots"]) == 3
    sizes = [pilot["file"]["logical_bytes"] for pilot in plan["pilots"]]
    assert plan["logical_bytes"] == pytest.approx(4 * sum(sizes) / 3, abs=1)  # rounded to bytes
    assert sorted(tmp_path.iterdir()) == [path]


def test_interrupted_and_resumed(dataset: Path, tmp_path: Path) -> None:
    """Ctrl-C ends a sweep after the capture in flight with exit code 130; the same command goes on from there."""
    path = write(tmp_path, SWEEP.replace("count: 2", "count: 8"))
    command = [sys.executable, "-m", "nlosrender", "render", str(path)]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while not list((tmp_path / "plates").glob("0*.hdf5")) and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert "The same command goes on from there" in errors
    finished = len(list((tmp_path / "plates").glob("0*.hdf5")))
    assert 1 <= finished < 16
    states = [entry["status"] for entry in index_of(tmp_path)["captures"]]
    assert states == ["done"] * finished + ["pending"] * (16 - finished)
    report = json.loads(run(tmp_path, "render", path, "--json").stdout)
    assert (report["rendered"], report["earlier"]) == (16 - finished, finished)
    # a longer sweep begins with the same draws
    first = sorted((tmp_path / "plates").glob("0*.hdf5"))[0]
    assert np.array_equal(samples_of(first), samples_of(dataset / "plates" / "00000.hdf5"))
