"""``nlosrender render`` killed, interrupted, out of disk, started twice: nothing finished is lost or broken."""

from __future__ import annotations

import json
import random
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.commands import run
from support.render_processes import INTERRUPTED, N_UNITS, PARTIAL, ended, start_render, wait_for_units

from nlosrender.files.partial.partial_capture import PartialCapture


def rendered(folder: Path, *options: str) -> dict[str, Any]:
    """Render ``scene.yaml`` undisturbed, in the tests' own process; return the report."""
    done = run(folder, "render", "scene.yaml", *options, "--json")
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration and what an uninterrupted render makes of it, ``whole.hdf5``."""
    folder = tmp_path_factory.mktemp("scale")
    (folder / "scene.yaml").write_text(INTERRUPTED)
    report = rendered(folder, "-o", "whole.hdf5")
    assert report["units"] == N_UNITS
    return folder


@pytest.fixture
def fresh(folder: Path) -> Iterator[Path]:
    """The same without anything of the output."""
    yield folder
    (folder / "a.hdf5").unlink(missing_ok=True)
    shutil.rmtree(folder / PARTIAL, ignore_errors=True)


def assert_whole(folder: Path) -> None:
    """The output is what an uninterrupted render gives."""
    with h5py.File(folder / "whole.hdf5") as whole, h5py.File(folder / "a.hdf5") as file:
        assert set(whole) == set(file)
        for name in whole:
            np.testing.assert_array_equal(whole[name][()], file[name][()])
        assert whole["data"][()].any()
        more = ("energy_error", "energy_error_per_bounce", "error_estimate_per_bounce")
        for name in ("samples", "error_estimate", "energy", "out_of_window_energy", "capture_hash", *more):
            assert whole.attrs[name] == file.attrs[name], name


@pytest.mark.parametrize("kills", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_killed_at_random_moments(fresh: Path, kills: int) -> None:
    """kill -9 costs at most the unit in flight, and never leaves an output that cannot be read."""
    rng = random.Random(kills)
    saved = done = 0
    while done < kills:
        process = start_render(fresh)
        reached = wait_for_units(fresh, process, rng.randint(saved, min(saved + 2, N_UNITS)))
        time.sleep(rng.uniform(0, 0.06))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        done += 1
        if (fresh / "a.hdf5").exists():  # it was done already, or is from an earlier round
            assert_whole(fresh)
            (fresh / "a.hdf5").unlink()  # a kill right after that may have left the folder: it means nothing
            saved = 0
            continue
        assert reached >= saved or process.returncode == -signal.SIGKILL
        saved = max(saved, reached)
    report = rendered(fresh)
    assert report["resumed_units"] >= saved
    assert_whole(fresh)
    assert not (fresh / PARTIAL).exists()


def test_a_journal_without_its_samples_means_nothing(fresh: Path) -> None:
    """Killed after the output was put in place, before the journal was gone: the next render begins anew."""
    partial = fresh / PARTIAL
    process = start_render(fresh)
    assert wait_for_units(fresh, process, 1) >= 1
    journal = (partial / "journal").read_bytes()
    process.communicate(timeout=120)
    (fresh / "a.hdf5").unlink()
    partial.mkdir()
    (partial / "journal").write_bytes(journal)
    report = rendered(fresh)
    assert report["resumed_units"] == 0
    assert_whole(fresh)
    assert not partial.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_stop_saves_and_is_gone_on_from(fresh: Path, number: signal.Signals) -> None:
    """Ctrl-C, or a batch system's notice: the unit is finished, exit code 130, and the same command goes on."""
    process = start_render(fresh)
    reached = wait_for_units(fresh, process, 4)
    process.send_signal(number)
    code, errors = ended(process)
    assert code == 130
    assert f"stopped by {number.name}; " in errors
    assert "The same command goes on from there." in errors
    assert not (fresh / "a.hdf5").exists()
    report = rendered(fresh, "--resume")
    assert reached + 1 <= report["resumed_units"] < N_UNITS  # the unit in flight was finished
    assert_whole(fresh)


def test_a_full_disk_keeps_what_is_finished(fresh: Path) -> None:
    """The message says what to do, the earlier file is untouched, and with space the render goes on: exit code 5."""
    shutil.copy(fresh / "whole.hdf5", fresh / "a.hdf5")
    whole = (fresh / "whole.hdf5").stat().st_size

    code, errors = ended(start_render(fresh, file_limit=whole * 2 // 3))
    assert code == 5, errors
    assert "a.hdf5: cannot be written: File too large. Free some space" in errors
    assert "work items are finished and saved" in errors
    assert (fresh / "a.hdf5").read_bytes() == (fresh / "whole.hdf5").read_bytes()
    report = rendered(fresh)
    assert 0 < report["resumed_units"] < N_UNITS
    assert_whole(fresh)


@pytest.mark.slow
def test_a_disk_without_any_space_leaves_nothing(fresh: Path) -> None:
    """Where nothing could be saved nothing is left, and the exit code is that of a failure."""

    code, errors = ended(start_render(fresh, file_limit=1000))
    assert code == 1
    assert "a.hdf5: cannot be written" in errors
    assert not (fresh / "a.hdf5").exists()
    assert not (fresh / PARTIAL).exists()


def test_two_renders_into_one_file(fresh: Path) -> None:
    """The second one is refused with a clear message, and the first does not notice."""
    with PartialCapture.claim(fresh / "a.hdf5", {}):
        done = run(fresh, "render", "scene.yaml", "--overwrite")
    assert done.returncode == 3
    assert "a.hdf5: another render is writing it now" in done.stderr


@pytest.mark.slow
def test_shards_from_a_shell(fresh: Path) -> None:
    """The documented loop: shards, then merge; a missing shard ends with exit code 3 and its name."""
    for number in (1, 2):
        rendered(fresh, "-o", f"part{number}.hdf5", "--shard", f"{number}/2")
    done = run(fresh, "merge", "-o", "a.hdf5", "part2.hdf5")
    assert (done.returncode, "missing: lasers 0:7" in done.stderr) == (3, True)
    done = run(fresh, "merge", "-o", "a.hdf5", "part1.hdf5", "part2.hdf5", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["parts"] == 2
    assert_whole(fresh)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--shard", "2"), 2, "got '2', need I/N"),
        (("--lasers", "0-3"), 2, "got '0-3', need A:B"),
        (("--lasers", "0:3", "--shard", "1/2"), 2, "takes no --shard"),
    ],
)
def test_parts_that_make_no_sense(fresh: Path, options: tuple[str, ...], code: int, message: str) -> None:
    """Slips of the pen are usage errors; parts that the capture does not have are refused before the render."""
    done = run(fresh, "render", "scene.yaml", *options)
    assert done.returncode == code
    assert message in done.stderr
