"""Packages of a data set, read back by rules written from what the programs' loaders do."""

from __future__ import annotations

import csv
import io
import json
import re
import tarfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from nlosrender.config.load import parse_document
from nlosrender.config.sweep_load import sweep_of
from nlosrender.errors import FileError, OptionError
from nlosrender.files.packages.package import pack
from nlosrender.files.packages.radiance_hdr import decoded, rgbe, write_hdr
from nlosrender.pipeline import render_capture
from nlosrender.rendering.sweep_render import render_sweep

N, BINS = 8, 60
CONFIG = f"""\
name: set
scene:
  relay_wall: {{type: rectangle, width: 2.0, height: 2.0}}
  hidden_geometry:
    - {{type: letters, text: L, height: 0.8, center: [0, 0, 0.8]}}
capture: {{scan_type: confocal, sensor_grid: {{nx: {N}, ny: {N}}}, account_first_and_last_bounces: false}}
time_axis: {{bin_width_opl: 0.05, n_bins: {BINS}}}
render: {{max_bounces: 3, target_error: 0.1}}
output: {{path: "FOLDER/{{index}}.hdf5", ground_truth: [depth, albedo, normal], ground_truth_grid: {{nx: 12, ny: 12}}}}
sweep:
  random:
    count: 5
    keys:
      scene.hidden_geometry.0.text: {{choice: [L, F]}}
      scene.hidden_geometry.0.center: {{inside: [[-0.3, 0.3], [-0.3, 0.3], [0.6, 1.0]]}}
      scene.hidden_geometry.0.bsdf: {{type: diffuse, reflectance: {{uniform: [0.2, 0.8]}}}}
dataset: {{split: {{train: 0.5, val: 0.5, test: 0}}}}
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with five captures; packages may be added."""
    folder = tmp_path_factory.mktemp("set")
    render(folder, CONFIG)
    return folder


def render(folder: Path, config: str) -> None:
    """Render a sweep into a folder."""
    sweep = sweep_of(parse_document(config.replace("FOLDER", str(folder)), "set.yaml", folder))
    assert sweep is not None
    report = render_sweep(sweep, lambda config, progress, warn, resume: render_capture(config, progress, warn))
    assert not report.failed


def entries_of(folder: Path) -> list[dict[str, Any]]:
    """Read the index."""
    return json.loads((folder / "index.json").read_text())["captures"]


def third_bounce(folder: Path, index: int) -> np.ndarray:
    """Return H (bin, y, x) of a capture, rows and columns as the wall sees them: from the top, x to the left."""
    with h5py.File(folder / f"{index}.hdf5") as file:
        return file["data"][0, :, 1][:, ::-1, ::-1]


def read_hdr(path: Path) -> np.ndarray:
    """Read a Radiance picture as its format says: a header, then rows of four run-length encoded planes."""
    content = path.read_bytes()
    head, _, body = content.partition(b"\n\n")
    assert head.startswith(b"#?RADIANCE")
    assert b"FORMAT=32-bit_rle_rgbe" in head
    size, _, body = body.partition(b"\n")
    rows, columns = map(int, re.fullmatch(rb"-Y (\d+) \+X (\d+)", size).groups())
    pixels = np.zeros((rows, 4, columns), dtype=np.uint8)
    at = 0
    for row in pixels:
        assert body[at : at + 4] == bytes([2, 2, columns // 256, columns % 256])
        at += 4
        for plane in row:
            x = 0
            while x < columns:
                count = body[at]
                if count > 128:
                    plane[x : x + count - 128] = body[at + 1]
                    x, at = x + count - 128, at + 2
                else:
                    plane[x : x + count] = np.frombuffer(body[at + 1 : at + 1 + count], np.uint8)
                    x, at = x + count, at + 1 + count
            assert x == columns
    assert at == len(body)
    mantissa, exponent = pixels[:, :3].astype(float), pixels[:, 3:].astype(float)
    return np.where(exponent > 0, mantissa * 2.0 ** (exponent - 136), 0).transpose(0, 2, 1)


@pytest.mark.parametrize("width", [8, 127, 128, 129, 300])
def test_radiance_pictures(tmp_path: Path, width: int) -> None:
    """What is read is what was written, to half of the last of eight digits of a pixel's largest component."""
    random = np.random.default_rng(1)
    picture = 10.0 ** random.uniform(-30, 5, (7, width, 1)) * random.uniform(0, 1, (7, width, 3))
    picture[2] = 0
    picture[4, 3:5] = [[1, 0.999, 0.5], [0.9999, 1e-9, 0]]
    stored = write_hdr(tmp_path / "a.hdr", picture)
    found = read_hdr(tmp_path / "a.hdr")
    assert np.array_equal(found, stored)
    assert np.all(np.abs(found - picture) <= picture.max(axis=2, keepdims=True) * (1 + 1e-6) / 256)
    assert not found[2].any()


def test_shared_exponents_round_up() -> None:
    """A component that rounds up to a power of two gets the next exponent."""
    assert decoded(rgbe(np.array([0.99999, 0.25, 0.0]))).tolist() == [1.0, 0.25, 0.0]


def shards(folder: Path) -> dict[str, dict[str, dict[str, bytes]]]:
    """Read tar files as webdataset does: members of one key, up to the first dot, are a sample."""
    found: dict[str, dict[str, dict[str, bytes]]] = {}
    for path in sorted(folder.glob("*.tar")):
        with tarfile.open(path) as tar:
            for member in tar:
                key, _, suffix = member.name.partition(".")
                found.setdefault(path.name, {}).setdefault(key, {})[suffix] = tar.extractfile(member).read()
    return found


def test_webdataset(dataset: Path) -> None:
    """Each capture is a sample of its split's shards: H, ground truth, and all that the index says."""
    pack(dataset, "webdataset")
    entries = entries_of(dataset)
    found = shards(dataset / "webdataset")
    samples = {int(key): (name, sample) for name, of in found.items() for key, sample in of.items()}
    assert sorted(samples) == [0, 1, 2, 3, 4]
    with (dataset / "webdataset/index.csv").open() as file:
        table = {int(row["index"]): row for row in csv.DictReader(file)}
    for index, (name, sample) in samples.items():
        assert set(sample) == {"json", "npz"}
        described, arrays = json.loads(sample["json"]), np.load(io.BytesIO(sample["npz"]))
        assert name == table[index]["shard"] == f"{entries[index]['split']}-000000.tar"
        assert {key: described[key] for key in ("split", "label", "values")} == {
            key: entries[index][key] for key in ("split", "label", "values")
        }
        assert arrays["H"].shape == (1, BINS, N, N)
        assert np.array_equal(arrays["H"][0, :, ::-1, ::-1], third_bounce(dataset, index))
        assert arrays["gt_depth"].shape == (12, 12)
        assert described["error_estimate"] == entries[index]["error_estimate"]
        assert (described["scale"], described["start_opl"], described["bin_width_opl"]) == (1, 0, 0.05)


def with_dataset(folder: Path, target: Path, **keys: Any) -> Path:
    """Return a copy of a data set whose configuration says something else about packages."""
    target.mkdir()
    index = json.loads((folder / "index.json").read_text())
    index["dataset"] |= keys
    (target / "index.json").write_text(json.dumps(index))
    for entry in index["captures"]:
        (target / entry["file"]).symlink_to(folder / entry["file"])
    return target


def test_half_floats_and_cropped_bins(dataset: Path, tmp_path: Path) -> None:
    """float16 is scaled by a power of two, its rounding is in the stated error; bins dark in all captures are gone."""
    copy = with_dataset(dataset, tmp_path / "half", format="webdataset", dtype="float16", crop=True)
    report = pack(copy)
    entries, bins = entries_of(dataset), set()
    lit = np.flatnonzero(sum(third_bounce(dataset, index).sum(axis=(1, 2)) for index in range(5)))
    for of in shards(copy / "webdataset").values():
        for key, sample in of.items():
            described, stored = json.loads(sample["json"]), np.load(io.BytesIO(sample["npz"]))["H"]
            exact = third_bounce(dataset, int(key))[lit[0] : lit[-1] + 1, ::-1, ::-1].astype(float)
            found = stored[0].astype(float) * described["scale"]
            rounding = np.linalg.norm(found - exact) / np.linalg.norm(exact)
            assert stored.dtype == np.float16
            assert np.abs(found - exact).max() <= exact.max() * 2**-11  # half of the last of 11 digits
            assert 0 < rounding <= 2**-11
            stated = entries[int(key)]["error_estimate"] + rounding
            assert described["error_estimate"] == pytest.approx(stated, rel=1e-6)
            assert described["start_opl"] == pytest.approx(lit[0] * 0.05)
            bins.add(stored.shape[1])
            assert rounding <= report["largest_rounding"] * (1 + 1e-9)
    assert bins == {lit[-1] + 1 - lit[0]}


def test_shards_have_a_size(dataset: Path, tmp_path: Path) -> None:
    """A shard is ended before it grows beyond the size asked for; the same captures give the same bytes."""
    copy = with_dataset(dataset, tmp_path / "small", format="webdataset", shard_size="9kB", split=None)
    contents = []
    for _ in range(2):
        pack(copy)
        contents.append({path.name: path.read_bytes() for path in (copy / "webdataset").glob("*.tar")})
    assert contents[0] == contents[1]
    sizes = [sum(map(len, sample.values())) for of in shards(copy / "webdataset").values() for sample in of.values()]
    assert len(contents[0]) > 1
    for of in shards(copy / "webdataset").values():
        assert len(of) == 1 or sum(sum(map(len, sample.values())) for sample in of.values()) <= 9000
    assert len(sizes) == 5


def test_lfe(dataset: Path) -> None:
    """Its loaders find 0/MODEL/shin*, one light-1-*.hdr with (600, n, n), bins by its name, and a depth picture."""
    report = pack(dataset, "lfe")
    seen = set()
    for split in ("train", "val"):
        for folder in (dataset / "lfe" / split).glob("0/*/shin*"):
            index = int(folder.name[-6:])
            seen.add(index)
            entry, exact = entries_of(dataset)[index], third_bounce(dataset, index).astype(float)
            assert entry["split"] == split
            assert folder.parent.name == entry["label"]
            number = r"-?\d+\.\d{4}"
            assert re.match(
                rf"shine_{number}-rot_{number}_{number}_{number}-shift_{number}_{number}_{number}", folder.name
            )
            (light,) = folder.glob("light-1-*.hdr")
            *_, last, first = light.name[:-4].split("-")
            assert 0 <= float(first) <= float(last) < 6
            picture = read_hdr(light)
            assert picture.shape == (600 * N, N, 3)
            found = picture[..., 0].reshape(600, N, N)
            lit = np.flatnonzero(found.any(axis=(1, 2)))
            assert (float(first), float(last)) == pytest.approx((lit[0] / 100, lit[-1] / 100))
            assert np.abs(found[:BINS] - exact).max() <= exact.max() / 256
            assert not found[BINS:].any()
            (depth,) = folder.glob("depth-0-*.hdr")
            distance = read_hdr(depth)[..., 0]
            with h5py.File(dataset / entry["file"]) as file:
                true = file["gt_depth"][...][::-1, ::-1]
            assert np.array_equal(distance > 0, np.isfinite(true))
            assert distance[distance > 0] == pytest.approx(1 - true[distance > 0] / 2, rel=1 / 256)
            (image,) = folder.glob("confocal-0-*.hdr")
            shown = read_hdr(image)[..., 0]
            reflectance = entry["values"]["scene.hidden_geometry.0.bsdf.reflectance"]
            assert shown.max() == pytest.approx(reflectance, rel=1 / 128)  # a letter that faces the wall
    assert seen == {0, 1, 2, 3, 4}
    assert report["notes"] == ["bins of 0.05 m, where LFE has 0.01 m (5 captures)"]
    assert 0 < report["largest_rounding"] < 1 / 256


def test_nlos3d(dataset: Path) -> None:
    """Its loader takes splits/NAME.json, then data/NAME.mat with one variable data: meas, image and depth."""
    pack(dataset, "nlos3d")
    seen = 0
    for entry_split in ("train", "val"):
        listed = json.loads((dataset / f"nlos3d/splits/{entry_split}.json").read_text())
        for names in listed:
            index = int(names["meas"][:6])
            data = {
                kind: loadmat(dataset / "nlos3d/data" / name, verify_compressed_data_integrity=False)["data"]
                for kind, name in names.items()
            }
            assert data["meas"].shape == (1, BINS, N, N)
            assert np.array_equal(data["meas"][0], third_bounce(dataset, index))
            assert data["image"].shape == (12, 12, 6)
            views = data["image"].reshape(12, 12, -1, 3)
            assert data["depth"].shape == (12, 12, views.shape[2])
            assert np.array_equal(views[..., 0, 0] > 0, data["depth"][..., 0] > 0)
            assert entries_of(dataset)[index]["split"] == entry_split
            seen += 1
    assert seen == 5


def test_time_is_counted_from_the_wall(tmp_path: Path) -> None:
    """LFE and nlos3d know no legs: those that are in a capture are taken out."""
    config = CONFIG.replace(", account_first_and_last_bounces: false", "").replace("count: 5", "count: 1")
    render(tmp_path, config.replace("n_bins: 60", "n_bins: 120"))
    pack(tmp_path, "nlos3d")
    (split,) = (tmp_path / "nlos3d/splits").glob("*.json")
    light = loadmat(tmp_path / "nlos3d/data/000000-meas.mat")["data"][0]
    with h5py.File(tmp_path / "0.hdf5") as file:
        stored = file["data"][0, :, 1][:, ::-1, ::-1]
        nearest = 2 * np.nanmin(file["gt_depth"][...])
    assert len(json.loads(split.read_text())) == 1
    assert light.sum() == pytest.approx(stored.sum(), rel=1e-5)
    first = np.flatnonzero(light.any(axis=(1, 2)))[0] * 0.05
    assert nearest - 0.1 <= first <= nearest + 0.1  # the bin of the shortest way, and one that shares its light


def test_refusals(dataset: Path, tmp_path: Path) -> None:
    """A folder of something else is not replaced; a grid that is not square fits no square format."""
    copy = with_dataset(dataset, tmp_path / "copy")
    (copy / "lfe").mkdir()
    (copy / "lfe/thesis.tex").touch()
    with pytest.raises(FileError, match="is no package of a data set: it is not replaced"):
        pack(copy, "lfe")
    assert (copy / "lfe/thesis.tex").exists()
    with pytest.raises(OptionError, match="got 'znlos', need one of webdataset, lfe, nlos3d"):
        pack(copy)
    config = CONFIG.replace(f"ny: {N}", "ny: 5").replace("count: 5", "count: 1")
    render(tmp_path, config)
    for file_format in ("lfe", "nlos3d"):
        with pytest.raises(FileError, match="takes square grids on a flat wall"):
            pack(tmp_path, file_format)
        assert not list(tmp_path.glob(f"*{file_format}*"))
    assert pack(tmp_path, "webdataset")["captures"] == 1
