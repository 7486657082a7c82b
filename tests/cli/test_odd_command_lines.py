"""What shells and schedulers do to a program, and what tired users type: explained, and nothing of theirs is lost."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import yaml
from support.commands import run
from support.partial_captures import validate_file
from support.point_captures import cells, points_header, write_points
from support.rendering import flat_wall

from nlosrender.cli.app import app
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_ENVIRONMENT, EXIT_OK, EXIT_USAGE

TRIANGLE = "v -0.2 0.1 1.1\nv 0.2 0.1 1.1\nv 0 0.4 1.2\nf 1 3 2\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a configuration, its mesh and a capture."""
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    scene = flat_wall({"type": "mesh", "filename": "triangle.obj"}, spp=8)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    write_points(tmp_path / "wall.hdf5", points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, 0.8)])
    return tmp_path


def run_process(folder: Path, before: Callable[[], None], *arguments: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command in a process of its own, in which ``before`` is called first."""
    command = [sys.executable, "-m", "nlosrender", *arguments]
    return subprocess.run(command, cwd=folder, preexec_fn=before, timeout=60, check=False, capture_output=True)


@pytest.mark.parametrize("output", ["scene.yaml", "./scene.yaml", "triangle.obj", "link"])
def test_a_render_does_not_replace_what_it_reads(folder: Path, output: str) -> None:
    """Neither the configuration nor a mesh, by whatever name."""
    (folder / "link").symlink_to("triangle.obj")
    before = (folder / output).read_bytes()
    done = run(folder, "render", "scene.yaml", "-o", output)
    assert (done.returncode, "is read for this and would be replaced" in done.stderr) == (EXIT_BAD_INPUT, True)
    assert (folder / output).read_bytes() == before


def test_a_file_that_may_not_be_read_is_a_bad_file() -> None:
    """Not a usage error, as the parser would have it: every path is left to the command."""
    checked = {
        (command.callback.__name__, name): hint.__metadata__[0].readable
        for command in app.registered_commands
        for name, hint in get_type_hints(command.callback, include_extras=True).items()
        if name != "return" and Path in (hint.__origin__, *get_args(hint.__origin__))
    }
    assert len(checked) > 20
    assert not any(checked.values()), checked


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
def test_files_that_may_not_be_read(folder: Path) -> None:
    """Captures, configurations, and what lies in a folder that is closed: exit code 3."""
    for name in ("scene.yaml", "wall.hdf5"):
        (folder / name).chmod(0)
    (folder / "closed").mkdir(mode=0)
    for command in (("info", "wall.hdf5"), ("validate", "scene.yaml"), ("info", "closed/a.hdf5")):
        done = run(folder, *command)
        assert (done.returncode, "read" in done.stderr) == (EXIT_BAD_INPUT, True), done.stderr


@pytest.mark.parametrize("output", [".", "..", "", "/"])
def test_a_folder_is_no_capture(folder: Path, output: str) -> None:
    """The message is about what was typed, not about the key it stands for."""
    done = run(folder, "render", "scene.yaml", "-o", output)
    assert done.returncode == EXIT_BAD_INPUT
    assert "is a folder. Name a file in it" in done.stderr
    assert "--set" not in done.stderr


@pytest.mark.parametrize("command", ["validate", "render", "plan"])
def test_a_config_from_a_pipe(folder: Path, command: str) -> None:
    """``render <(...)``: what can be read once is read once, and its capture gets a plain name."""
    os.mkfifo(folder / "pipe")
    text = (folder / "scene.yaml").read_text()
    writer = threading.Thread(target=(folder / "pipe").write_text, args=(text,), daemon=True)
    writer.start()
    done = run(folder, command, "pipe")
    assert done.returncode == EXIT_OK, done.stderr


def test_a_render_without_standard_streams(folder: Path) -> None:
    """As daemons start programs: no file of ours becomes standard output, and nobody has to listen."""
    done = run_process(folder, lambda: os.closerange(0, 3), "render", "scene.yaml", "-o", "a.hdf5")
    assert done.returncode == EXIT_OK
    assert validate_file(folder / "a.hdf5") == []


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(("plan", "{}/scene.yaml"), marks=pytest.mark.slow),
        ("render", "{}/scene.yaml", "-o", "{}/a.hdf5"),
    ],
)
def test_a_current_folder_that_is_gone(folder: Path, command: tuple[str, ...]) -> None:
    """Mitsuba's import would end the process; the environment is what is to be mended."""
    (folder / "gone").mkdir()
    arguments = [part.format(folder) for part in command]
    done = run_process(folder / "gone", lambda: os.rmdir(folder / "gone"), *arguments)
    assert done.returncode == EXIT_ENVIRONMENT, done.stderr
    assert b"the current folder is gone" in done.stderr
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize("arguments", [("--volume-center", "1e300,0,1"), ("--volume-size", "1e300"),
                                       ("--volume-size", "nan")], ids=" ".join)  # fmt: skip
def test_lengths_of_a_volume_are_those_of_a_scene(folder: Path, arguments: tuple[str, str]) -> None:
    """Beyond them float64 makes no numbers of distances."""
    done = run(folder, "reconstruct", "wall.hdf5", *arguments)
    assert (done.returncode, f"{arguments[0]}: got" in done.stderr) == (EXIT_USAGE, True), done.stderr
    assert "at most 1e+09 [m]" in done.stderr


def test_a_tolerance_without_end(folder: Path) -> None:
    """``inf`` allows everything, and is printed as what it is."""
    done = run(folder, "compare", "wall.hdf5", "wall.hdf5", "--max-rel-l2", "inf")
    assert (done.returncode, "tolerance infinite" in done.stdout) == (EXIT_OK, True)


def test_advice_can_be_pasted(folder: Path) -> None:
    """A name with a space is quoted."""
    assert "nlosrender validate 'a b.yaml' checks it" in run(folder, "new", "a b.yaml").stdout
