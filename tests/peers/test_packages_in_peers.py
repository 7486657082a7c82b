"""Packages in the programs they are for: shards in webdataset, Radiance pictures in OpenCV (make peers)."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.commands import run

PEER = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
pytestmark = [
    pytest.mark.peers,
    pytest.mark.skipif(not PEER.exists(), reason="peers are not installed: make peers puts them into .venv-peers"),
]
CONFIG = """\
name: set
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 2.0}
  hidden_geometry:
    - {type: letters, text: L, height: 0.8, center: [0, 0, 0.8]}
capture: {scan_type: confocal, sensor_grid: {nx: 8, ny: 8}, account_first_and_last_bounces: false}
time_axis: {bin_width_opl: 0.01, n_bins: 400}
render: {max_bounces: 3, target_error: 0.1}
output: {ground_truth: [depth]}
sweep: {random: {count: 4, keys: {scene.hidden_geometry.0.text: {choice: [A, B, C]}}}}
dataset: {format: webdataset, shard_size: 8kB}
"""
SHARDS = """
import sys, json, numpy, webdataset
for sample in webdataset.WebDataset(sys.argv[2:], shardshuffle=False).decode():
    numpy.savez(f"{sys.argv[1]}/{sample['__key__']}.npz", label=sample["json"]["label"], **sample["npz"])
"""
PICTURES = """
import sys, glob, cv2, numpy
for folder in glob.glob(f"{sys.argv[2]}/0/*/shin*"):
    (light,) = glob.glob(f"{folder}/light-1-*.hdr")
    (depth,) = glob.glob(f"{folder}/depth-0-*.hdr")
    grey = cv2.cvtColor(cv2.imread(light, -1), cv2.COLOR_BGR2GRAY).reshape(600, 8, 8)
    numpy.savez(f"{sys.argv[1]}/{folder[-6:]}.npz", H=grey, depth=cv2.imread(depth, cv2.IMREAD_UNCHANGED)[..., 0])
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with four captures and their shards."""
    folder = tmp_path_factory.mktemp("peers")
    (folder / "set.yaml").write_text(CONFIG)
    done = run(folder, "render", "set.yaml")
    assert done.returncode == 0, done.stderr
    return folder / "set"


def read(code: str, target: Path, *arguments: object) -> list[dict[str, np.ndarray]]:
    """Run a reader in the environment of the peers; return what it found of each capture."""
    done = subprocess.run([PEER, "-c", code, target, *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [dict(np.load(path)) for path in sorted(target.glob("*.npz"))]


def test_shards_in_webdataset(dataset: Path, tmp_path: Path) -> None:
    """Keys, arrays and metadata come out as they went in, over several shards."""
    urls = sorted((dataset / "webdataset").glob("*.tar"))
    assert len(urls) > 1
    found = read(SHARDS, tmp_path, *urls)
    entries = json.loads((dataset / "index.json").read_text())["captures"]
    for sample, entry in zip(found, entries, strict=True):
        assert sample["label"] == entry["label"]
        with h5py.File(dataset / entry["file"]) as file:
            assert np.array_equal(sample["H"][0], file["data"][0].sum(axis=1))
            assert np.array_equal(sample["gt_depth"], file["gt_depth"][...], equal_nan=True)


def test_pictures_in_opencv(dataset: Path, tmp_path: Path) -> None:
    """The transient of LFE is what OpenCV reads of it, to the eight digits of such pictures."""
    assert run(dataset, "dataset", "pack", ".", "--format", "lfe").returncode == 0
    found = read(PICTURES, tmp_path, dataset / "lfe")
    for number, sample in enumerate(found):
        with h5py.File(dataset / f"{number:05d}.hdf5") as file:
            exact = file["data"][0, :, 1][:, ::-1, ::-1]
        assert np.abs(sample["H"][:400] - exact).max() <= exact.max() / 256
        assert 0 < sample["depth"].max() < 1
    assert len(found) == 4
