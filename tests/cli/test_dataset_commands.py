"""Data sets: index and table, ``dataset info``, ``sheet``; captures that fail."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.commands import run

from nlosrender.errors import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_OK

TETRAHEDRON = "v 0 0 0\nv 3 0 0\nv 0 3 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
CONFIG = """\
name: set
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: sphere, radius: 0.3, center: [0, 0, 1]}
capture: {scan_type: confocal, sensor_grid: {nx: 6, ny: 4}}
time_axis: {bin_width_opl: 0.05, n_bins: 130}
render: {max_bounces: 3, target_error: 0.1}
output: {ground_truth: [depth, albedo, instance]}
sweep:
  random:
    count: 5
    keys:
      scene.hidden_geometry.0:
        type: mesh
        filename: {files: 'meshes/*/*.obj', pick: each}
        fit: {largest: {uniform: [0.5, 0.8]}}
        rotate_deg: {rotation: uniform}
        translate: [0, 0, 1]
dataset: {split: {by: file, train: 0.4, val: 0.3, test: 0.3}}
"""


def write(folder: Path, config: str = CONFIG) -> Path:
    """Write a family of four meshes, of which the last cannot be read."""
    for number, name in enumerate(("a/0", "a/1", "b/2", "b/3")):
        path = folder / f"meshes/{name}.obj"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("no mesh" if number == 3 else TETRAHEDRON.replace("3", str(number + 1), 3).replace("f ", "f "))
    path = folder / "set.yaml"
    path.write_text(config)
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rendered family of five captures, of which one fails; not to be changed."""
    folder = tmp_path_factory.mktemp("family")
    done = run(folder, "render", write(folder))
    assert (done.returncode, "1 of 5 captures failed" in done.stderr) == (EXIT_FAILURE, True), done.stderr
    return folder


def index_of(folder: Path) -> dict[str, Any]:
    """Read the index."""
    return json.loads((folder / "set/index.json").read_text())


def test_a_failure_is_noted_and_the_rest_goes_on(dataset: Path) -> None:
    """The mesh that cannot be read fails its capture alone; the file is named."""
    entries = index_of(dataset)["captures"]
    assert [entry["status"] for entry in entries] == ["done", "done", "done", "failed", "done"]
    assert "meshes/b/3.obj cannot be used as a mesh" in entries[3]["message"]
    assert entries[0]["files"] == entries[4]["files"]
    (file,) = entries[1]["files"].values()
    content = (dataset / "meshes/a/1.obj").read_bytes()
    assert file == {"file": "meshes/a/1.obj", "sha256": hashlib.sha256(content).hexdigest()}


def test_the_table_is_the_index(dataset: Path) -> None:
    """index.csv has a row for each capture, with everything drawn."""
    with (dataset / "set/index.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row, entry in zip(rows, index_of(dataset)["captures"], strict=True):
        assert row["status"] == entry["status"]
        assert row["split"] == entry["split"]
        assert row["label"] == entry["label"] == Path(row["scene.hidden_geometry.0.filename"]).parent.name
        assert (
            json.loads(row["scene.hidden_geometry.0.rotate_deg"])
            == entry["values"]["scene.hidden_geometry.0.rotate_deg"]
        )
        assert (
            float(row["scene.hidden_geometry.0.fit.largest"]) == entry["values"]["scene.hidden_geometry.0.fit.largest"]
        )
        assert (float(row["seconds"]) > 0) if row["status"] == "done" else not row["seconds"]


def test_info(dataset: Path) -> None:
    """Counts, splits, sizes, failures and spreads are those of the index and its files."""
    found = json.loads(run(dataset, "dataset", "info", "set", "--json").stdout)
    entries = index_of(dataset)["captures"]
    done = [entry for entry in entries if entry["status"] == "done"]
    assert (found["captures"], found["status"]) == (5, {"done": 4, "failed": 1})
    assert found["splits"] == {name: [e["split"] for e in entries].count(name) for name in found["splits"]}
    assert sum(found["splits"].values()) == 5
    assert found["labels"] == {"a": 3, "b": 2}
    assert found["bytes"] == sum((dataset / "set" / entry["file"]).stat().st_size for entry in done)
    errors = [entry["error_estimate"] for entry in done]
    assert found["error_estimate"] == {"lowest": min(errors), "median": np.median(errors), "highest": max(errors)}
    assert [failure["index"] for failure in found["failures"]] == [3]
    assert (found["in_two_splits"], found["missing_files"], found["target_missed"]) == ([], 0, 0)
    shown = run(dataset, "dataset", "info", "set")
    assert shown.returncode == EXIT_OK
    assert "done 4, failed 1" in shown.stdout


def test_a_copied_file_is_found_in_two_splits(dataset: Path, tmp_path: Path) -> None:
    """The same mesh under two names may come into two splits: info tells by its content."""
    index = index_of(dataset)
    for number, split in enumerate(("train", "test")):
        (file,) = index["captures"][number]["files"].values()
        file["sha256"], index["captures"][number]["split"] = "0" * 64, split
    (tmp_path / "index.json").write_text(json.dumps(index))
    found = json.loads(run(tmp_path, "dataset", "info", ".", "--json").stdout)
    assert found["in_two_splits"] == ["meshes/a/0.obj"]
    assert found["missing_files"] == 4


def test_sheet(dataset: Path, tmp_path: Path) -> None:
    """A picture with a cell for each capture: lit where the scene is, dark where a capture failed."""
    done = run(dataset, "sheet", "set", "-o", tmp_path / "sheet.png", "--columns", "3")
    assert done.returncode == EXIT_OK, done.stderr
    picture = np.asarray(Image.open(tmp_path / "sheet.png").convert("L"), dtype=float)
    cells = [part for row in np.array_split(picture, 2) for part in np.array_split(row, 3, axis=1)]
    fronts = [cell[6:102, 6:102].max() for cell in cells]
    assert min(fronts[:3] + fronts[4:5]) > 150
    assert max(fronts[3], fronts[5]) < 100
    few = run(dataset, "sheet", "set", "-o", tmp_path / "few.png", "--captures", "2")
    assert few.returncode == EXIT_OK
    assert Image.open(tmp_path / "few.png").size[1] < picture.shape[0]


def test_an_empty_folder(tmp_path: Path) -> None:
    """A pattern that nothing matches is refused before anything is rendered; so is a folder without an index."""
    path = write(tmp_path, CONFIG.replace("meshes/*", "nothing/*"))
    done = run(tmp_path, "render", path)
    assert done.returncode == EXIT_BAD_INPUT
    assert "set.yaml:15:" in done.stderr
    assert "need a pattern that some file matches" in done.stderr
    assert not (tmp_path / "set").exists()
    for command in (("dataset", "info", "meshes"), ("sheet", "meshes")):
        done = run(tmp_path, *command)
        assert (done.returncode, "holds no index.json" in done.stderr) == (EXIT_BAD_INPUT, True)


def test_parquet(dataset: Path, tmp_path: Path) -> None:
    """The same table as .parquet, where the optional package is there; else that is said before the first render."""
    path = write(tmp_path, CONFIG.replace("count: 5", "count: 1").replace("dataset: {", "dataset: {index: parquet, "))
    done = run(tmp_path, "render", path)
    try:
        from pyarrow import parquet
    except ImportError:
        assert (done.returncode, "needs the package pyarrow" in done.stderr) == (EXIT_BAD_INPUT, True)
        assert not list((tmp_path / "set").glob("*.hdf5"))
        return
    assert done.returncode == EXIT_OK, done.stderr
    table = parquet.read_table(tmp_path / "set/index.parquet").to_pylist()
    assert [row["label"] for row in table] == ["a"]
    assert table[0]["scene.hidden_geometry.0.fit.largest"] == pytest.approx(
        index_of(dataset)["captures"][0]["values"]["scene.hidden_geometry.0.fit.largest"]
    )
