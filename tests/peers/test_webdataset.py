"""Shards in the package webdataset, where it is installed."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.commands import run

pytestmark = pytest.mark.peers
CONFIG = """\
name: set
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 2.0}
  hidden_geometry:
    - {type: letters, text: L, height: 0.8, center: [0, 0, 0.8]}
capture: {scan_type: confocal, sensor_grid: {nx: 6, ny: 4}}
time_axis: {bin_width_opl: 0.05, n_bins: 130}
render: {max_bounces: 3, target_error: 0.1}
output: {ground_truth: [depth]}
sweep: {random: {count: 4, keys: {scene.hidden_geometry.0.text: {choice: [A, B, C]}}}}
dataset: {format: webdataset, shard_size: 4kB}
"""


def test_shards_in_webdataset(tmp_path: Path) -> None:
    """Keys, arrays and metadata come out as they went in, over several shards."""
    webdataset = pytest.importorskip("webdataset")
    (tmp_path / "set.yaml").write_text(CONFIG)
    done = run(tmp_path, "render", "set.yaml")
    assert done.returncode == 0, done.stderr
    urls = sorted(map(str, (tmp_path / "set/webdataset").glob("*.tar")))
    assert len(urls) > 1
    samples = list(webdataset.WebDataset(urls, shardshuffle=False).decode())
    assert [sample["__key__"] for sample in samples] == [f"{index:06d}" for index in range(4)]
    entries = json.loads((tmp_path / "set/index.json").read_text())["captures"]
    for sample, entry in zip(samples, entries, strict=True):
        assert sample["json"]["label"] == entry["label"]
        with h5py.File(tmp_path / "set" / entry["file"]) as file:
            assert np.array_equal(sample["npz"]["H"][0], file["data"][0].sum(axis=1))
            assert np.array_equal(sample["npz"]["gt_depth"], file["gt_depth"][...], equal_nan=True)
