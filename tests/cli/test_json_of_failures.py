"""``--json`` prints one object whatever comes of a command: with exit code, messages and places where it fails."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import pytest
from support.point_captures import cells, points_header, write_points

from nlosrender.cli import app
from nlosrender.cli.json_output import OUTPUT, issue_as_json
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_COMPARISON_EXCEEDED, EXIT_FAILURE, EXIT_USAGE, ValidationIssue

SCENE = """\
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry: [{type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9]}]
capture: {scan_type: single, sensor_grid: {nx: 4, ny: 3}}
time_axis: {bin_width_opl: 0.05, n_bins: 130}
render:
  spp: 16
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a configuration and two captures."""
    (tmp_path / "z.yaml").write_text(SCENE)
    (tmp_path / "broken.yaml").write_text(SCENE.replace("spp: 16", "spp: 0") + "  seed: -1\n")
    (tmp_path / "small.yaml").write_text(SCENE + "  memory_limit: 1MB\n")
    failing = "  memory_limit: 500MB\nsweep: {keys: {render.memory_limit: [1MB, 2MB]}}\n"
    (tmp_path / "sweep.yaml").write_text(SCENE + failing)
    for name, distance in (("a.hdf5", 0.8), ("b.hdf5", 0.9)):
        write_points(tmp_path / name, points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, distance)])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def failure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, Any]:
    """Run a command that fails as the shell does, and return its one object."""
    monkeypatch.setattr(sys, "argv", ["nlosrender", *command])
    monkeypatch.setattr(OUTPUT, "printed", False)
    monkeypatch.setattr(app, "InterruptWatch", io.StringIO)  # a context that leaves the signals of the tests alone
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        app.main()
    found = json.loads(capsys.readouterr().out)
    assert found["exit_code"] == ended.value.code
    assert isinstance(found, dict)
    return found


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("command", ["render", "plan"])
def test_mistakes_in_a_configuration_have_places(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """File, line, column and key of every mistake; an override has itself as its place."""
    found = failure(monkeypatch, capsys, command, "broken.yaml", "--json", "--set", "time_axis.n_bins=0")
    assert found["exit_code"] == EXIT_BAD_INPUT
    places = [[problem[key] for key in ("file", "line", "column", "key")] for problem in found["problems"]]
    assert places == [
        ["broken.yaml", 7, 8, "render.spp"],
        ["broken.yaml", 8, 9, "render.seed"],
        [None, None, None, "time_axis.n_bins"],
    ]
    assert found["problems"][2]["place"] == "--set time_axis.n_bins=0"
    assert all(problem["message"] in text for problem, text in zip(found["problems"], found["messages"], strict=True))


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("command", ["render", "plan"])
def test_a_memory_limit_below_the_program_is_a_mistake_with_its_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    """Only the engine knows what the program takes; it is a line of the file all the same."""
    (problem,) = failure(monkeypatch, capsys, command, "small.yaml", "--json")["problems"]
    assert (problem["file"], problem["line"], problem["key"]) == ("small.yaml", 8, "render.memory_limit")
    assert "need more than" in problem["message"]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("command", "code", "key", "part"),
    [
        (("render", "none.yaml"), EXIT_BAD_INPUT, "messages", "there is no such file"),
        (("render", "z.yaml", "--lasers", "x"), EXIT_USAGE, "messages", "need A:B with A < B"),
        (("plan",), EXIT_USAGE, "messages", "CONFIG"),
        (("info", "z.yaml"), EXIT_BAD_INPUT, "messages", "is not an HDF5 file"),
        (("merge", "a.hdf5", "-o", "out.hdf5"), EXIT_BAD_INPUT, "messages", "a.hdf5"),
        (("reconstruct", "a.hdf5", "--voxels", "0"), EXIT_USAGE, "messages", "voxels"),
        (("export", "a.hdf5", "--format", "nope"), EXIT_USAGE, "messages", "nope"),
        # these have found something, and say it in the same object
        (("validate", "broken.yaml"), EXIT_BAD_INPUT, "problems", "render.spp"),
        (("compare", "a.hdf5", "b.hdf5"), EXIT_COMPARISON_EXCEEDED, "failures", ""),
        (("render", "sweep.yaml", "-o", "out/{index}.hdf5"), EXIT_FAILURE, "failed", "need more than 400 MB"),
    ],
)
def test_every_command_prints_one_object(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: tuple[str, ...],
    code: int,
    key: str,
    part: str,
) -> None:
    """One object with the exit code, and what is wrong in it."""
    found = failure(monkeypatch, capsys, *command, "--json")
    assert found["exit_code"] == code
    assert part in json.dumps(found[key])


@pytest.mark.usefixtures("folder")
def test_without_json_nothing_is_printed_on_stdout(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Messages belong on stderr; an argument after -- is no option."""
    monkeypatch.setattr(sys, "argv", ["nlosrender", "validate", "--", "broken.yaml", "--json"])
    monkeypatch.setattr(app, "InterruptWatch", io.StringIO)
    with pytest.raises(SystemExit):
        app.main()
    assert capsys.readouterr().out == ""


def test_a_place_is_told_in_parts_whatever_the_file_is_called() -> None:
    """Colons and line breaks in a name are the name's."""
    found = issue_as_json(ValidationIssue(("x",), "wrong.", place="a:1:2\n.yaml:14:3"))
    assert (found["file"], found["line"], found["column"]) == ("a:1:2\n.yaml", 14, 3)


def test_numbers_that_json_does_not_know_are_null(capsys: pytest.CaptureFixture[str]) -> None:
    """An estimate that knows nothing is null, wherever it stands: NaN would be refused by most readers."""
    OUTPUT.print({"a": float("nan"), "b": [float("inf"), 1.0], "c": {"d": (float("-inf"),)}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.0], "c": {"d": [None]}}


def test_commands_print_json_in_one_place() -> None:
    """Printed by hand the object would be followed by a second one when the command fails; a schema is no report."""
    folder = Path(app.__file__).parent
    by_hand = [path.name for path in folder.glob("*.py") if "typer.echo(json.dumps(" in path.read_text()]
    assert set(by_hand) <= {"json_output.py", "config_commands.py"}
