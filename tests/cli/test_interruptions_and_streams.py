"""Ctrl-C in the middle of a command, and streams that nobody reads or that cannot be written."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import h5py
import numpy as np
import pytest
from support.partial_captures import write_part
from support.point_captures import cells, point_light, points_header, write_points

from nlosrender.capture.part import Selection
from nlosrender.cli.progress import reporting
from nlosrender.engine.backend import start as backend
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_FAILURE, EXIT_INTERRUPTED, EXIT_OK, FileError
from nlosrender.files.atomic_write import filled_folder
from nlosrender.files.export.export import export_capture

PNG_START = b"\x89PNG\r\n\x1a\n"
MAIN = "import sys; from nlosrender.cli.app import app, main; sys.argv = ['nlosrender', *sys.argv[1:]]\n"


def run_process(code: str, *arguments: object, **streams: object) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process of its own."""
    command = [sys.executable, "-c", MAIN + code, *map(str, arguments)]
    captured = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | streams
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}  # as users have it
    return subprocess.run(command, timeout=60, check=False, env=environment, **captured)  # type: ignore[call-overload]


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


def test_a_command_is_interrupted_while_it_is_imported() -> None:
    """Ctrl-C in the first fifth of a second: exit code 130 and one word, no traceback out of an import."""
    code = (
        "import signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'typer':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "from nlosrender.__main__ import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], timeout=60, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, "interrupted\n")


def test_a_command_is_interrupted_while_python_ends() -> None:
    """Its work is done: the process ends by the signal, without a word."""
    code = "import atexit, signal\natexit.register(signal.raise_signal, signal.SIGINT)\nmain()\n"
    done = run_process(code, "--version")
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


class CutOffMitsuba(ModuleType):
    """A Mitsuba during whose start Ctrl-C is pressed."""

    LogLevel = SimpleNamespace(Error=0)
    started = False

    def set_variant(self, variant: str) -> None:
        signal.raise_signal(signal.SIGINT)

    def set_log_level(self, level: int) -> None:
        self.started = True


def test_the_renderer_starts_in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C waits for Mitsuba's import, which it would leave in ruins, whichever command starts it."""
    mitsuba = CutOffMitsuba("mitsuba")
    monkeypatch.setitem(sys.modules, "mitsuba", mitsuba)
    monkeypatch.setattr(backend, "_load_llvm", lambda: "none")
    with pytest.raises(KeyboardInterrupt):
        backend.start_backend("llvm")
    assert mitsuba.started


@pytest.mark.parametrize(
    "command", [pytest.param(("paper", "--figure", "table1", "--quick"), marks=pytest.mark.slow), ("doctor",)]
)
def test_a_command_is_interrupted_while_mitsuba_is_imported(tmp_path: Path, command: tuple[str, ...]) -> None:
    """Exit code 130 and one word, at the moment that hurts most: Mitsuba is half there."""
    (tmp_path / "configs").symlink_to(Path(__file__).parents[2] / "configs")
    # Mitsuba looks for Dr.Jit first, in code of its own that a KeyboardInterrupt cuts off
    code = (
        "import signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'drjit':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "            print('mitsuba is being imported', flush=True)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "main()\n"
    )
    done = run_process(code, *command, cwd=tmp_path)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (EXIT_INTERRUPTED, "interrupted"), done.stderr
    assert done.stdout == "mitsuba is being imported\n"


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


STOPPED = {  # commands, and a function each that is called while their output is half-written
    ("frames", "view.hdf5"): "analysis.frames.save_exr",
    ("frames", "view.hdf5", "-o", "view.gif"): "files.atomic_write.publish",
    ("plot", "wall.hdf5"): "files.atomic_write.publish",
    ("export", "wall.hdf5", "--format", "tal"): "files.export.tal_format._write_enum",
    ("export", "wall.hdf5", "--format", "fk"): "files.atomic_write.publish",
    ("reconstruct", "wall.hdf5", "--voxels", "8"): "analysis.reconstruction.volume_file.set_attributes",
    ("merge", "part1.hdf5", "part2.hdf5", "-o", "merged.hdf5"): "files.parts.merge._copy",
}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with captures of a wall and of a camera, and the two halves of one."""
    folder = tmp_path_factory.mktemp("captures")
    sensors, points = cells(5, 3, 1.0, 0.8), [(0, 0, 0.8)]
    write_points(folder / "wall.hdf5", points_header("confocal", sensors), points)
    view = points_header("line_of_sight", sensors, np.zeros((1, 1, 3)), bins=(0.0, 0.02, 200))
    write_points(folder / "view.hdf5", view, points)
    header = points_header("exhaustive", sensors)
    light = point_light(header, points)
    for number in (1, 2):
        half = Selection(shard=(number, 2))
        write_part(folder / f"part{number}.hdf5", header, np.stack([light, light])[None], half)
    return folder


@pytest.mark.parametrize(
    ("arguments", "number"),
    [
        *(
            pytest.param(arguments, "SIGTERM", marks=[] if arguments[0] in ("frames", "merge") else pytest.mark.slow)
            for arguments in STOPPED
        ),
        (("export", "wall.hdf5", "--format", "fk"), "SIGHUP"),
    ],
)
def test_a_batch_systems_notice_leaves_nothing_half_written(
    captures: Path, arguments: tuple[str, ...], number: str
) -> None:
    """SIGTERM, or the end of the terminal, ends every command that writes as Ctrl-C does: one word, no file."""
    before = sorted(captures.rglob("*"))
    done = run_process(_raising(arguments, number, "SIG_DFL"), *arguments, cwd=captures)
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, "interrupted\n")
    assert ".partial" in done.stdout
    assert sorted(captures.rglob("*")) == before


def test_a_command_that_shall_outlive_its_terminal_does(captures: Path, tmp_path: Path) -> None:
    """``nohup`` has SIGHUP ignored: the command goes on."""
    arguments = ("export", "wall.hdf5", "--format", "fk")
    code, written = _raising(arguments, "SIGHUP", "SIG_IGN"), tmp_path / "wall.mat"
    done = run_process(code, *arguments, "-o", str(written), cwd=captures)
    assert done.returncode == 0
    assert written.stat().st_size > 0


def _raising(arguments: tuple[str, ...], number: str, handler: str) -> str:
    """Return code that runs a command and sends it a signal while it writes; ``handler`` is what its parent left it."""
    module, _, name = f"nlosrender.{STOPPED[arguments]}".rpartition(".")
    return (
        f"import signal, {module} as module\n"
        "from pathlib import Path\n"
        f"signal.signal(signal.{number}, signal.{handler})\n"
        f"call = module.{name}\n"
        "def stopped(*arguments):\n"
        "    print(*(path for path in Path().rglob('*') if path.name.endswith('.partial')), flush=True)\n"
        f"    signal.raise_signal(signal.{number})\n"
        "    return call(*arguments)\n"
        f"module.{name} = stopped\n"
        "main()\n"
    )


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_a_folder_is_filled_or_left_alone(tmp_path: Path, exists: bool, error: type[BaseException]) -> None:
    """What a block wrote before it failed is not seen, nor a folder made for it."""
    folder = tmp_path / "out"
    if exists:
        folder.mkdir()
        (folder / "a.png").write_bytes(PNG_START + b"old")

    def fill(fail: bool) -> None:
        with filled_folder(folder) as inside:
            (inside / "a.png").write_bytes(PNG_START + b"new")
            if fail:
                raise error

    with pytest.raises(error):
        fill(fail=True)
    assert [path.read_bytes()[-3:] for path in tmp_path.rglob("a.png")] == ([b"old"] if exists else [])
    assert folder.exists() == exists
    fill(fail=False)
    assert [(path.name, path.read_bytes()[-3:]) for path in folder.iterdir()] == [("a.png", b"new")]


def test_a_full_disk_below_a_folder_is_explained(tmp_path: Path) -> None:
    """As for single files."""
    with pytest.raises(FileError, match=r"out: cannot be written: No space left on device\. Free some space"):
        fail_with(OSError(28, "No space left on device"), tmp_path / "out")


def fail_with(error: OSError, folder: Path) -> None:
    with filled_folder(folder):
        raise error


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize(
    ("arguments", "on_stdout", "on_stderr"),
    [
        (("schema",), EXIT_FAILURE, EXIT_OK),
        pytest.param(("info", "no.hdf5"), EXIT_BAD_INPUT, EXIT_BAD_INPUT, marks=pytest.mark.slow),
    ],
)
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
    with reporting("render", False) as (progress, warn, _):
        progress(0.5)
        warn("look out")
    assert ("render" in printed.getvalue(), "\r" in printed.getvalue()) == (shown, shown)
    assert "warning: look out\n" in printed.getvalue()
