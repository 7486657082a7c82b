"""``report``: pages of captures and of data sets that load nothing and run nothing of a file's."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import commands
from support.commands import Done
from support.pages import Page
from support.point_captures import cells, points_header, write_light

from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK
from nlosrender.files.dataset_index import IndexEntry

ROWS, COLUMNS, BINS = 3, 5, 7
SCRIPT = "<script>alert(1)</script><img src=x onerror=alert(1)>\"'"
STATED = {
    "energy": json.dumps({"2": 0.0, "3": 0.75, "4": 0.25}),
    "energy_error_per_bounce": json.dumps({"2": 0.0, "3": 0.01, "4": None}),
    "error_estimate_per_bounce": json.dumps({"2": None, "3": 0.02, "4": 0.04}),
    "error_estimate": 0.023,
    "seconds": json.dumps({"render": 1.5, "total": 2.5}),
    "warnings": ["sensor near the wall"],
    "omitted_work": ["colour: everything is grey"],
    "config": json.dumps({"name": SCRIPT, "render": {"spp": 64}}),
    "created": "2026-01-02T03:04:05+00:00",
}


def write(path: Path, scan: str = "confocal", factor: float = 1.0, **attributes: object) -> Path:
    """Write a capture whose third bounce is ``factor`` times a fixed random one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = points_header(scan, cells(COLUMNS, ROWS, 2.0, 1.6), bins=(0.0, 0.01, BINS))
    lasers = (2, 3) if scan == "exhaustive" else (1, 1)
    light = np.random.default_rng(0).random((*lasers, ROWS, COLUMNS, BINS))
    return write_light(path, header, light * factor, **attributes)


def report(folder: Path, *arguments: object) -> tuple[Done, Page, str]:
    """Run ``report``; return what it left behind, its page and the page's text."""
    done = commands.run(folder, "report", *arguments, "-o", "page.html")
    text = (folder / "page.html").read_text() if done.returncode == EXIT_OK else ""
    return done, Page(text), text


def is_self_contained(page: Page, text: str) -> bool:
    """Return whether a page loads nothing: pictures are in it, and nothing names another place."""
    inside = all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    return inside and not re.search(r"https?://|url\(|@import|\bfetch\(", text)


@pytest.mark.parametrize("scan", ["confocal", "single", "exhaustive"])
def test_page_of_a_capture(tmp_path: Path, scan: str) -> None:
    """Pictures, bounces with shares and errors, warnings, skipped work, time, configuration; nothing of it runs."""
    write(tmp_path / "a<script>.hdf5", scan, **STATED)
    done, page, text = report(tmp_path, "a<script>.hdf5")
    assert done.stdout == "page.html\n"
    assert is_self_contained(page, text)
    assert "script" not in page.tags
    assert "onerror" not in page.attributes
    assert page.tags.count("img") >= 3  # the wall as a whole, at one moment at least, the row over time
    assert page.tags.count("polyline") == 2  # one for each bounce
    for words in (
        "Stated error 2.3 %", "energy 1,", "2.5 s", "Warning: sensor near the wall", "colour: everything is grey",
        "75 %", "25 %", "not known", "2026-01-02T03:04:05", "spp: 64", "a&lt;script&gt;.hdf5",
    ):  # fmt: skip
        assert words in text
    assert ("laser point in row 1" in " ".join(text.split())) == (scan == "exhaustive")


def test_page_of_a_file_that_says_nothing_or_nonsense(tmp_path: Path) -> None:
    """Attributes are anybody's: without any, and with text where numbers or lists belong, there is a page."""
    write(tmp_path / "bare.hdf5")
    with h5py.File(tmp_path / "bare.hdf5", "r+") as file:
        for name in list(file.attrs):
            del file.attrs[name]
    done, _, text = report(tmp_path, "bare.hdf5")
    assert done.returncode == EXIT_OK, done.stderr
    assert "an unknown program" in text
    for nonsense in (SCRIPT, json.dumps({"3": SCRIPT}), json.dumps([SCRIPT]), 7, "[[[", json.dumps({"total": [1]})):
        write(tmp_path / "odd.hdf5", **dict.fromkeys(STATED, nonsense))
        done, page, text = report(tmp_path, "odd.hdf5")
        assert done.returncode == EXIT_OK, done.stderr
        assert "script" not in page.tags
        assert "onerror" not in page.attributes


def test_page_of_a_capture_whose_samples_cannot_be_drawn(tmp_path: Path) -> None:
    """A sample that is not finite leaves a page without pictures that says so."""
    write(tmp_path / "a.hdf5", **STATED)
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["data"][0, 0, 1, 0, 0] = np.nan
    _, page, text = report(tmp_path, "a.hdf5")
    assert "No pictures: " in text
    assert "img" not in page.tags
    assert "75 %" in text


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Ten captures in an index: one failed, pending, without file, slow, bright, and of unknown error each."""
    entries = []
    for number in range(10):
        name = f"{number:05d}.hdf5"
        energy = {"3": 100.0 if number == 4 else 1 + 0.01 * number}
        status = {0: "failed", 1: "pending"}.get(number, "done")
        entry = IndexEntry(number, name, {"a.0.size": 1 / (1 + number), "text": SCRIPT}, status, label=f"l{number % 3}")
        entries.append(asdict(entry) | {"message": SCRIPT if number == 0 else None})
        if status == "done":
            error = None if number == 5 else 0.01 + 0.0001 * number
            entries[-1] |= {
                "energy": energy,
                "error_estimate": error,
                "seconds": 90.0 if number == 6 else 1 + 0.1 * number,
            }
            if number != 3:
                write(tmp_path / "set" / name)
    write(tmp_path / "set" / "stray.hdf5")
    index = {"format_version": 1, "source": "a.yaml", "keys": [], "dataset": {}, "captures": entries}
    (tmp_path / "set" / "index.json").write_text(json.dumps(index))
    return tmp_path


def test_page_of_a_dataset(dataset: Path) -> None:
    """Failures with their reason, outliers with theirs, pictures, all captures in the table; one script, ours."""
    # the index knows 7 captures that can be read: one more, and there are enough to say what is usual
    index = json.loads((dataset / "set" / "index.json").read_text())
    index["captures"] += [index["captures"][2] | {"index": 10 + copy} for copy in range(2)]
    (dataset / "set" / "index.json").write_text(json.dumps(index))
    done, page, text = report(dataset, "set")
    assert done.returncode == EXIT_OK, done.stderr
    assert is_self_contained(page, text)
    assert page.tags.count("script") == 1
    assert "onerror" not in page.attributes
    flat = " ".join(re.sub(r"<[^>]*>", " ", text).split())
    assert "set: 12 captures" in flat
    assert "9 done" in flat
    assert "2 failed" in flat
    assert "1 more captures lie in the folder" in flat
    assert re.search(r"3 00003.hdf5 \S*00003.hdf5: there is no such file", flat)
    assert re.search(r"4 00004.hdf5 energy 100 above the median", flat)
    assert re.search(r"5 00005.hdf5 stated error not known not stated", flat)
    assert re.search(r"6 00006.hdf5 seconds 90 above the median", flat)
    assert page.tags.count("img") == 9  # the wall of each; no ground truth
    assert text.count('<tr id="r') == 12


def test_outliers_are_pictured_first(dataset: Path) -> None:
    """Of a few pictures, those of outliers are some: --captures 1 shows the capture without a known error."""
    _, page, text = report(dataset, "set", "--captures", 1)
    assert page.tags.count("figure") == 1
    assert "5 00005.hdf5</a>" in text
    _, page, _ = report(dataset, "set", "--captures", 0)
    assert "figure" not in page.tags


def test_page_of_a_folder_without_an_index(tmp_path: Path) -> None:
    """Every capture below it is looked at; one that cannot be read is a failure."""
    write(tmp_path / "some" / "deep" / "a.hdf5", **STATED)
    write(tmp_path / "some" / "b.hdf5", **STATED, target_missed="0.01 was asked for")
    (tmp_path / "some" / "c.hdf5").write_text("no capture")
    _, _, text = report(tmp_path, "some")
    flat = " ".join(re.sub(r"<[^>]*>", " ", text).split())
    assert "2 done" in flat
    assert "1 failed" in flat
    assert "c.hdf5: is not an HDF5 file" in flat
    assert "deep/a.hdf5 done 1 0.023 2.5" in flat
    assert "b.hdf5 stated error 0.023 target missed" in flat


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["empty"], "empty: holds no capture"),
        (["missing.hdf5"], "missing.hdf5: there is no such file"),
        (["thesis.tex"], "thesis.tex: is not an HDF5 file"),
    ],
)
def test_what_is_no_capture_is_refused(tmp_path: Path, arguments: list[str], message: str) -> None:
    """Exit code 3 and a message; no page appears."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "thesis.tex").write_text("mine")
    done, _, _ = report(tmp_path, *arguments)
    assert (done.returncode, done.stdout) == (EXIT_BAD_INPUT, "")
    assert message in done.stderr
    assert not (tmp_path / "page.html").exists()


def test_a_page_replaces_only_pages(tmp_path: Path) -> None:
    """A file of another kind stays; the capture itself is refused as an output."""
    write(tmp_path / "a.hdf5")
    (tmp_path / "page.html").write_text("<!doctype html><title>mine</title>")
    done = commands.run(tmp_path, "report", "a.hdf5", "-o", "page.html")
    assert done.returncode == EXIT_BAD_INPUT
    assert "is not a page by nlosrender" in done.stderr
    assert commands.run(tmp_path, "report", "a.hdf5", "-o", "a.hdf5").returncode == EXIT_BAD_INPUT
    assert h5py.is_hdf5(tmp_path / "a.hdf5")


@pytest.mark.parametrize(
    ("key", "value"),
    [("energy", [1]), ("file", 3), ("index", None), ("values", 7), ("seconds", "x"), ("status", "odd")],
)
def test_an_index_with_values_of_other_types_is_refused(dataset: Path, key: str, value: object) -> None:
    """By ``report`` and every other command that reads it: an error that names the file, no traceback."""
    path = dataset / "set" / "index.json"
    index = json.loads(path.read_text())
    index["captures"][2][key] = value
    path.write_text(json.dumps(index))
    for command in (("report", "set", "-o", "page.html"), ("dataset", "info", "set"), ("status", "set")):
        done = commands.run(dataset, *command)
        assert done.returncode == EXIT_BAD_INPUT
        assert f"index.json: is no index of captures: 1 validation error for IndexEntry; {key}" in done.stderr
