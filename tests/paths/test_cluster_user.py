"""The way of somebody with a cluster: docs/clusters.md, word for word, with a stand-in for Slurm on one machine."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.doc_blocks import block_with, shell
from support.render_processes import INTERRUPTED
from support.slurm import START, Slurm

from nlosrender.analysis.run_status import STATES, status_of

PAGE = "clusters.md"
TASKS = 2  # of the array, instead of 16

pytestmark = pytest.mark.slow  # a dozen processes that start the renderer


@pytest.fixture
def user(tmp_path: Path) -> Path:
    """The user's folder with a capture; memory as the page has it."""
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "scene.yaml").write_text(INTERRUPTED.replace("402MB", "7GB"))
    return tmp_path / "work"


def nlosrender(folder: Path, slurm: Slurm, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command as the user does."""
    return shell(" ".join(("nlosrender", *arguments)), folder, slurm.environment)


def status(folder: Path, slurm: Slurm, name: str = "parts") -> dict[str, Any]:
    """Return what ``status --json`` says."""
    done = nlosrender(folder, slurm, "status", name, "--json")
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def wait_until(holds: Callable[[], bool], seconds: float = 120) -> None:
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def is_same(folder: Path, slurm: Slurm, name: str) -> bool:
    """Return whether a capture is, up to rounding, the one rendered at once."""
    if not (folder / "whole.hdf5").exists():
        assert nlosrender(folder, slurm, "render scene.yaml -q -o whole.hdf5").returncode == 0
    return nlosrender(folder, slurm, "compare", name, "whole.hdf5").returncode == 0


def test_an_array_job_killed_stopped_and_merged(user: Path, tmp_path: Path) -> None:
    """The script of the page: a task is killed, then stopped by Slurm's signal and put back; the merge comes last."""
    slurm = Slurm(tmp_path / "slurm", SBATCH_ARRAY_INX=f"1-{TASKS}")
    # 14 work items of about half a second: less memory makes them small
    (user / "scene.yaml").write_text(INTERRUPTED.replace("spp: 4000", "spp: 600000"))
    (user / "render.sh").write_text(block_with(PAGE, "sh", "#SBATCH --array"))
    submitted = shell(block_with(PAGE, "sh", "sbatch --parsable render.sh"), user, slurm.environment)
    assert submitted.returncode == 0, submitted.stderr
    assert "no captures, finished or not" in submitted.stdout
    first, second = slurm.waiting()  # the merge waits for both

    def units() -> int:  # in this process: a command takes longer than a work item
        return sum(each.finished_units or 0 for each in status_of([user / "parts"], 900))

    process = slurm.start(first)
    wait_until(lambda: units() >= 1)
    running = status(user, slurm)
    assert running["states"] == {"running": 1}
    assert running["units"] == 7  # of 14
    os.killpg(process.pid, signal.SIGKILL)
    assert slurm.end(first, process) == -signal.SIGKILL
    stopped = status(user, slurm)
    assert stopped["states"] == {"stopped": 1}
    assert stopped["finished_units"] >= 1
    (missing,) = stopped["missing"]
    assert missing.endswith("--shard I/2 with I = 2")

    process = slurm.start(first)  # as Slurm does after a node failure
    kept = stopped["finished_units"]
    wait_until(lambda: units() > kept)
    (step,) = psutil.Process(process.pid).children()  # Slurm signals a job's steps, not its script
    step.terminate()
    assert slurm.end(first, process) == 130
    assert first in slurm.waiting()  # the script has put itself back

    for name in (first, second):
        assert slurm.end(name, slurm.start(name)) == 0
    assert status(user, slurm)["complete"]
    (merge,) = slurm.waiting()
    assert slurm.end(merge, slurm.start(merge)) == 0
    assert is_same(user, slurm, "scene.hdf5")
    assert slurm.end(first, slurm.start(first)) == 0  # finished before it was put back: nothing to do


def test_shards_in_a_shell(user: Path, tmp_path: Path) -> None:
    """The loop of the page, and its merge."""
    slurm = Slurm(tmp_path / "slurm")
    done = shell(block_with(PAGE, "sh", "--shard $i/4"), user, slurm.environment)
    assert done.returncode == 0, done.stderr
    assert is_same(user, slurm, "scene.hdf5")


def test_workers_by_hand(user: Path, tmp_path: Path) -> None:
    """Processes of this machine; then a scheduler and, instead of one worker on each of three machines, three here."""
    pytest.importorskip("distributed")
    slurm = Slurm(tmp_path / "slurm")
    lines = block_with(PAGE, "sh", "dask scheduler").splitlines()
    here, scheduler, worker, elsewhere = [line.split("#")[0].strip() for line in lines if line]
    assert shell(f"{here} -o here.hdf5", user, slurm.environment).returncode == 0
    assert is_same(user, slurm, "here.hdf5")
    script = f"""trap 'kill $(jobs -p)' EXIT
{scheduler} 2>/dev/null
while ! test -e scheduler.json; do sleep 0.1; done
{worker} 2>/dev/null
{worker} 2>/dev/null
{worker} 2>/dev/null
{elsewhere}
"""
    # "cmd &" and a redirection behind it: the redirection belongs before the ampersand
    script = re.sub(r"& 2>/dev/null", "2>/dev/null &", script)
    done = shell(f"{script}", user, slurm.environment)
    assert done.returncode == 0, done.stderr
    assert is_same(user, slurm, "a.hdf5")


def test_workers_started_by_dask_jobqueue(user: Path, tmp_path: Path) -> None:
    """The program of the page asks Slurm for workers, renders on them, and ends them."""
    pytest.importorskip("dask_jobqueue")
    slurm = Slurm(tmp_path / "slurm", **{START: "1"})
    (user / "cluster.py").write_text(block_with(PAGE, "python", "SLURMCluster"))
    done = shell("python cluster.py", user, slurm.environment)
    assert done.returncode == 0, done.stderr
    submitted = sorted(slurm.jobs.glob("*.sh"))
    assert len(submitted) == 4
    assert all("#SBATCH --cpus-per-task=8" in script.read_text() for script in submitted)
    assert is_same(user, slurm, "scene.hdf5")


def test_the_page_of_states_is_that_of_the_program() -> None:
    """Every state of ``status`` is explained, and no other."""
    section = (
        (Path(__file__).parents[2] / "docs" / PAGE).read_text().partition("## How far it is")[2].partition("\n## ")[0]
    )
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == set(STATES)
