"""How far renders have come, by their files alone."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import commands
from support.partial_captures import CONFIG, Stopped, write_part

from nlosrender.analysis.comparison.dataset import captures_below
from nlosrender.analysis.run_status import RenderStatus, missing_shards, status_of, status_report
from nlosrender.capture.part import Selection
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, FileError
from nlosrender.files.atomic_write import partial_folder
from nlosrender.files.dataset_index import IndexEntry
from nlosrender.files.partial.journal import JOURNAL, Journal
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.partial.work_item_log import run_record

STALE = 900.0


@pytest.fixture
def parts(tmp_path: Path, header_of: Callable, block_of: Callable) -> Path:
    """A folder with shard 1 of 4 finished, shard 2 stopped after one of its work items, the others not begun."""
    header = header_of("exhaustive")
    write_part(tmp_path / "1.hdf5", header, block_of(header), Selection(shard=(1, 4)))
    with pytest.raises(Stopped):
        write_part(tmp_path / "2.hdf5", header, block_of(header), Selection(shard=(2, 4)), stop_after=1)
    return tmp_path


def journal_of(folder: Path) -> Path:
    """The journal of the stopped shard."""
    return partial_folder(folder / "2.hdf5") / JOURNAL


@contextmanager
def run_of(folder: Path, units: int, begun_before: float, silent: float):
    """A process that has begun to render ``units`` work items, and has finished one of them, some seconds ago."""
    journal = Journal(journal_of(folder))
    records = list(journal.records())
    record = run_record(units)
    record["run"]["begun"] = time.time() - begun_before
    journal.clear()
    items = [each for each in records if "unit" in each]
    for each in [*(each for each in records if "unit" not in each and "closed" not in each), record, *items]:
        journal.append(each)
    for path in journal.path.parent.iterdir():
        os.utime(path, (time.time() - silent,) * 2)
    yield
    journal.close()


def test_done_and_stopped(parts: Path) -> None:
    """A finished part is done; one that no process has open is stopped, with the work items it has."""
    done, stopped = status_of([parts], STALE)
    assert (done.file, done.state, done.part) == (str(parts / "1.hdf5"), "done", "--shard 1/4")
    assert (stopped.file, stopped.state, stopped.part) == (str(parts / "2.hdf5"), "stopped", "--shard 2/4")
    assert (stopped.finished_units, stopped.units, stopped.seconds_left) == (1, None, None)
    assert done.capture == stopped.capture
    assert missing_shards([done, stopped]) == [
        f"2 of 4 shards of the capture of {done.file}: --shard I/4 with I = 3, 4"
    ]


def test_running_and_its_time(parts: Path) -> None:
    """One of 5 units took 60 s: 4 more take 240 s, less the 10 s since it was written."""
    with run_of(parts, units=5, begun_before=70, silent=10):
        _, running = status_of([parts], STALE)
        assert (running.state, running.finished_units, running.units) == ("running", 1, 5)
        assert running.seconds_left == pytest.approx(230, abs=2)  # the test itself takes less than 0.4 s
        assert running.run_by.startswith(f"process {os.getpid()} on ")
        (stale,) = status_of([parts / "2.hdf5"], stale_after=5)
        assert (stale.state, stale.seconds_left) == ("stale", None)
    assert status_of([parts / "2.hdf5"], STALE)[0].state == "stopped"


def test_looking_disturbs_no_render(parts: Path, header_of: Callable, block_of: Callable) -> None:
    """A render begins while its journal is looked at, and is seen while it runs; a second one is still refused."""
    with PartialCapture.claim(parts / "3.hdf5", {"config": dict(CONFIG), "part": "--shard 3/4"}):
        status = {Path(each.file).name: each for each in status_of([parts], STALE)}["3.hdf5"]
        assert (status.state, status.finished_units, status.part) == ("running", 0, None)
        with pytest.raises(FileError, match="another render is writing it now"):
            PartialCapture.claim(parts / "3.hdf5", {})
    assert not partial_folder(parts / "3.hdf5").exists()


@pytest.mark.parametrize("how", ["output", "partial", "both", "link"])
def test_names_of_an_unfinished_render(parts: Path, how: str) -> None:
    """The output's name, which may be a link, and that of the folder beside it are one render."""
    (parts / "link.hdf5").symlink_to(parts / "2.hdf5")
    output, partial = parts / "2.hdf5", partial_folder(parts / "2.hdf5")
    names = {"output": [output], "partial": [partial], "both": [output, partial], "link": [parts / "link.hdf5"]}[how]
    (status,) = status_of(names, STALE)
    assert (status.state, status.finished_units) == ("stopped", 1)


def test_damage_is_a_failure_and_a_cut_journal_is_not(parts: Path) -> None:
    """A file that cannot be read has failed, with the reason; what a kill cut off a journal never happened."""
    (parts / "1.hdf5").write_bytes(b"no capture")
    content = journal_of(parts).read_bytes()
    journal_of(parts).write_bytes(content[:-3])  # in the record that the file is closed
    failed, stopped = status_of([parts], STALE)
    assert failed.state == "failed"
    assert "is not an HDF5 file" in failed.message
    assert (stopped.state, stopped.finished_units) == ("stopped", 1)
    journal_of(parts).write_bytes(b"")
    assert status_of([parts / "2.hdf5"], STALE)[0].finished_units == 0


def test_what_was_made_of_a_capture_is_no_render(tmp_path: Path) -> None:
    """Volumes of ``reconstruct`` and exports for y-tal stand beside their capture by default; status, check and report
    pass over them, named they are refused."""
    for name, datasets in (("z-phasor.hdf5", "volume x y z"), ("z-tal.hdf5", "H H_format")):
        with h5py.File(tmp_path / name, "w") as file:
            file.update(dict.fromkeys(datasets.split(), np.zeros(1)))
    assert status_of([tmp_path], STALE) == []
    assert captures_below(tmp_path) == []
    assert status_of([tmp_path / "z-tal.hdf5"], STALE)[0].state == "failed"
    (tmp_path / "z.hdf5").write_bytes(b"damaged")
    assert [status.state for status in status_of([tmp_path], STALE)] == ["failed"]
    assert captures_below(tmp_path) == ["z.hdf5"]


def test_captures_of_a_sweep_that_are_not_there(tmp_path: Path) -> None:
    """Of an index the captures without a file are pending, or failed with their reason."""
    entries = [
        IndexEntry(0, "a.hdf5", {}, "pending"),
        IndexEntry(1, "train/b.hdf5", {}, "failed", message="no such mesh"),
    ]
    content = {"source": "x", "keys": [], "captures": [vars(entry) for entry in entries]}
    (tmp_path / "index.json").write_text(json.dumps(content))
    assert [(status.state, status.message) for status in status_of([tmp_path], STALE)] == [
        ("pending", ""),
        ("failed", "no such mesh"),
    ]


def test_what_it_adds_up_to() -> None:
    """Complete: all files done, no shard missing; the time left is that of the slowest, if all have one."""
    done = RenderStatus("a", "done", "--shard 1/2", "hash")
    other = RenderStatus("b", "done", "--shard 2/2", "hash")
    assert status_report([done, other])["complete"]
    assert not status_report([done])["complete"]
    assert not status_report([])["complete"]
    slow = RenderStatus("c", "running", finished_units=1, units=4, seconds_left=90.0)
    quick = RenderStatus("d", "running", finished_units=3, units=4, seconds_left=5.0)
    report = status_report([done, other, slow, quick])
    assert (report["complete"], report["seconds_left"]) == (False, 90.0)
    assert (report["finished_units"], report["units"]) == (4, 8)
    assert [each["file"] for each in report["renders"]] == ["c", "d", "a", "b"]  # what is done comes last
    new = RenderStatus("e", "running", finished_units=0, units=4)
    assert status_report([slow, new])["seconds_left"] is None


def test_command(parts: Path) -> None:
    """A line for each render and the sums; the same as JSON; a name that is nothing is a mistake."""
    with run_of(parts, units=5, begun_before=70, silent=10):
        done = commands.run(parts, "status", ".")
        assert done.returncode == EXIT_OK, done.stderr
        assert [line.split()[1:3] for line in done.stdout.splitlines()[1:3]] == [["running", "1"], ["done", "--shard"]]
        assert "1 of 5, 20 %" in done.stdout
        assert "about 3.8 min" in done.stdout
        assert "not begun: 2 of 4 shards" in done.stdout
        report = json.loads(commands.run(parts, "status", ".", "--json").stdout)
        assert report["states"] == {"running": 1, "done": 1}
    done = commands.run(parts, "status", "nothing")
    assert (done.returncode, done.stdout) == (EXIT_BAD_INPUT, "")
    assert "there is no such file, finished or not" in done.stderr


def test_info_of_an_unfinished_capture_says_the_same(parts: Path) -> None:
    """State, units and time left are those of ``status``."""
    with run_of(parts, units=5, begun_before=70, silent=10):
        found = json.loads(commands.run(parts, "info", ".2.hdf5.partial", "--json").stdout)
    assert (found["state"], found["finished_units"], found["units"]) == ("running", 1, 5)
    assert found["seconds_left"] == pytest.approx(230, abs=2)
