"""Options with a fixed set of values, and folders in the place of files, in every command that takes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.point_captures import cells, points_header, write_points

from nlosrender.cli.app import app
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, EXIT_USAGE

COMMANDS = sorted(command.name or command.callback.__name__ for command in app.registered_commands)
NAMING_COMMANDS = [("frames",), ("reconstruct",), ("plot",), ("export", "--format", "fk")]  # outputs after inputs
CHOICES = [  # every option with a fixed set of values
    ("new", "--scan-type", "raster"),
    ("render", "none.yaml", "--executor", "cloud"),
    ("render", "none.yaml", "--shard", "3/2"),
    ("render", "none.yaml", "--shard", "0/2"),
    ("render", "none.yaml", "--lasers", "2:2"),
    ("export", "none.hdf5", "--format", "banana"),
    ("export", "none.hdf5", "--format", "tal", "--bounces", "4"),
    ("reconstruct", "none.hdf5", "--method", "banana"),
    ("reconstruct", "none.hdf5", "--bounces", "4"),
    ("frames", "none.hdf5", "--format", "banana"),
    ("frames", "none.hdf5", "--format", "mp4"),
    ("plot", "none.hdf5", "-o", "out.jpg"),
    ("bench", "--scene", "banana"),
    ("bench", "--part", "banana"),
    ("paper", "--figure", "banana"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with captures of a wall and of a camera."""
    write_points(tmp_path / "wall.hdf5", points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, 0.8)])
    header = points_header("line_of_sight", cells(5, 3, 1.0, 0.8), np.zeros((1, 1, 3)), bins=(0.0, 0.02, 200))
    write_points(tmp_path / "view.hdf5", header, [(0, 0, 0.8)])
    return tmp_path


@pytest.mark.parametrize("arguments", CHOICES, ids=" ".join)
def test_a_value_outside_a_fixed_set_is_a_usage_error(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    """Exit code 2 in every command, the value and the option named, whatever else is wrong; nothing is written."""
    done = run(tmp_path, *arguments)
    assert done.returncode == EXIT_USAGE, done.stderr
    assert arguments[-1] in done.stderr
    assert arguments[-2] in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("given", [".", "..", "/", "", "inner"])
@pytest.mark.parametrize("command", NAMING_COMMANDS, ids=lambda command: command[0])
def test_a_folder_in_the_place_of_a_capture_is_a_bad_file(tmp_path: Path, command: tuple[str, ...], given: str) -> None:
    """No output name can be made of ``.``; the message is about the input, and nothing is written."""
    (tmp_path / "inner").mkdir()
    done = run(tmp_path, *command, given)
    assert done.returncode == EXIT_BAD_INPUT, done.stderr
    assert "is a folder. Name the capture file in it" in done.stderr
    assert [path.name for path in tmp_path.rglob("*")] == ["inner"]


@pytest.mark.parametrize("command", NAMING_COMMANDS, ids=lambda command: command[0])
def test_a_missing_capture_is_missing_before_its_output_is_named(tmp_path: Path, command: tuple[str, ...]) -> None:
    """Also below a file in the place of a folder."""
    (tmp_path / "file").touch()
    for name in ("no.hdf5", "file/no.hdf5"):
        done = run(tmp_path, *command, name)
        assert (done.returncode, "there is no such file" in done.stderr) == (EXIT_BAD_INPUT, True), done.stderr


@pytest.mark.parametrize("given", [".", "/", "inner/.."])
def test_a_benchmark_needs_a_name_before_it_runs(tmp_path: Path, given: str) -> None:
    """``-o`` is the beginning of two file names."""
    (tmp_path / "inner").mkdir()
    done = run(tmp_path, "bench", "--scene", "plate", "--part", "process", "-o", given)
    assert done.returncode == EXIT_BAD_INPUT
    assert "is a folder. Name a file in it" in done.stderr


def test_a_benchmark_that_cannot_be_written_does_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Minutes of work are not thrown away."""
    monkeypatch.setattr("nlosrender.bench.benchmark.run_benchmark", lambda *_: pytest.fail("it ran"))
    (tmp_path / "file").touch()
    done = run(tmp_path, "bench", "--scene", "plate", "--part", "process", "-o", "file/bench")
    assert (done.returncode, "cannot be written" in done.stderr) == (EXIT_BAD_INPUT, True)


def test_outputs_of_a_reconstruction_are_checked_before_it(folder: Path) -> None:
    """A picture named as the volume, a picture in the place of a folder, the capture itself."""
    done = run(folder, "reconstruct", "wall.hdf5", "-o", "volume.png", "--png", "--voxels", 5)
    assert (done.returncode, "the name --png gives the picture" in done.stderr) == (EXIT_USAGE, True)
    (folder / "volume.png").mkdir()
    done = run(folder, "reconstruct", "wall.hdf5", "-o", "volume.hdf5", "--png", "--voxels", 5)
    assert (done.returncode, "volume.png: is a folder" in done.stderr) == (EXIT_BAD_INPUT, True)
    assert not (folder / "volume.hdf5").exists()
    done = run(folder, "reconstruct", "wall.hdf5", "-o", "wall.hdf5", "--method", "phasor", "--wavelength", 9)
    assert "is read for this and would be replaced" in done.stderr


def test_an_animation_goes_into_the_file_that_is_named(folder: Path) -> None:
    """-o fr.gif writes that file alone, with --format gif or without; case does not matter."""
    for name, *options in (("fr.gif", "--format", "gif"), ("fr.GIF",)):
        done = run(folder, "frames", "view.hdf5", "-o", name, *options)
        assert (done.returncode, done.stdout) == (EXIT_OK, f"wrote {name}\n")
        assert (folder / name).read_bytes().startswith(b"GIF89a")
    assert sorted(path.name for path in folder.iterdir()) == ["fr.GIF", "fr.gif", "view.hdf5", "wall.hdf5"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("-o", "fr.gif", "--format", "png"), "an animation, with --format png"),
        (("-o", "fr.png", "--format", "png"), "the name of one picture, but there are many"),
        (("-o", "fr.exr"), "the name of one picture, but there are many"),
        (("-o", "fr.mp4"), "the name of one picture, but there are many"),
    ],
)
def test_one_name_for_many_pictures_is_a_usage_error(folder: Path, options: tuple[str, ...], message: str) -> None:
    """A folder is not made under the name of a picture."""
    done = run(folder, "frames", "view.hdf5", *options)
    assert (done.returncode, message in done.stderr) == (EXIT_USAGE, True), done.stderr
    assert not list(folder.glob("fr*"))


@pytest.mark.parametrize(
    ("output", "message"),
    [("view.hdf5", "is a file. Name a folder"), ("pictures.gif", "is a folder"), ("no/fr.gif", "there is no folder")],
)
def test_pictures_do_not_replace_what_is_something_else(folder: Path, output: str, message: str) -> None:
    """A capture is no folder, and a folder no animation."""
    (folder / "pictures.gif").mkdir()
    done = run(folder, "frames", "view.hdf5", "-o", output)
    assert (done.returncode, message in done.stderr) == (EXIT_BAD_INPUT, True), done.stderr


def test_frames_of_an_earlier_run_do_not_stay(folder: Path) -> None:
    """Fewer frames into the same folder are all there is; other files stay."""
    run(folder, "frames", "view.hdf5", "-o", "out", "--every", 20, "--from", 0, "--to", 4)
    kept = ["frame-00001.exr.txt", "frame-00001.png", "frame-other.exr", "notes.txt"]
    for name in kept:
        (folder / "out" / name).touch()
    assert len(list((folder / "out").glob("frame-0000?.exr"))) == 10
    run(folder, "frames", "view.hdf5", "-o", "out", "--every", 60, "--from", 0, "--to", 4)
    frames = [f"frame-0000{index}.exr" for index in range(4)]
    assert sorted(path.name for path in (folder / "out").iterdir()) == sorted(
        [*frames, *kept, "steady.exr", "steady.png"]
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_the_last_paragraph_of_help_is_an_example(tmp_path: Path, command: str) -> None:
    """One real call, after all options."""
    text = " ".join(run(tmp_path, command, "--help").stdout.split())
    assert f"nlosrender {command}" in text[text.rindex("Show this message and exit.") :].partition("Example: ")[2]


def test_what_cannot_be_read_is_named_once(folder: Path) -> None:
    """The message of a bad file begins with its name already."""
    (folder / "empty.hdf5").touch()
    done = run(folder, "check", ".", "--reference", ".")
    assert (done.returncode, done.stderr.count("empty.hdf5")) == (EXIT_BAD_INPUT, 1)
