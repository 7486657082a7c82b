"""Splits of a data set: by a hash, so that no further capture moves one, and files that stay together do."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from nlosrender.config import sweep_load
from nlosrender.config.dataset_section import SPLITS, DatasetConfig, SplitConfig, split_of
from nlosrender.config.load import config_hash, parse_config, parse_document
from nlosrender.errors import ConfigError

BASE = """\
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: sphere, radius: 0.1, center: [0.1, 0, 0.9]}
capture: {scan_type: confocal, sensor_grid: {nx: 5, ny: 3}}
"""
MESH = "{type: mesh, translate: [0, 0, 1], filename: {files: 'm/**/*.ply'}, count: {integers: [1, 4]}}"
FILES = f"{{scene.hidden_geometry.0: {MESH}}}"


def sweep_of(dataset: str, keys: str, folder: Path, count: int = 40, more: str = "") -> sweep_load.Sweep:
    """Parse a sweep with random keys and a section ``dataset``."""
    text = f"{BASE}dataset: {dataset}\nsweep: {{{more}random: {{count: {count}, keys: {keys}}}}}\n"
    sweep = sweep_load.sweep_of(parse_document(text, "z.yaml", folder))
    assert sweep is not None
    return sweep


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    """A folder with 30 files in 10 folders; nobody reads them here."""
    for number in range(30):
        path = tmp_path / f"m/{number % 10}/{number}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def test_shares() -> None:
    """Each split gets its share of many names, and another seed deals anew."""
    split, n = SplitConfig(train=0.7, val=0.2, test=0.1), 5000
    dealt = [split_of(split, str(number)) for number in range(n)]
    for name, share in zip(SPLITS, (0.7, 0.2, 0.1), strict=True):
        assert dealt.count(name) == pytest.approx(n * share, abs=5 * math.sqrt(n * share * (1 - share)))  # 5 sigma
    other = [split_of(SplitConfig(train=0.7, val=0.2, test=0.1, seed=1), str(number)) for number in range(n)]
    same = 0.7**2 + 0.2**2 + 0.1**2
    agreed = sum(a == b for a, b in zip(dealt, other, strict=True))
    assert agreed == pytest.approx(n * same, abs=5 * math.sqrt(n * same * (1 - same)))
    assert {split_of(SplitConfig(train=1, val=0, test=0), str(number)) for number in range(100)} == {"train"}


def test_more_captures_move_none(tmp_path: Path) -> None:
    """A larger count leaves the splits of the captures there are, also where a product moves their indices."""
    keys = "{render.seed: {integers: [0, 9999]}}"
    few, many = (sweep_of("{split: {}}", keys, tmp_path, count) for count in (10, 60))
    assert [many.facts(i).split for i in range(10)] == [few.facts(i).split for i in range(10)]
    assert {many.facts(i).split for i in range(60)} == set(SPLITS)
    product = "keys: {capture.laser_energy: [1, 2, 3]}, "
    few, many = (sweep_of("{split: {}}", keys, tmp_path, count, product) for count in (4, 8))
    for combination in range(3):
        for number in range(4):
            assert few.values(combination * 4 + number) == many.values(combination * 8 + number)
            assert few.facts(combination * 4 + number).split == many.facts(combination * 8 + number).split


@pytest.mark.parametrize("by", ["file", "folder"])
def test_files_stay_together(meshes: Path, by: str) -> None:
    """No file, or folder, is in two splits, though captures hold several files; all splits have some."""
    sweep = sweep_of(f"{{split: {{by: {by}, train: 0.4, val: 0.3, test: 0.3}}}}", FILES, meshes, 80)
    splits: dict[str, set] = {}
    several = 0
    for index in range(len(sweep)):
        facts = sweep.facts(index)
        several += len(facts.files) > 1
        for name in facts.files.values():
            splits.setdefault(name if by == "file" else str(Path(name).parent), set()).add(facts.split)
    assert several > 20
    assert all(len(found) == 1 for found in splits.values())
    assert len(set.union(*splits.values())) == 3


def test_labels(meshes: Path) -> None:
    """The folder of the file, or the text; or the key that is named."""
    assert sweep_of("{}", FILES, meshes).facts(0).label in {str(number) for number in range(10)}
    letters = "{scene.hidden_geometry.0: {type: letters, text: {choice: [A, B]}, height: 0.5, center: [0, 0, 1]}}"
    sweep = sweep_of("{}", letters, meshes)
    assert [sweep.facts(i).label for i in range(5)] == [sweep.config(i).scene.hidden_geometry[0].text for i in range(5)]
    key = "scene.hidden_geometry.0.radius"
    sweep = sweep_of(f"{{label: {key}}}", f"{{{key}: {{uniform: [0.1, 0.2]}}}}", meshes)
    assert sweep.facts(3).label == sweep.values(3)[key]


def test_no_part_of_a_capture(tmp_path: Path) -> None:
    """The section changes no capture's hash."""
    config = parse_config(BASE, "z.yaml", tmp_path)
    assert parse_config(f"{BASE}dataset: {{}}\n", "z.yaml", tmp_path).notes == (
        "dataset has no effect without a sweep.",
    )
    assert config_hash(parse_config(f"{BASE}dataset: {{split: {{}}}}\n", "z.yaml", tmp_path)) == config_hash(config)


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        ("{split: {train: 0.8, val: 0.1}}", ""),
        ("{split: {train: 0.8, val: 0.3}}", r"dataset\.split: got 1\.2, need train, val and test to add up to 1"),
        ("{split: {train: 2}}", r"dataset\.split\.train: got 2, need a share from 0 to 1"),
        ("{split: {by: files}}", r"dataset\.split\.by: got 'files' .* Did you mean file\?"),
        ("{split: {by: file}}", r"dataset\.split\.by: got file, but no file is drawn"),
        (".nan", r"dataset: got \.nan, need a finite number"),
        ("[]", r"dataset: got \[\], need a mapping of keys and values"),
        ("{label: color}", r"dataset\.label: got color, need one of the swept keys: render\.seed"),
        ("{dtype: float16}", r"dataset\.dtype: got float16, need float32 in format znlos"),
        ("{format: lfe, crop: true}", r"dataset\.crop: got true, need false in format lfe"),
        ("{shard_size: 3}", r"dataset\.shard_size: got 3, need auto or a size"),
    ],
)
def test_mistakes(tmp_path: Path, dataset: str, message: str) -> None:
    """Every mistake is told with its key."""
    keys = "{render.seed: {integers: [0, 9]}}"
    if not message:
        sweep_of(dataset, keys, tmp_path)
        return
    with pytest.raises(ConfigError, match=message):
        sweep_of(dataset, keys, tmp_path)


def test_sizes_of_shards() -> None:
    """A size with its unit; auto is 1 GB."""
    sizes = [DatasetConfig(shard_size=size).shard_bytes for size in ("250MB", "auto")]
    assert sizes == [250_000_000, 10**9]
