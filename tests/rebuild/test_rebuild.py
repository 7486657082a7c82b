"""The comparison of two trees tells one bit and a missing capture; the list has every kind of capture."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import bit_identity
import h5py
import numpy as np
import pytest
from rebuild_captures import CaptureCase, capture_cases

import nlosrender

TREE = Path(nlosrender.__file__).parents[1]
CASES = capture_cases()


FIRST, SECOND = "path-exhaustive", "path-single-third-only"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Record one capture as it is in the list, and one that is said to be another engine's; what failed."""
    folder = tmp_path_factory.mktemp("recorded")
    first, second = (next(case for case in CASES if case.name == name) for name in (FIRST, SECOND))
    wrong = CaptureCase(second.name, "virtual_lights", second.config)
    return folder, bit_identity.record_captures(TREE, folder, [first, wrong], jobs=2)


@pytest.fixture(scope="module")
def recorded(rendered: tuple[Path, list[str]]) -> Path:
    """Return a record of two captures by this tree."""
    folder, _ = rendered
    record = json.loads((folder / bit_identity.RECORD).read_text())
    record["captures"][SECOND] = record["captures"][FIRST] | bit_identity.fingerprint(folder / f"{SECOND}.hdf5")
    (folder / bit_identity.RECORD).write_text(json.dumps(record))
    return folder


def compare(before: Path, after: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str]:
    code = bit_identity.main(["compare", str(before), str(after), *options])
    return code, capsys.readouterr().out


def rewritten(recorded: Path, folder: Path, dataset: str, flip: int) -> Path:
    """Return a copy of a record in which one value of a dataset has other bits."""
    shutil.copytree(recorded, folder)
    path = folder / f"{FIRST}.hdf5"
    with h5py.File(path, "r+") as file:
        values = file[dataset][()]
        bits = values.reshape(-1).view(np.uint32)
        bits[np.flatnonzero(bits)[-1]] ^= flip
        file[dataset][...] = values
    record = json.loads((folder / bit_identity.RECORD).read_text())
    record["captures"][FIRST] |= bit_identity.fingerprint(path)
    (folder / bit_identity.RECORD).write_text(json.dumps(record))
    return folder


def test_a_record_equals_itself(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Captures of one record are the same."""
    code, table = compare(recorded, recorded, capsys)
    assert code == 0
    assert table.count(" same") == 2
    assert "2 captures, 0 wrong" in table


@pytest.mark.parametrize("dataset", ["data", "variance", "laserGridPositions"])
def test_one_bit_is_a_difference(
    recorded: Path, tmp_path: Path, dataset: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last bit of one float32 value of any dataset; the other capture stays the same."""
    code, table = compare(recorded, rewritten(recorded, tmp_path / "after", dataset, 1), capsys)
    assert code == 1
    assert f"DIFFERENT  {dataset}: max relative " in table
    assert ", 1 of " in table
    assert "2 captures, 1 wrong" in table


def test_a_missing_capture_is_wrong(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In either record; nothing to compare is wrong as well."""
    record = json.loads((recorded / bit_identity.RECORD).read_text())
    del record["captures"][FIRST]
    (tmp_path / "less.json").write_text(json.dumps(record))
    for pair, side in (((recorded, tmp_path / "less.json"), "AFTER"), ((tmp_path / "less.json", recorded), "BEFORE")):
        code, table = compare(*pair, capsys)
        assert code == 1
        assert f"MISSING    not in {side}" in table
    assert compare(recorded, recorded, capsys, "--only", "none*")[0] == 1


def test_an_early_record_has_no_configurations(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is compared all the same; two records of different configurations are not."""
    record = json.loads((recorded / bit_identity.RECORD).read_text())
    record["captures"][FIRST]["config"] = "other"
    (tmp_path / "other.json").write_text(json.dumps(record))
    code, table = compare(tmp_path / "other.json", recorded, capsys)
    assert code == 1
    assert "another configuration" in table
    del record["captures"][FIRST]["config"]
    (tmp_path / "early.json").write_text(json.dumps(record))
    for pair in ((tmp_path / "early.json", recorded), (recorded, tmp_path / "early.json")):
        assert compare(*pair, capsys)[0] == 0


def test_parts_have_to_be_the_whole(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A capture rendered in parts is held against the whole one of its own record."""
    record = json.loads((recorded / bit_identity.RECORD).read_text())
    record["captures"][FIRST]["same_as"] = SECOND
    (tmp_path / "parts.json").write_text(json.dumps(record))
    code, table = compare(tmp_path / "parts.json", tmp_path / "parts.json", capsys)
    assert code == 1
    assert f"from {SECOND} in AFTER" in table


def test_stated_attributes_fail_on_demand(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another sum in a stated energy is listed; it is no difference of samples."""
    record = json.loads((recorded / bit_identity.RECORD).read_text())
    record["captures"][FIRST]["attributes"]["energy"] = "{}"
    (tmp_path / "other.json").write_text(json.dumps(record))
    code, table = compare(recorded, tmp_path / "other.json", capsys)
    assert code == 0
    assert "attributes energy" in table
    assert compare(recorded, tmp_path / "other.json", capsys, "--attributes")[0] == 1


def test_captures_of_another_engine_are_refused(rendered: tuple[Path, list[str]]) -> None:
    """A list whose captures no longer reach the engine they are there for says so."""
    _, failures = rendered
    assert len(failures) == 1
    assert f"{SECOND}: rendered by path, need virtual_lights: asked for" in failures[0]


def _values(key: str, tree: Any) -> set[str]:
    """Return the texts and numbers under a key anywhere in a configuration."""
    if isinstance(tree, dict):
        own = {str(value) for name, value in tree.items() if name == key and not isinstance(value, dict | list)}
        return own.union(*(_values(key, value) for value in tree.values()))
    if isinstance(tree, list | tuple):
        return set().union(*(_values(key, value) for value in tree))
    return set()


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_the_list_has_every_kind_of_relay_wall_capture(engine: str) -> None:
    """Scans, walls, techniques and shapes, for both engines."""
    configs = [case.config for case in CASES if case.engine == engine]
    scans = {config["capture"]["scan_type"] for config in configs}
    walls = {config["scene"]["relay_wall"]["type"] for config in configs}
    assert scans == {"single", "confocal", "exhaustive"}
    assert walls == {"rectangle", "sphere", "cylinder", "mesh"}
    hidden = set().union(*(_values("type", config["scene"]["hidden_geometry"]) for config in configs))
    assert hidden >= {"rectangle", "letters", "mesh", "sphere", "cylinder", "diffuse", "bitmap", "roughconductor"}
    assert _values("seed", configs) == {"7"}
    assert "None" in _values("max_bounces", configs)


def test_the_list_has_every_way_of_rendering() -> None:
    """Names are unique; work items, shards, merges, interruptions and dask of every engine; no limit of time."""
    assert len({case.name for case in CASES}) == len(CASES) >= 50
    for engine in ("path", "virtual_lights", "line_of_sight"):
        modes = {case.mode for case in CASES if case.engine == engine}
        assert modes >= {"render", "shards", "dask"}
        assert engine == "line_of_sight" or modes >= {"lasers", "kill", "stop"}
    assert not any("time_limit_s" in case.config["render"] for case in CASES)
    keys = set().union(*(case.config["render"] for case in CASES))
    assert keys >= {"spp", "target_error", "laser_sampling", "hidden_geometry_sampling", "temporal_kernel_opl"}
    assert keys >= {"russian_roulette", "polarized", "color", "split_bounces", "memory_limit"}
    known = {case.name for case in CASES}
    assert {case.same_as for case in CASES} - {None} <= known
