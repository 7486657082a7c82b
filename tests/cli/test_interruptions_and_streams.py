"""Ctrl-C in the middle of a command, and streams that nobody reads or that cannot be written."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from point_captures import cells, points_header, write_points

from nlosrender import pipeline
from nlosrender.cli.progress import progress_bar
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_OK, FileError
from nlosrender.files.exports import export_capture
from nlosrender.files.filled_folder import filled_folder

MAIN = "import sys; from nlosrender.cli.app import app, main; sys.argv = ['nlosrender', *sys.argv[1:]]\n"


def run_process(code: str, *arguments: object, **streams: object) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process of its own."""
    command = [sys.executable, "-c", MAIN + code, *map(str, arguments)]
    captured = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | streams
    return subprocess.run(command, timeout=60, check=False, **captured)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ("pass", (EXIT_INTERRUPTED, "interrupted\n")),
        ("raise ImportError('cut off')", (EXIT_INTERRUPTED, "interrupted\n")),
        ("raise BackendError('Mitsuba cannot start')", (EXIT_INTERRUPTED, "interrupted\n")),
        ("raise InterruptedRender('saved')", (EXIT_INTERRUPTED, "error: saved\n")),
        ("raise IncompleteRender('half is saved')", (5, "error: half is saved\n")),
    ],
)
def test_an_interrupted_command_says_so(after: str, expected: tuple[int, str]) -> None:
    """Exit code 130 and one word, also where the interruption turned into another error; what a render says stays."""
    code = (
        "import signal\nfrom nlosrender.errors import *\n"
        "@app.command()\n"
        "def slow():\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "    except KeyboardInterrupt as error:\n"
        f"        {after if after != 'pass' else 'raise'}\n"
        "main()\n"
    )
    done = run_process(code, "slow")
    assert (done.returncode, done.stderr, done.stdout) == (*expected, "")


def test_the_renderer_starts_in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C waits for Mitsuba's import, which it would leave in ruins, for plan as for render."""
    from rendering import configured, flat_wall

    finished = []

    def start(*arguments: object, **options: object) -> None:
        signal.raise_signal(signal.SIGINT)
        finished.append(True)

    monkeypatch.setattr(pipeline, "start_backend", start)
    with pytest.raises(KeyboardInterrupt):
        pipeline.forecast_capture(configured(flat_wall()))
    assert finished == [True]


def test_an_interrupted_export_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C waits for HDF5 to write a piece; then the file goes."""
    capture = write_points(tmp_path / "wall.hdf5", points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, 0.8)])
    write, finished = h5py.Dataset.__setitem__, []

    def interrupted_write(dataset: h5py.Dataset, where: object, values: object) -> None:
        if dataset.name == "/H":
            signal.raise_signal(signal.SIGINT)
        write(dataset, where, values)
        finished.append(dataset.name)

    monkeypatch.setattr(h5py.Dataset, "__setitem__", interrupted_write)
    with pytest.raises(KeyboardInterrupt):
        export_capture(capture, tmp_path / "out.hdf5", "tal")
    assert finished == ["/H"]
    assert [path.name for path in tmp_path.iterdir()] == ["wall.hdf5"]


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_a_folder_is_filled_or_left_alone(tmp_path: Path, exists: bool, error: type[BaseException]) -> None:
    """What a block wrote before it failed is not seen, nor a folder made for it."""
    folder = tmp_path / "out"
    if exists:
        folder.mkdir()
        (folder / "a").write_text("old")

    def fill(fail: bool) -> None:
        with filled_folder(folder) as inside:
            (inside / "a").write_text("new")
            if fail:
                raise error

    with pytest.raises(error):
        fill(fail=True)
    assert [path.read_text() for path in tmp_path.rglob("a")] == (["old"] if exists else [])
    assert folder.exists() == exists
    fill(fail=False)
    assert [(path.name, path.read_text()) for path in folder.iterdir()] == [("a", "new")]


def test_a_full_disk_below_a_folder_is_explained(tmp_path: Path) -> None:
    """As for single files."""
    with pytest.raises(FileError, match=r"out: cannot be written: No space left on device\. Free some space"):
        fail_with(OSError(28, "No space left on device"), tmp_path / "out")


def fail_with(error: OSError, folder: Path) -> None:
    with filled_folder(folder):
        raise error


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize(("arguments", "on_stdout", "on_stderr"), [
    (("schema",), EXIT_FAILURE, EXIT_OK), (("info", "no.hdf5"), EXIT_BAD_INPUT, EXIT_BAD_INPUT),
])  # fmt: skip
def test_a_stream_that_is_full(arguments: tuple[str, ...], on_stdout: int, on_stderr: int) -> None:
    """Results that cannot be written are an explained failure; messages that cannot leave the exit code as it is."""
    with Path("/dev/full").open("w") as full:
        done = run_process("main()", *arguments, stdout=full)
        assert (done.returncode, done.stderr.count("error: "), "Traceback" in done.stderr) == (on_stdout, 1, False)
        assert run_process("main()", *arguments, stderr=full).returncode == on_stderr


def test_a_pipe_that_is_closed_is_no_error_to_talk_about() -> None:
    """``nlosrender schema | head -1``: no traceback."""
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN + "main()", "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.close()
    _, stderr = process.communicate(timeout=60)
    assert stderr == b""


class Terminal(io.StringIO):
    """Text that says it is shown on a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "term", "shown"), [(Terminal, "xterm", True), (Terminal, "dumb", False), (io.StringIO, "xterm", False)]
)
def test_a_bar_is_for_terminals_that_can_redraw_a_line(
    monkeypatch: pytest.MonkeyPatch, stream: Callable[[], io.StringIO], term: str, shown: bool
) -> None:
    """Logs and plain terminals get the warnings alone."""
    printed = stream()
    monkeypatch.setenv("TERM", term)
    monkeypatch.setattr(sys, "stderr", printed)
    with progress_bar("render", hidden=False) as (progress, warn):
        progress(0.5)
        warn("look out")
    assert ("render" in printed.getvalue(), "\r" in printed.getvalue()) == (shown, shown)
    assert "warning: look out\n" in printed.getvalue()
