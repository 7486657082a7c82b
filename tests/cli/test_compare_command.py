"""``compare`` and ``check`` as their users meet them: tables, JSON, exit codes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import commands
from support.commands import Done
from support.partial_captures import write_capture
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_COMPARISON_EXCEEDED, EXIT_OK, EXIT_USAGE
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.scene.pose import Pose

ROWS, COLUMNS, BINS = 3, 5, 7


def run(*arguments: object) -> Done:
    """Run a command from anywhere."""
    return commands.run(Path.cwd(), *arguments)


def write(path: Path, factor: float = 1.0, bin_width: float = 0.003, variance: bool = False) -> Path:
    """Write a confocal capture with 3 x 5 points and 7 bins."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, COLUMNS), np.linspace(-0.6, 0.6, ROWS))
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    header = CaptureHeader(
        scan_type="confocal",
        sensor_positions=points,
        sensor_normals=normals,
        laser_positions=points,
        laser_normals=normals,
        sensor_position=np.array([0.0, 0.0, 1.0]),
        laser_position=np.array([0.0, 0.0, 1.0]),
        sensor_grid_size=(2.0, 1.6),
        laser_grid_size=(2.0, 1.6),
        n_bins=BINS,
        bin_width_opl=bin_width,
        start_opl=0.0,
        n_channels=1,
        bounce_indices=(0, 1),
        max_bounces=3,
        split_bounces=True,
        account_first_and_last_bounces=False,
        hidden_bounds=None,
        pose=Pose.identity(),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    block = np.random.default_rng(0).random((1, 2, 1, 1, ROWS, COLUMNS, BINS)) * factor
    return write_capture(path, header, block, (0.1 * block) ** 2 if variance else None)


@pytest.fixture
def captures(tmp_path: Path) -> tuple[Path, Path]:
    """A capture and a reference; the capture is 1 % brighter."""
    return write(tmp_path / "new.hdf5", 1.01), write(tmp_path / "old.hdf5")


def test_within_and_beyond_the_tolerance(captures: tuple[Path, Path]) -> None:
    """Exit code 0 within, 4 beyond with one line on stderr per tolerance; the table comes either way."""
    done = run("compare", *captures, "--max-rel-l2", "0.02")
    assert done.returncode == EXIT_OK, done.stderr
    assert "relative L2  0.01" in done.stdout
    assert "agrees" in done.stdout
    assert done.stderr == ""
    done = run("compare", *captures, "--max-rel-l2", "0.005", "--max-energy", "0.02")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    assert "DIFFERS" in done.stdout
    assert done.stderr == f"error: {captures[0]}: relative L2: 0.01, tolerance 0.005\n"


def test_without_a_tolerance(captures: tuple[Path, Path]) -> None:
    """No tolerance means equal: a copy passes, anything else does not."""
    assert run("compare", captures[1], captures[1]).returncode == EXIT_OK
    assert run("compare", *captures).returncode == EXIT_COMPARISON_EXCEEDED


def test_json(captures: tuple[Path, Path]) -> None:
    """--json prints one object with everything the table has, also when the comparison fails."""
    done = run("compare", *captures, "--json", "--max-shift", "0.1", "--max-energy", "0.001")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    report = json.loads(done.stdout)
    assert report["agrees"] is False
    assert report["relative_l2"] == pytest.approx(0.01, rel=1e-4)  # float32 samples, rounded after the product
    assert report["shift_bins"] == 0
    assert [finding["exceeds"] for finding in report["tolerances"]] == [True, True, True, False, False]
    assert set(report["worst"]) == {"laser", "sensor", "bounce", "bin"}


def test_structure(tmp_path: Path) -> None:
    """Captures that cannot be compared differ: exit code 4, and what differs with both values."""
    paths = write(tmp_path / "a.hdf5"), write(tmp_path / "b.hdf5", bin_width=0.004)
    done = run("compare", *paths, "--max-rel-l2", "100")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    assert "not comparable" in done.stdout
    assert "bin width: 0.003 m, the reference has 0.004 m" in done.stderr


@pytest.mark.parametrize("order", [1, -1])
def test_a_file_that_is_no_capture(captures: tuple[Path, Path], order: int) -> None:
    """Exit code 3, whichever of the two it is: that is no difference between captures."""
    bad = captures[0].with_name("bad.hdf5")
    bad.write_text("no capture")
    done = run("compare", *(bad, captures[0])[::order])
    assert (done.returncode, done.stdout) == (EXIT_BAD_INPUT, "")
    assert done.stderr.startswith(f"error: {bad}: is not an HDF5 file")


def test_z_test(tmp_path: Path) -> None:
    """--z-test passes what 10 % of noise explains and fails what it does not; without a variance it says what to do."""
    reference = write(tmp_path / "old.hdf5", variance=True)
    assert run("compare", write(tmp_path / "a.hdf5", 1.01), reference, "--z-test").returncode == EXIT_OK
    done = run("compare", write(tmp_path / "b.hdf5", 2.0), reference, "--z-test")
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    assert "least likely" in done.stdout
    bare = write(tmp_path / "c.hdf5")
    done = run("compare", bare, bare, "--z-test")
    assert done.returncode == EXIT_BAD_INPUT
    assert "output.variance: true" in done.stderr


@pytest.mark.parametrize(
    "options", [["--max-rel-l2", "-1"], ["--max-shift", "nan"], ["--significance", "1.5"], ["--max-energy", "x"]]
)
def test_tolerances_that_are_none(captures: tuple[Path, Path], options: list[str]) -> None:
    """A tolerance that is no number >= 0, a significance outside 0 to 1: a usage error."""
    result = CliRunner().invoke(app, ["compare", *map(str, captures), *options])
    assert result.exit_code == EXIT_USAGE


def test_check_a_dataset(tmp_path: Path) -> None:
    """One line per capture, a summary, exit code 4 for differing and missing ones; extra ones are named."""
    for name, factor in (("same", 1.0), ("brighter", 1.0), ("gone", 1.0)):
        write(tmp_path / "ref" / f"{name}.hdf5", factor)
    write(tmp_path / "out" / "same.hdf5")
    write(tmp_path / "out" / "brighter.hdf5", 1.2)
    write(tmp_path / "out" / "more.hdf5")
    arguments = ("check", tmp_path / "out", "--reference", tmp_path / "ref", "--max-rel-l2", "0.1")
    done = run(*arguments)
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    lines = done.stdout.splitlines()
    assert [line.split()[:2] for line in lines[:4]] == [
        ["exceeds", "brighter.hdf5:"],
        ["missing", "gone.hdf5:"],
        ["ok", "same.hdf5:"],
        ["extra", "more.hdf5:"],
    ]
    assert lines[4] == f"1 of 3 captures agree with {tmp_path / 'ref'}"
    assert "brighter.hdf5: relative L2: 0.2, tolerance 0.1" in done.stderr
    report = json.loads(run(*arguments, "--json").stdout)
    assert {file["name"]: file["status"] for file in report["files"]} == {
        "brighter.hdf5": "exceeds",
        "gone.hdf5": "missing",
        "same.hdf5": "ok",
    }
    assert (report["extra"], report["agrees"]) == (["more.hdf5"], False)


def test_check_that_passes_and_check_that_cannot(tmp_path: Path) -> None:
    """Exit code 0 when every capture agrees; 3 when one cannot be read, after the others have been checked."""
    for folder in ("ref", "out"):
        write(tmp_path / folder / "b.hdf5")
    arguments = ("check", tmp_path / "out", "--reference", tmp_path / "ref")
    assert run(*arguments).returncode == EXIT_OK
    (tmp_path / "ref" / "a.hdf5").write_text("no capture")
    (tmp_path / "out" / "a.hdf5").write_text("no capture")
    done = run(*arguments)
    assert done.returncode == EXIT_BAD_INPUT
    assert "ok          b.hdf5" in done.stdout


@pytest.mark.parametrize("command", ["compare", "check"])
def test_help(command: str) -> None:
    """Help tells the exit codes and ends with an example and what it creates."""
    text = " ".join(CliRunner().invoke(app, [command, "--help"]).stdout.split())
    assert "4: beyond one" in text
    assert f"Example: nlosrender {command} " in text
    assert "(creates nothing;" in text or "and creates check.html)" in text


def test_comparing_needs_no_renderer(captures: tuple[Path, Path]) -> None:
    """Neither Mitsuba nor Dr.Jit is imported, nor anything heavy that a comparison has no use for."""
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom nlosrender.cli.app import app\n"
        f"arguments = ['compare', {str(captures[0])!r}, {str(captures[1])!r}, '--max-rel-l2', '1']\n"
        "result = CliRunner().invoke(app, arguments)\nassert result.exit_code == 0, result.output\n"
        "loaded = {'mitsuba', 'drjit', 'matplotlib', 'scipy'} & set(sys.modules)\nassert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
