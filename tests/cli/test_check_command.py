"""``check`` as continuous integration meets it: JUnit XML, a page, tolerances of single files, references replaced."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from support import commands
from support.commands import Done
from support.pages import Page
from support.point_captures import cells, points_header, write_light

from nlosrender.errors import (
    EXIT_BAD_INPUT,
    EXIT_COMPARISON_EXCEEDED,
    EXIT_OK,
    EXIT_USAGE,
    ConfigError,
    FileError,
)

ROWS, COLUMNS, BINS = 3, 5, 7
ODD = "<script>alert(1)<&>'\".hdf5"  # a name that would run where it is not escaped


def write(path: Path, factor: float = 1.0, bins: int = BINS) -> Path:
    """Write a confocal capture; its third bounce is ``factor`` times a fixed random one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = points_header("confocal", cells(COLUMNS, ROWS, 2.0, 1.6), bins=(0.0, 0.01, bins))
    light = np.random.default_rng(0).random((1, 1, ROWS, COLUMNS, bins))
    return write_light(path, header, light * factor)


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """A folder ``out`` with captures 0, 1 and 10 % brighter than in ``ref``, one that ``ref`` lacks, one missing."""
    for name, factor in (("same.hdf5", 1.0), ("deep/bright.hdf5", 1.01), (ODD, 1.1), ("gone.hdf5", 1.0)):
        write(tmp_path / "ref" / name)
        if name != "gone.hdf5":
            write(tmp_path / "out" / name, factor)
    write(tmp_path / "out" / "more.hdf5")
    return tmp_path


def check(folder: Path, *options: object) -> Done:
    """Run ``check out --reference ref``."""
    return commands.run(folder, "check", "out", "--reference", "ref", *options)


def test_junit_counts_what_the_check_finds(folders: Path) -> None:
    """One test case for each reference; failures beyond a tolerance and missing ones, errors that cannot be read."""
    (folders / "out" / "same.hdf5").write_text("no capture")
    done = check(folders, "--max-rel-l2", 0.05, "--junit", "c.xml")
    assert done.returncode == EXIT_BAD_INPUT
    suite = ElementTree.parse(folders / "c.xml").getroot()[0]
    assert [suite.get(key) for key in ("tests", "failures", "errors")] == ["4", "2", "1"]
    found = {case.get("name"): [part.get("type") for part in case] for case in suite.iter("testcase")}
    assert found == {
        ODD: ["exceeds"],
        "deep/bright.hdf5": [],
        "gone.hdf5": ["missing"],
        "same.hdf5": ["unreadable"],
    }
    assert "more.hdf5" in (suite.findtext("system-out") or "")


def test_junit_of_a_name_that_xml_cannot_hold(tmp_path: Path) -> None:
    """Control characters, and bytes that are no text, are written out: the file stays well-formed."""
    name = os.fsdecode(b"caf\xe9\x01.hdf5")
    write(tmp_path / "ref" / name)
    write(tmp_path / "out" / name, 2.0)
    assert check(tmp_path, "--junit", "c.xml", "--html", "c.html", "--json").returncode == EXIT_COMPARISON_EXCEEDED
    (case,) = ElementTree.parse(tmp_path / "c.xml").getroot().iter("testcase")
    assert case.get("name") == r"caf\udce9\x01.hdf5"
    assert r"caf\udce9\x01.hdf5" in (tmp_path / "c.html").read_text()


def test_each_capture_has_one_line(tmp_path: Path) -> None:
    """Also one whose name has a line break, which would else read as a line of its own."""
    write(tmp_path / "ref" / "a\nok b.hdf5")
    for name in ("a\nok b.hdf5", "c\nok d.hdf5"):
        write(tmp_path / "out" / name)
    lines = [line for line in check(tmp_path).stdout.splitlines() if "hdf5" in line]
    assert [line.partition(":")[0] for line in lines] == [r"ok          a\nok b.hdf5", r"extra       c\nok d.hdf5"]


def test_page_loads_nothing_and_runs_nothing(folders: Path) -> None:
    """No tag comes from a file's name; pictures are in the page: three walls of each capture that differs."""
    done = check(folders, "--max-rel-l2", 0.05, "--html", "c.html")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    text = (folders / "c.html").read_text()
    page = Page(text)
    assert "script" not in page.tags
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert not re.search(r"https?://|url\(|@import", text)
    assert page.tags.count("img") == 2 * 3
    assert "prefers-color-scheme: dark" in text
    for word in ("exceeds", "missing", "extra: not in the reference", "&lt;script&gt;"):
        assert word in text


def test_page_of_captures_that_cannot_be_compared(tmp_path: Path) -> None:
    """What differs in structure is listed, without pictures."""
    write(tmp_path / "ref" / "a.hdf5")
    write(tmp_path / "out" / "a.hdf5", bins=BINS + 2)
    assert check(tmp_path, "--html", "c.html").returncode == EXIT_COMPARISON_EXCEEDED
    text = (tmp_path / "c.html").read_text()
    assert "Not comparable" in text
    assert "<img" not in text


@pytest.mark.parametrize("option", ["--junit", "--html"])
def test_reports_replace_only_reports(folders: Path, option: str) -> None:
    """A file of another kind is refused before anything is compared; a report of ours is replaced."""
    thesis = folders / "thesis.txt"
    thesis.write_text("<html>mine</html>")
    done = check(folders, option, thesis)
    assert (done.returncode, done.stdout) == (EXIT_BAD_INPUT, "")
    assert thesis.read_text() == "<html>mine</html>"
    for _ in range(2):
        assert check(folders, option, "report").returncode == EXIT_COMPARISON_EXCEEDED
    assert check(folders, "--junit", "one", "--html", "./one").returncode == EXIT_USAGE


def test_tolerances_of_single_files(folders: Path) -> None:
    """The first name or pattern that fits a file decides; the options are for the others."""
    rules = folders / "t.yaml"
    rules.write_text('deep/*: {max_rel_l2: 0.02, max_energy: 0.005}\n"*script*": {max_rel_l2: 0.2}\n')
    statuses = {
        file["name"]: file["status"]
        for file in json.loads(check(folders, "--tolerances", rules, "--json").stdout)["files"]
    }
    assert statuses == {ODD: "ok", "deep/bright.hdf5": "exceeds", "gone.hdf5": "missing", "same.hdf5": "ok"}
    rules.write_text('deep/bright.hdf5: {max_rel_l2: 0.02}\n"*": {}\n')
    done = check(folders, "--tolerances", rules, "--max-rel-l2", 10)
    assert "ok          deep/bright.hdf5" in done.stdout
    assert f"exceeds     {ODD}" in done.stdout  # {} is stricter than the option


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a*.hdf5: {max_rel_l2: -1}", r"t.yaml:1:23: a\*.hdf5.max_rel_l2: got -1, need a number >= 0"),
        ("same.hdf5: {max_l2: 1}", "same.hdf5.max_l2: unknown key. Did you mean max_rel_l2"),
        ("same.hdf5: 0.1", "same.hdf5: got 0.1, need a mapping"),
        ("sane.hdf5: {}", "t.yaml:1:1: 'sane.hdf5' .*none matches"),
        ("'*': {}\nsame.hdf5: {}", "t.yaml:2:1: 'same.hdf5' .*an earlier pattern takes them"),
        ("- 1", r"t.yaml:1:1: got \[1\], need a mapping"),
        ("", "t.yaml.* need a mapping"),
    ],
)
def test_tolerances_that_are_none(folders: Path, text: str, message: str) -> None:
    """Mistakes are told with their place, and nothing is compared."""
    (folders / "t.yaml").write_text(text)
    done = check(folders, "--tolerances", "t.yaml")
    assert (done.returncode, done.stdout) == (ConfigError.exit_code, "")
    assert re.search(message, done.stderr)


def test_update_replaces_what_exceeds(folders: Path) -> None:
    """Captures beyond a tolerance become the references; missing ones still fail; nothing else is touched."""
    untouched = {name: (folders / "ref" / name).stat().st_mtime_ns for name in ("same.hdf5", "deep/bright.hdf5")}
    done = check(folders, "--max-rel-l2", 0.05, "--update", "--yes")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED  # gone.hdf5
    assert f"replaced    ref/{ODD}" in done.stdout
    assert (folders / "ref" / ODD).read_bytes() == (folders / "out" / ODD).read_bytes()
    assert untouched == {name: (folders / "ref" / name).stat().st_mtime_ns for name in untouched}
    (folders / "ref" / "gone.hdf5").unlink()
    assert check(folders, "--max-rel-l2", 0.05).returncode == EXIT_OK
    assert not list(folders.rglob("*.partial"))


def test_update_refuses_references_by_others_before_it_replaces_any(folders: Path) -> None:
    """A reference that is no capture by this program stays, and so do all others."""
    import h5py

    write(folders / "ref" / "zz.hdf5", 3.0)
    write(folders / "out" / "zz.hdf5")
    with h5py.File(folders / "ref" / "zz.hdf5", "r+") as file:
        file.attrs["engine"] = "another"
    before = (folders / "ref" / ODD).read_bytes()
    done = check(folders, "--max-rel-l2", 0.05, "--update", "--yes")
    assert done.returncode == FileError.exit_code
    assert "is not a capture by nlosrender" in done.stderr
    assert (folders / "ref" / ODD).read_bytes() == before


def test_update_needs_a_terminal_or_yes(folders: Path) -> None:
    """Without a terminal nobody can answer: refused before the comparison. --yes alone means nothing."""
    done = check(folders, "--update")
    assert (done.returncode, done.stdout) == (EXIT_USAGE, "")
    assert "add --yes" in done.stderr
    assert check(folders, "--yes").returncode == EXIT_USAGE


@pytest.mark.parametrize(("answer", "is_replaced"), [("y", True), pytest.param("", False, marks=pytest.mark.slow)])
def test_update_asks_at_a_terminal(folders: Path, answer: str, is_replaced: bool) -> None:
    """Only a yes replaces."""
    before = (folders / "ref" / ODD).read_bytes()
    main, terminal = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "nlosrender",
        "check",
        "out",
        "--reference",
        "ref",
        "--max-rel-l2",
        "0.05",
        "--update",
    ]
    with subprocess.Popen(
        command, cwd=folders, stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        os.write(main, f"{answer}\n".encode())
        _, errors = process.communicate(timeout=60)
    os.close(main)
    os.close(terminal)
    assert b"Replace 1 references" in errors
    assert process.returncode == EXIT_COMPARISON_EXCEEDED  # gone.hdf5
    assert ((folders / "ref" / ODD).read_bytes() != before) == is_replaced
