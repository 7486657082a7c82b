"""``info`` and ``plot`` as a user meets them: output, exit codes, messages."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.commands import run
from support.partial_captures import write_capture
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_USAGE, FileError, OptionError
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.scene.pose import Pose

RUN = "import sys; from nlosrender.cli.app import main; sys.argv[0] = 'nlosrender'; main()"


def run_process(*arguments: object) -> subprocess.CompletedProcess:
    """Run the command line in a process of its own, where errors become messages and exit codes."""
    command = [sys.executable, "-c", RUN, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A single capture with 4 x 5 sensors and 7 bins."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 5), np.linspace(-0.6, 0.6, 4))
    sensors = np.stack([x, y, np.zeros_like(x)], axis=-1)
    header = CaptureHeader(
        scan_type="single",
        sensor_positions=sensors,
        sensor_normals=np.broadcast_to([0.0, 0.0, 1.0], sensors.shape),
        laser_positions=np.zeros((1, 1, 3)),
        laser_normals=np.array([[[0.0, 0.0, 1.0]]]),
        sensor_position=np.array([0.0, 0.0, 1.0]),
        laser_position=np.array([0.0, 0.0, 1.0]),
        sensor_grid_size=(2.0, 1.6),
        laser_grid_size=(0.0, 0.0),
        n_bins=7,
        bin_width_opl=0.003,
        start_opl=0.0,
        n_channels=1,
        bounce_indices=(0, 1),
        max_bounces=3,
        split_bounces=True,
        account_first_and_last_bounces=False,
        hidden_bounds=None,
        pose=Pose.identity(),
    )
    path = tmp_path / "two planes.hdf5"
    block = np.random.default_rng(0).random((1, 2, 1, 1, 4, 5, 7))
    return write_capture(path, header, block, attributes={"error_estimate": 0.0123, "note": "x"})


def test_info_table(capture: Path) -> None:
    """The table names grids, time axis, bounces, missing legs and the error estimate."""
    result = CliRunner().invoke(app, ["info", str(capture)])
    assert result.exit_code == 0
    for text in (
        "scan type            single",
        "sensor points        5 x 4 over 2 x 1.6 m",
        "7 bins of 0.003 m (10.0069 ps)",
        "NOT included in time",
        "2, 3 (highest rendered: 3)",
        "1.23 % (relative L2)",
    ):
        assert text in result.stdout


def test_info_json(capture: Path) -> None:
    """--json prints one object, with the violations when the layout is checked."""
    result = CliRunner().invoke(app, ["info", str(capture), "--json"])
    summary = json.loads(result.stdout)
    assert summary["sensor_grid"] == [5, 4]
    assert "violations" not in summary
    result = CliRunner().invoke(app, ["info", str(capture), "--json", "--check"])
    assert json.loads(result.stdout)["violations"] == []
    assert result.exit_code == 0


def test_check_of_a_flawless_file(capture: Path) -> None:
    """--check says that everything was looked at."""
    result = CliRunner().invoke(app, ["info", str(capture), "--check"])
    assert "matches the Z-NLOS layout, all samples finite" in result.stdout


def test_check_of_a_broken_file(capture: Path) -> None:
    """Violations end with exit code 3 and one line each on stderr; the table still comes on stdout."""
    with h5py.File(capture, "r+") as file:
        file["data"][0, 2, 1, 3, 4] = np.nan
        del file["t"]
    process = run(capture.parent, "info", capture, "--check")
    assert process.returncode == EXIT_BAD_INPUT
    assert "scan type" in process.stdout
    assert "FAILED" in process.stdout
    assert f"{capture}: t: missing\n" in process.stderr
    assert f"{capture}: data: nan at index (0, 2, 1, 3, 4, 0, 0)\n" in process.stderr
    process = run(capture.parent, "info", capture, "--check", "--json")
    assert process.returncode == EXIT_BAD_INPUT
    assert len(json.loads(process.stdout)["violations"]) == 2


def test_control_characters_do_not_reach_the_terminal(capture: Path) -> None:
    """Attributes are anybody's: escape sequences are shown, not sent; long text is cut."""
    with h5py.File(capture, "r+") as file:
        file.attrs["render_engine"] = "\x1b[2Jpath\nfake line\u202e"
        file.attrs["config_hash"] = "f" * 10_000
    result = CliRunner().invoke(app, ["info", str(capture)])
    assert "\\x1b[2Jpath\\nfake line\\u202e" in result.stdout
    assert "\x1b" not in result.stdout
    assert max(map(len, result.stdout.splitlines())) < 250


@pytest.mark.parametrize("command", ["info", "plot"])
@pytest.mark.parametrize("content", [None, b"", b"not a capture", b"\x89HDF\r\n\x1a\n"])
def test_bad_files(tmp_path: Path, command: str, content: bytes | None) -> None:
    """A bad file is a FileError that names it, for main() to report."""
    path = tmp_path / "bad.hdf5"
    if content is not None:
        path.write_bytes(content)
    result = CliRunner().invoke(app, [command, str(path)])
    assert isinstance(result.exception, FileError)
    assert str(result.exception).startswith(str(path))
    assert result.exception.exit_code == EXIT_BAD_INPUT


def test_a_bad_file_in_a_process(tmp_path: Path) -> None:
    """Exit code 3, one line on stderr, nothing on stdout."""
    process = run_process("info", tmp_path / "missing.hdf5")
    assert (process.returncode, process.stdout) == (EXIT_BAD_INPUT, "")
    assert process.stderr == f"error: {tmp_path / 'missing.hdf5'}: there is no such file\n"


def test_plot_prints_the_picture(capture: Path) -> None:
    """The picture goes where it is asked for, in the format of its name, and its path to stdout."""
    other = capture.with_name("b.svg")
    result = CliRunner().invoke(app, ["plot", str(capture), "-o", str(other), "--laser", "0,0", "--pixel", "3,4"])
    assert result.stdout == f"{other}\n"
    assert b"<svg" in other.read_bytes()


@pytest.mark.parametrize("point", ["3", "1,2,3", "a,b", "-1,0", "1.0,2", "", "²,1"])
@pytest.mark.parametrize("option", ["--laser", "--pixel"])
def test_points_that_are_not(capture: Path, option: str, point: str) -> None:
    """Anything but two counts is a usage error that shows how a point is written."""
    result = CliRunner().invoke(app, ["plot", str(capture), option, point])
    assert result.exit_code == EXIT_USAGE
    assert "such as 6,8" in result.stderr


def test_points_outside(capture: Path) -> None:
    """A point outside the grid is a usage error that names the grid's size."""
    for option, point, rows, columns in (("--pixel", "4,0", 4, 5), ("--pixel", "0,5", 4, 5), ("--laser", "1,0", 1, 1)):
        result = CliRunner().invoke(app, ["plot", str(capture), option, point])
        assert isinstance(result.exception, OptionError)
        allowed = f"need a row from 0 to {rows - 1} and a column from 0 to {columns - 1}"
        assert str(result.exception) == f"{option}: got {point}, {allowed}"


@pytest.mark.parametrize(("command", "creates"), [("info", "creates nothing"), ("plot", "creates z.png")])
def test_help_ends_with_an_example(command: str, creates: str) -> None:
    """Help shows one real command and what it creates."""
    text = " ".join(CliRunner().invoke(app, [command, "--help"]).stdout.split())
    assert f"Example: `nlosrender {command} z.hdf5" in text
    assert creates in text


def test_looking_needs_no_renderer(capture: Path) -> None:
    """Neither command imports Mitsuba or Dr.Jit, and help not even numpy; the picture goes beside the capture."""
    code = "import sys\nfrom typer.testing import CliRunner\nfrom nlosrender.cli.app import app\n"
    for arguments, forbidden in (  # one after the other in one process: each may have loaded more than the one before
        (["info", "--help"], {"mitsuba", "drjit", "numpy", "h5py", "matplotlib"}),
        (["info", str(capture), "--check"], {"mitsuba", "drjit", "matplotlib"}),
        (["plot", str(capture)], {"mitsuba", "drjit", "matplotlib.pyplot"}),
    ):
        code += (
            f"result = CliRunner().invoke(app, {arguments!r})\nassert result.exit_code == 0\n"
            f"loaded = {forbidden!r} & set(sys.modules)\nassert not loaded, loaded\n"
        )
    code += "print(result.stdout)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 0, process.stderr
    assert process.stdout.strip() == str(capture.with_suffix(".png"))
    assert capture.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
