"""``nlosrender render --executor dask``: real schedulers and real worker processes, the same file as a local render."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.commands import run
from support.render_processes import (
    PARTIAL,
    Process,
    ended,
    plate_scene,
    report_of,
    saved_units,
    start_render,
    wait_for_units,
)

from nlosrender.capture.part import WHOLE
from nlosrender.capture.plan import WorkItem
from nlosrender.capture.tile import Tile
from nlosrender.config.load import config_to_dict, load_config
from nlosrender.errors import BackendError
from nlosrender.files.identity import capture_identity
from nlosrender.rendering import dask_cluster
from nlosrender.rendering.dask_cluster import joined_cluster
from nlosrender.rendering.dask_worker import Job, RemoteError, render_remotely

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")

SCENE = plate_scene("""\
    - {type: mesh, filename: triangle.obj}
capture:
  scan_type: exhaustive
  sensor_grid: {nx: 5, ny: 3}
  laser_grid: {nx: 2, ny: 7}
  account_first_and_last_bounces: false
time_axis: {start_opl: 1.6, bin_width_opl: 0.01, n_bins: 300}
render: {max_bounces: 4, engine: path, spp: 20000}
output: {path: a.hdf5, variance: true}
""")
TRIANGLE = "v -0.2 0.1 1.1\nv 0.2 0.1 1.1\nv 0.0 0.4 1.2\nf 1 3 2\n"
SUMS = (
    "samples",
    "error_estimate",
    "energy",
    "out_of_window_energy",
    "capture_hash",
    "energy_error",
    "energy_error_per_bounce",
    "error_estimate_per_bounce",
)
N_UNITS = 14  # of two workers: one of each laser
DASK = ("--executor", "dask", "--workers", "2")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the configuration and its mesh."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    return tmp_path


def started(folder: Path, *options: str) -> Process:
    """Start a render in a process group of its own: Ctrl-C goes to all of it, as on a terminal."""
    return start_render(folder, *options, own_group=True)


def local_workers(process: Process) -> list[psutil.Process]:
    """The worker processes that a render has started on this machine."""
    found = psutil.Process(process.pid).children(recursive=True)
    return [child for child in found if "spawn_main" in " ".join(child.cmdline())]


def assert_same(one: Path, other: Path) -> None:
    """Two files hold the same, bit for bit: samples, variances, sums, and everything about the grids."""
    with h5py.File(one) as a, h5py.File(other) as b:
        assert set(a) == set(b)
        assert "variance" in a
        for name in a:
            assert a[name][()].tobytes() == b[name][()].tobytes(), name
        assert np.count_nonzero(a["data"][()]) > 100
        for name in SUMS:
            assert a.attrs[name] == b.attrs[name], name


def test_a_killed_worker_costs_nothing(folder: Path) -> None:
    """Two worker processes, one of them killed half-way: the file of a local render in one process, bit for bit."""
    done = run(folder, "render", "scene.yaml", "-o", "whole.hdf5", "--json")
    assert json.loads(done.stdout)["units"] == 1
    process = started(folder, *DASK, "--json")
    assert wait_for_units(folder, process, 2) >= 2
    local_workers(process)[0].kill()
    assert saved_units(folder) < N_UNITS - 2  # it was rendering one
    assert report_of(process)["units"] == N_UNITS
    assert_same(folder / "whole.hdf5", folder / "a.hdf5")
    assert not (folder / PARTIAL).exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        ("render.engine=virtual_lights", "render.spp=null", "render.target_error=0.02"),
        ("capture={scan_type: confocal, sensor_grid: {nx: 17, ny: 19}}", "render.spp=64", "time_axis.n_bins=2500"),
        ("render.spp=null", "render.target_error=0.05"),  # settled by a pilot, once
    ],
    ids=["virtual_lights", "confocal", "target_error"],
)
def test_every_engine_and_scan_type(folder: Path, settings: tuple[str, ...]) -> None:
    """Where a work item is rendered, and how the capture is cut for it, changes no bit."""
    options = [part for setting in settings for part in ("--set", setting)]
    report_of(started(folder, *options, "-o", "whole.hdf5", "--json"))
    assert report_of(started(folder, *options, *DASK, "--json"))["units"] > 1
    assert_same(folder / "whole.hdf5", folder / "a.hdf5")


@pytest.mark.slow
def test_ctrl_c_saves_and_either_executor_goes_on(folder: Path) -> None:
    """Ctrl-C reaches the workers as well: what they render is saved, exit code 130, and a local render goes on."""
    report_of(started(folder, "-o", "whole.hdf5", "--json"))
    process = started(folder, *DASK)
    assert wait_for_units(folder, process, 3) >= 3
    os.killpg(process.pid, signal.SIGINT)
    code, errors = ended(process)
    assert code == 130, errors
    assert "stopped by SIGINT; " in errors
    assert f" of {N_UNITS} work items are finished and saved" in errors
    resumed = report_of(started(folder, "--resume", "--json"))["resumed_units"]
    assert 4 <= resumed < N_UNITS  # at least one that was in flight
    assert_same(folder / "whole.hdf5", folder / "a.hdf5")


@pytest.mark.slow
def test_a_unit_that_ends_its_workers_stops_the_render(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 5 and what to do; what was finished is saved, and the same command goes on."""
    report_of(started(folder, "-o", "whole.hdf5", "--json"))
    with monkeypatch.context() as patched:
        patched.setenv(
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0"
        )  # deaths that are a work item's own bad luck
        process = started(folder, *DASK)
        assert wait_for_units(folder, process, 2) >= 2
        local_workers(process)[0].kill()
        code, errors = ended(process)
    assert code == 5, errors
    assert "a work item has ended every worker process it was given to. Lower render.memory_limit" in errors
    assert f" of {N_UNITS} work items are finished and saved. The same command goes on from there." in errors
    assert 2 <= report_of(started(folder, *DASK, "--json"))["resumed_units"] < N_UNITS
    assert_same(folder / "whole.hdf5", folder / "a.hdf5")


@pytest.mark.slow
def test_a_first_unit_that_ends_its_workers_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is nothing to go on with: a failure, exit code 1."""
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    process = started(folder, *DASK, "--set", "render.spp=100000000")
    while len(local_workers(process)) < 2:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(5)  # they have started, and the first work items are on their way
    local_workers(process)[0].kill()
    code, errors = ended(process)
    assert code == 1, errors
    assert "before anything was finished; nothing is kept" in errors
    assert not (folder / PARTIAL).exists()


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.0, 0.3, 1.0])
def test_ctrl_c_while_workers_start(folder: Path, seconds: float) -> None:
    """They do not hear it from their first moment on: one word is all that is said."""
    process = started(folder, *DASK)
    while not local_workers(process):
        time.sleep(0.01)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGINT)
    code, errors = ended(process)
    assert (code, "Fatal" in errors) == (130, False), errors
    assert not (folder / "a.hdf5").exists()


@contextmanager
def dask_processes(folder: Path, workers: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler that writes ``scheduler.json``, and workers without a nanny: the dead stay dead."""
    dask = [sys.executable, "-m", "dask"]
    joining = ["--scheduler-file", str(folder / "scheduler.json")]
    commands = [[*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *joining]]
    commands += [[*dask, "worker", "--nthreads", "1", "--no-nanny", "--no-dashboard", *joining]] * workers
    with ExitStack() as stack:
        started = []
        for command in commands:
            process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
            started.append(process)
        while not (folder / "scheduler.json").exists():
            time.sleep(0.05)
        yield started


@pytest.mark.slow
@pytest.mark.parametrize("by", ["file", "address"])
def test_a_scheduler_that_runs_elsewhere(folder: Path, by: str) -> None:
    """Workers of a cluster, one of which dies and is not replaced: the other one renders its work items."""
    report_of(started(folder, "-o", "whole.hdf5", "--json"))
    with dask_processes(folder, workers=2) as (_, victim, _):
        file = folder / "scheduler.json"
        scheduler = "scheduler.json" if by == "file" else json.loads(file.read_text())["address"]
        process = started(folder, *DASK, "--scheduler", scheduler, "--json")
        assert wait_for_units(folder, process, 2) >= 2
        victim.kill()
        assert saved_units(folder) < N_UNITS - 2
        assert report_of(process)["units"] == N_UNITS
        assert_same(folder / "whole.hdf5", folder / "a.hdf5")


@pytest.mark.slow
def test_a_scheduler_that_dies_costs_what_is_in_flight(folder: Path) -> None:
    """Exit code 5; what was finished is saved, and the same command on this machine goes on."""
    report_of(started(folder, "-o", "whole.hdf5", "--json"))
    with dask_processes(folder, workers=1) as (scheduler, _):
        process = started(folder, "--executor", "dask", "--scheduler", "scheduler.json")
        assert wait_for_units(folder, process, 1) >= 1
        scheduler.kill()
        code, errors = ended(process)
    assert code == 5, errors
    assert "the dask scheduler is gone" in errors
    assert report_of(started(folder, "--json"))["resumed_units"] >= 1
    assert_same(folder / "whole.hdf5", folder / "a.hdf5")


@pytest.mark.slow
def test_an_error_of_a_unit_is_told_and_not_retried(folder: Path) -> None:
    """Samples beyond float32 are found by the worker; exit code 1 and nothing left, as in a local render."""
    scene = (folder / "scene.yaml").read_text().replace("    - {type: mesh, filename: triangle.obj}\n", "")
    for length in ("2.0", "1.6", "0.5", "0.4", "0.1", "0.9"):  # in micrometres H^2 is no float32 number
        scene = re.sub(rf"\b{length}\b", f"{length}e-6", scene)
    (folder / "scene.yaml").write_text(scene.replace("0.01,", "1.0e-8,"))
    code, errors = ended(started(folder, *DASK, "--set", "capture.laser_energy=1e15"))
    assert code == 1, errors
    assert re.search(r"is inf at laser .* \(on worker tcp://", errors)
    assert not (folder / PARTIAL).exists()


@pytest.mark.slow
def test_a_worker_refuses_what_it_would_render_otherwise(folder: Path) -> None:
    """Another version, or another mesh under the same name, on the worker's machine ends the render."""
    config = load_config(folder / "scene.yaml", [])
    there = capture_identity(config_to_dict(config), str(WHOLE), "llvm_ad_mono", 10)
    there["config"]["scene"]["hidden_geometry"][1]["filename"] = "sha256:0"
    there["versions"]["drjit"] = "0.1"
    with joined_cluster(workers=1) as cluster:
        job = Job(config, WHOLE, there, "llvm", cluster.processes)
        everything = WorkItem(Tile(0, 3, 0, 5), Tile(0, 1, 0, 1), ())
        future = cluster.client.submit(render_remotely, job, everything, {}, None, pure=False)
        remote = future.result(timeout=60)
    assert isinstance(remote, RemoteError)
    with pytest.raises(BackendError, match=r"hidden_geometry\.1\.filename: \"sha256:0\" there, .*versions\.drjit"):
        raise remote.error()


@pytest.mark.slow
def test_a_sweep_uses_one_cluster(folder: Path) -> None:
    """The captures of a sweep are those of a local run; the workers set up one after the other."""
    with (folder / "scene.yaml").open("a") as stream:
        stream.write("sweep: {keys: {render.seed: [1, 2]}}\n")
    for name, options in {"here": (), "there": DASK}.items():
        report_of(started(folder, "-o", f"{name}/{{index}}.hdf5", "--json", *options))
    captures = sorted((folder / "here").glob("*.hdf5"))
    assert len(captures) == 2
    for capture in captures:
        assert_same(capture, folder / "there" / capture.name)


def test_tracebacks_of_other_threads_stay_out_of_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """What dask's and asyncio's loggers say of a lost connection is no traceback; their plain warnings pass."""
    pytest.importorskip("distributed")
    dask_cluster._silence_tracebacks()
    for name in ("distributed.client", "distributed.batched", "asyncio"):
        logger = logging.getLogger(name)
        logger.addHandler(caplog.handler)
        logger.error("lost", exc_info=OSError("connection refused"))
        logger.warning("%s warns", name)
        logger.removeHandler(caplog.handler)
    assert {record.getMessage() for record in caplog.records} == {
        "distributed.client warns", "distributed.batched warns", "asyncio warns"
    }  # fmt: skip


def test_without_dask_it_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The extra is optional: exit code 6 and the command that installs it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = run(folder, "render", "scene.yaml", *DASK)
    assert done.returncode == 6
    assert "pip install 'nlosrender[dask]'" in done.stderr


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        # two workers and the process that writes: a third of 1 GB each, of which the program takes 0.4 GB
        ("render.memory_limit=1GB", "shared by 2 workers and this process, 333 MB each"),
        (
            "render.memory_limit=1200.03MB",
            "shared by 2 workers and this process, 400 MB each",
        ),  # a sensor point takes more
        ("scene.hidden_geometry.1.filename=empty.obj", "empty.obj"),
    ],
)
def test_mistakes_are_told_before_workers_start(
    folder: Path, monkeypatch: pytest.MonkeyPatch, setting: str, message: str
) -> None:
    """Exit code 3 with the place, after less than a process takes to start; the share of a worker is named."""
    (folder / "empty.obj").write_text("")
    monkeypatch.setattr(dask_cluster, "_local_workers", lambda count: pytest.fail("workers are started"))
    done = run(folder, "render", "scene.yaml", *DASK, "--set", setting)
    assert (done.returncode, done.stderr.count("--set " + setting)) == (3, 1), done.stderr
    assert message in done.stderr
    assert not (folder / PARTIAL).exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--executor", "dask", "--scheduler", "127.0.0.1:1"), 6, "no scheduler can be reached"),
        (("--executor", "dask", "--scheduler", "none.json"), 6, "there is no such scheduler file"),
        (("--executor", "dask", "--scheduler", "tcp://"), 6, "no scheduler can be reached"),
        (("--scheduler", "127.0.0.1:1"), 2, "needs --executor dask"),
        (("--workers", "2"), 2, "needs --executor dask"),
        (("--executor", "dask", "--workers", "0"), 2, "greater than or equal to 1"),
    ],
)
def test_what_cannot_work_is_said_at_once(folder: Path, options: tuple[str, ...], code: int, message: str) -> None:
    """No scheduler: exit code 6 with what to do; slips of the pen: 2; nothing is left behind."""
    found, errors = ended(started(folder, *options))
    assert found == code, errors
    assert message in errors
    assert not (folder / "a.hdf5").exists()
    assert not (folder / PARTIAL).exists()
