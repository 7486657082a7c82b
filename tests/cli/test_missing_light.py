"""Captures whose light is missing, or that are dark, say so: file, report, info, plan, index; never an error of 0 %."""

from __future__ import annotations

import json
import math
from pathlib import Path

import h5py
import pytest
import yaml
from support.commands import run
from support.rendering import Scene, flat_wall

from nlosrender.errors import EXIT_BAD_INPUT

PLACE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 0.8], "normal": [0, 0, -1]}
GREY = {**PLACE, "bsdf": {"type": "diffuse", "reflectance": 0.7}}
BLACK = {**PLACE, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
MIRROR = {**PLACE, "bsdf": {"type": "conductor"}}
HOLED = {**PLACE, "bsdf": {"type": "mask", "opacity": 0.9, "bsdf": MIRROR["bsdf"]}}  # images are of whole mirrors alone
BLEND = {**PLACE, "bsdf": {"type": "blendbsdf", "weight": 0.5, "a": GREY["bsdf"], "b": HOLED["bsdf"]}}


def write(
    folder: Path, *hidden: Scene, name: str = "scene.yaml", extra: Scene | None = None, **settings: object
) -> Path:
    config = flat_wall(*hidden, **({"spp": 64, "bins": (0.0, 0.05, 80)} | settings))  # type: ignore[arg-type]
    path = folder / name
    path.write_text(yaml.safe_dump(config | dict(extra or {})))
    return path


def test_the_error_of_a_capture_without_its_mirror_is_unknown(tmp_path: Path) -> None:
    """Half matt, half mirror: the matt half is there; the error is NaN in the file, null in JSON, unknown in words."""
    config = write(tmp_path, BLEND)
    report = json.loads(run(tmp_path, "render", config, "-o", "a.hdf5", "--json", "--quiet").stdout)
    assert report["error_estimate"] is None
    assert report["energy"]["3"] > 0
    assert report["zero_because"] == []
    assert ["scene.hidden_geometry.0" in text for text in report["unsampled_paths"]] == [True]
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert math.isnan(file.attrs["error_estimate"])
        assert json.loads(file.attrs["unsampled_paths"]) == report["unsampled_paths"]
    told = json.loads(run(tmp_path, "info", "a.hdf5", "--json").stdout)
    assert (told["error_estimate"], told["unsampled_paths"]) == (None, report["unsampled_paths"])
    assert "unknown: light is missing" in run(tmp_path, "info", "a.hdf5").stdout
    rendered = run(tmp_path, "render", config, "-o", "b.hdf5")
    assert "error estimate  unknown" in rendered.stdout
    assert "capture.laser_spot_radius" in rendered.stderr
    assert run(tmp_path, "compare", "a.hdf5", "b.hdf5", "--z-test").returncode == 0


def test_bounces_below_the_first_that_misses_light_have_their_errors(tmp_path: Path) -> None:
    """A mask lights another plate alone: bounce 3 is all there and has its errors, from bounce 4 on they are null."""
    mirror = {**HOLED, "center": [0.8, 0, 0.8], "width": 0.4, "normal": [1, 0, -1]}  # away from the wall
    lit = {**GREY, "center": [2.0, 0, 1.4], "width": 2.0, "height": 2.0, "normal": [-1, 0, 0]}
    config = write(tmp_path, GREY | {"center": [-0.5, 0, 0.8]}, mirror, lit, max_bounces=4)
    report = json.loads(run(tmp_path, "render", config, "-o", "a.hdf5", "--json", "--quiet").stdout)
    told = json.loads(run(tmp_path, "info", "a.hdf5", "--json").stdout)
    for name in ("error_estimate_per_bounce", "energy_error_per_bounce"):
        assert told[name] == report[name]
        assert report[name]["3"] > 0
        assert report[name]["4"] is None
    assert told["energy"]["4"] > 0
    shown = run(tmp_path, "info", "a.hdf5").stdout
    assert "error per bounce" in shown
    assert "+-" in shown


def test_a_file_says_which_variances_are_not_to_be_summed(tmp_path: Path) -> None:
    """Virtual lights share patches between sensor points, exhaustive captures paths between lasers."""
    for number, (settings, shares) in enumerate(SHARING):
        path = f"{number}.hdf5"
        run(tmp_path, "render", write(tmp_path, GREY, **settings), "-o", path, "--quiet")
        with h5py.File(tmp_path / path) as file:
            assert (shares is None) == ("not_to_be_summed" not in file["variance"].attrs)
            assert shares is None or shares in file["variance"].attrs["not_to_be_summed"]
            assert "not_to_be_summed" not in file["data"].attrs


SHARING: list[tuple[dict[str, object], str | None]] = [
    ({}, None),
    ({"scan": "exhaustive", "sensors": (3, 2)}, "laser points"),
    ({"engine": "virtual_lights", "spp": None, "target_error": 0.1}, "sensor points"),
]


def test_plan_tells_before_the_render(tmp_path: Path) -> None:
    """The plan has the class of paths, and a warning of what to do."""
    planned = run(tmp_path, "plan", write(tmp_path, BLEND))
    assert "the stated error will be unknown" in planned.stdout
    assert "capture.laser_spot_radius" in planned.stderr


@pytest.mark.parametrize(("hidden", "code"), [(BLEND, EXIT_BAD_INPUT), (GREY, 0)])
def test_strict_refuses_what_would_be_missing(tmp_path: Path, hidden: Scene, code: int) -> None:
    """``--strict`` ends before a file is made, with the place of the item; what is complete is rendered."""
    done = run(tmp_path, "render", write(tmp_path, hidden), "-o", "a.hdf5", "--strict", "--quiet")
    assert done.returncode == code
    assert (tmp_path / "a.hdf5").exists() == (code == 0)
    assert ("scene.yaml:" in done.stderr and "scene.hidden_geometry.0" in done.stderr) == (code != 0)


@pytest.mark.parametrize("hidden", [BLEND, HOLED])
def test_merged_parts_say_what_the_whole_says(tmp_path: Path, hidden: Scene) -> None:
    """What is missing, why all is zero, and an unknown error survive ``merge``."""
    config = write(tmp_path, hidden)
    run(tmp_path, "render", config, "-o", "whole.hdf5", "--quiet")
    for number in (1, 2):
        run(tmp_path, "render", config, "-o", f"part{number}.hdf5", "--shard", f"{number}/2", "--quiet")
    merged = run(tmp_path, "merge", "part1.hdf5", "part2.hdf5", "-o", "merged.hdf5")
    assert "error estimate  unknown" in merged.stdout
    with h5py.File(tmp_path / "whole.hdf5") as whole, h5py.File(tmp_path / "merged.hdf5") as file:
        assert math.isnan(file.attrs["error_estimate"])
        for name in ("unsampled_paths", "zero_because"):
            assert file.attrs.get(name) == whole.attrs.get(name)


def test_the_index_of_a_sweep_holds_unknown_errors(tmp_path: Path) -> None:
    """One capture of two misses light: its error is null, and its entry says what is missing."""
    sweep = {"sweep": {"keys": {"scene.hidden_geometry.0.bsdf.weight": [0.0, 0.5]}}}
    run(tmp_path, "render", write(tmp_path, BLEND, extra=sweep | {"name": "s"}), "--quiet")
    (index,) = tmp_path.rglob("index.json")
    known, unknown = json.loads(index.read_text())["captures"]
    assert known["error_estimate"] > 0
    assert known["unsampled_paths"] == []
    assert unknown["error_estimate"] is None
    assert len(unknown["unsampled_paths"]) == 1
    assert run(tmp_path, "check", index.parent, "--reference", index.parent).returncode == 0


AWAY = {**GREY, "normal": [0, 0, 1]}
BEFORE = {**BLACK, "center": [0.1, 0, 0.4], "width": 1.8, "height": 1.5}
ZERO = {
    "no hidden geometry": ([], {}, "there is no hidden geometry"),
    "turned away": ([AWAY], {}, "turns its back to the relay wall"),
    "occluded": ([GREY, BEFORE], {}, "is hidden from the relay wall"),
    "too early": ([GREY], {"bins": (0.0, 0.05, 20)}, "outside the time window"),
    "too late": ([GREY], {"bins": (9.0, 0.05, 20)}, "outside the time window"),
    "black": ([BLACK], {}, "are black there"),
    "a black wall": ([GREY], {"wall": {"bsdf": BLACK["bsdf"]}}, "the relay wall reflects nothing at the laser points"),
    "two bounces": ([GREY], {"max_bounces": 2}, "render.max_bounces is 2"),
    "not sampled": ([HOLED], {}, "reflected by mirrors or smooth coats is not sampled"),
}


@pytest.mark.parametrize("kind", ZERO)
def test_a_dark_capture_says_why(tmp_path: Path, kind: str) -> None:
    """H = 0 everywhere: the reason is a warning and in the file, and no error of 0 % is stated."""
    hidden, settings, reason = ZERO[kind]
    done = run(tmp_path, "render", write(tmp_path, *hidden, **settings), "-o", "a.hdf5")
    assert done.returncode == 0
    assert "0.00%" not in done.stdout
    assert "error estimate  unknown" in done.stdout
    assert any(reason in line for line in done.stderr.splitlines() if "H is zero everywhere" in line)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert not file["data"][:].any()
        assert math.isnan(file.attrs["error_estimate"])
        assert any(reason in text for text in json.loads(file.attrs["zero_because"]))
    assert "ZERO BECAUSE" in run(tmp_path, "info", "a.hdf5").stdout
