"""``new``, ``validate`` and ``schema`` as a user types them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nlosrender.api.configuration import load
from nlosrender.cli.app import app
from nlosrender.config.examples import example_names
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_USAGE, ConfigError, FileError

runner = CliRunner()


@pytest.fixture
def starter(tmp_path: Path) -> Path:
    """A starter config of an exhaustive scan."""
    path = tmp_path / "z.yaml"
    assert runner.invoke(app, ["new", str(path), "--scan-type", "exhaustive"]).exit_code == 0
    return path


def nlosrender(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nlosrender", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=60, check=False)


def test_new_writes_a_config_that_validates(starter: Path) -> None:
    """new then validate, without touching the file, is ok and says what will be captured."""
    result = runner.invoke(app, ["validate", str(starter)])
    assert result.exit_code == 0
    assert (
        f"{starter}: ok (exhaustive, 32 x 32 sensors, 4 x 3 lasers, auto bins of 0.003 m, 1 hidden item)"
        in result.stdout
    )


def test_what_a_camera_sees_is_not_hidden(tmp_path: Path) -> None:
    """Shapes and emitters of a Mitsuba scene are counted; items of the config are items."""
    (tmp_path / "lamps.xml").write_text(
        '<scene version="3.0.0"><bsdf type="diffuse" id="grey"/><emitter type="point"/>'
        '<shape type="rectangle"><ref id="grey"/></shape><shape type="sphere"/>'
        '<shape type="rectangle"><emitter type="area"/></shape></scene>'
    )
    camera = (
        "capture: {scan_type: line_of_sight, camera: {position: [0, 0, 4], look_at: [0, 0, 0], width: 5, height: 3}}"
    )
    item, lamp = "{type: sphere, center: [0, 0, 0], radius: 1}", "{type: point, position: [0, 2, 0], intensity: 1}"
    for scene, expected in (
        ("{mitsuba: lamps.xml}", "lamps.xml with 3 shapes and 2 emitters"),
        (f"{{mitsuba: lamps.xml, hidden_geometry: [{item}]}}", "lamps.xml with 3 shapes and 2 emitters, 1 item"),
        (f"{{hidden_geometry: [{item}], emitters: [{lamp}]}}", "1 item, 1 emitter"),
        (f"{{emitters: [{lamp}]}}", "0 items, 1 emitter"),
    ):
        (tmp_path / "view.yaml").write_text(f"scene: {scene}\n{camera}\n")
        result = runner.invoke(app, ["validate", str(tmp_path / "view.yaml")])
        assert f"5 x 3 pixels, auto bins of 0.003 m, {expected})" in result.stdout, result.exception


def test_new_without_a_path_prints_the_same_text(tmp_path: Path) -> None:
    """Standard output is the default and has another name."""
    printed = runner.invoke(app, ["new"]).stdout
    assert printed == runner.invoke(app, ["new", "-"]).stdout
    runner.invoke(app, ["new", str(tmp_path / "capture.yaml")])
    assert (tmp_path / "capture.yaml").read_text() == printed


def test_new_overwrites_only_by_force(starter: Path) -> None:
    """An existing file survives without --force."""
    mine = "scene: {}  # mine"
    starter.write_text(mine)
    result = runner.invoke(app, ["new", str(starter)])
    assert isinstance(result.exception, FileError)
    assert result.exception.exit_code == EXIT_BAD_INPUT
    assert "exists already; --force overwrites it" in str(result.exception)
    assert starter.read_text() == mine
    assert runner.invoke(app, ["new", str(starter), "--force"]).exit_code == 0
    assert starter.read_text() != mine


@pytest.mark.parametrize(
    ("name", "message"), [("no/z.yaml", "there is no folder"), ("a\0b", "cannot be used as an output")]
)
def test_new_explains_a_place_it_cannot_write_to(name: str, message: str, tmp_path: Path) -> None:
    """A missing folder or an impossible name is explained."""
    result = runner.invoke(app, ["new", str(tmp_path / name)])
    assert isinstance(result.exception, FileError)
    assert message in str(result.exception)


@pytest.mark.parametrize("name", ["circular-confocal", "mesh-wall", "mitsuba-scene", "sparse-random", "z-letter"])
def test_an_example_stands_in_any_folder(name: str, tmp_path: Path) -> None:
    """It is valid there, with the files it names; it writes beside itself, and an unchanged file is no obstacle."""
    target = tmp_path / "mine.yaml"
    for options in ([], ["--force"]):
        assert runner.invoke(app, ["new", str(target), "--example", name, *options]).exit_code == 0
    assert load(target).config.output.path == Path(f"{name}.hdf5")
    assert not any(word in target.read_text() for word in ("configs/", "scenes/", "out/"))


def test_new_refuses_examples_that_it_cannot_write(tmp_path: Path) -> None:
    """Unknown names, a scan type beside one, a file that is lost on standard output, another file of the same name."""
    assert set(runner.invoke(app, ["new", "--example", "list"]).stdout.split()) == set(example_names())
    unknown = runner.invoke(app, ["new", "--example", "z-leter"]).exception
    assert "need one of" in str(unknown)
    assert "Did you mean z-letter?" in str(unknown)
    assert runner.invoke(app, ["new", "--example", "smoke", "--scan-type", "single"]).exit_code == EXIT_USAGE
    assert "comes with circle.csv" in str(runner.invoke(app, ["new", "--example", "circular-confocal"]).exception)
    (tmp_path / "circle.csv").write_text("0,0\n")
    result = runner.invoke(app, ["new", str(tmp_path / "c.yaml"), "--example", "circular-confocal"])
    assert "circle.csv: exists already and is another file" in str(result.exception)
    assert (tmp_path / "circle.csv").read_text() == "0,0\n"


def test_new_knows_three_scans() -> None:
    """Another scan type is a usage error."""
    assert runner.invoke(app, ["new", "--scan-type", "raster"]).exit_code == EXIT_USAGE


def test_validate_raises_the_problems_of_every_file(starter: Path, tmp_path: Path) -> None:
    """All files are looked at; good ones are ok, the mistakes of the others come together."""
    result = runner.invoke(app, ["validate", str(tmp_path / "no.yaml"), str(starter), str(tmp_path)])
    assert f"{starter}: ok" in result.stdout
    assert isinstance(result.exception, ConfigError)
    assert [problem.place for problem in result.exception.issues] == [str(tmp_path / "no.yaml"), str(tmp_path)]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize(
    ("mesh", "expected"), [("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "ok"), ("f 1 2 3\n", "pipe:7:15: scene.hidden")]
)
def test_a_pipe_is_read_once(mesh: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another program writes is a config, with places for what is found later; its files are looked for here."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("mesh.obj").write_text(mesh)
    wall = "  relay_wall: {type: rectangle, width: 2, height: 2}\n"
    item = "  hidden_geometry:\n  -\n    type: mesh\n    filename: mesh.obj\n"
    capture = "capture: {scan_type: confocal, sensor_grid: {nx: 3, ny: 2}}\n"
    writer = threading.Thread(target=Path("pipe").write_text, args=(f"# a\nscene:\n{wall}{item}{capture}",))
    writer.start()
    result = runner.invoke(app, ["validate", "pipe"])
    writer.join()
    assert expected in (str(result.exception) if result.exception else result.stdout)


def test_validate_applies_overrides(starter: Path) -> None:
    """--set is repeatable and judged with the file."""
    options = ["--set", "capture.sensor_grid.nx=7", "--set", "time_axis.n_bins=9"]
    result = runner.invoke(app, ["validate", str(starter), *options])
    assert "7 x 32 sensors, 4 x 3 lasers, 9 bins" in result.stdout


def test_validate_as_json_is_one_object_either_way(starter: Path) -> None:
    """--json prints valid, problems and warnings on stdout; the exit code still tells."""
    good = runner.invoke(app, ["validate", "--json", str(starter), "--set", "scene.hidden_geometry=[]"])
    verdict = json.loads(good.stdout)
    assert (good.exit_code, verdict["valid"], verdict["problems"]) == (0, True, [])
    assert "scene.hidden_geometry is empty" in verdict["warnings"][0]
    override = "capture.laser_grid.nx=0"
    bad = runner.invoke(app, ["validate", "--json", str(starter), "--set", override])
    verdict = json.loads(bad.stdout)
    assert (bad.exit_code, verdict["valid"], verdict["warnings"]) == (EXIT_BAD_INPUT, False, [])
    (problem,) = verdict["problems"]
    assert problem["place"] == f"--set {override}"
    assert problem["key"] == "capture.laser_grid.nx"
    assert problem["message"].startswith("got 0, need an integer >= 1")


def test_warnings_go_to_stderr(starter: Path) -> None:
    """stdout holds results only."""
    result = runner.invoke(app, ["validate", str(starter), "--set", "render.max_bounces=2"])
    assert result.exit_code == 0
    assert "max_bounces is 2" in result.stderr
    assert "max_bounces" not in result.stdout


def test_schema_describes_every_section() -> None:
    """The JSON Schema is one JSON document with the keys, units and required keys of the config."""
    schema = json.loads(runner.invoke(app, ["schema"]).stdout)
    sections = {"name", "scene", "capture", "time_axis", "render", "output", "sensor", "sweep", "dataset"}
    assert set(schema["properties"]) == sections
    assert schema["required"] == ["scene", "capture"]
    assert schema["additionalProperties"] is False
    bins = schema["$defs"]["TimeAxisConfig"]["properties"]
    assert bins["bin_width_opl"]["exclusiveMinimum"] == 0
    assert "10 ps" in bins["bin_width_opl"]["description"]
    wall, nothing = schema["$defs"]["SceneConfig"]["properties"]["relay_wall"]["anyOf"]
    assert set(wall["discriminator"]["mapping"]) == {"rectangle", "sphere", "cylinder", "mesh"}
    assert nothing == {"type": "null"}


@pytest.mark.parametrize("command", ["new", "validate", "schema"])
def test_help_ends_with_an_example(command: str) -> None:
    """The last paragraph of --help is one command to copy, and what it creates."""
    last = runner.invoke(app, [command, "--help"]).stdout.rstrip().split("\n\n")[-1]
    assert f"Example: nlosrender {command}" in " ".join(last.split())


def test_the_program_exits_with_3_and_names_the_line(starter: Path) -> None:
    """The whole program: mistakes on stderr with file:line:column, exit code 3, no traceback."""
    text = starter.read_text()
    starter.write_text(text.replace("nx: 32 ", "nx: 0  "))
    line = text[: text.index("nx: 32")].count("\n") + 1
    result = nlosrender("validate", "z.yaml", folder=starter.parent)
    assert result.returncode == EXIT_BAD_INPUT
    assert f"error: z.yaml:{line}:9: capture.sensor_grid.nx: got 0, need an integer >= 1." in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


def test_the_program_validates_without_the_renderer(starter: Path) -> None:
    """A config is judged in a fraction of a second: neither Mitsuba nor numpy is loaded."""
    code = (
        "import sys; from typer.testing import CliRunner; from nlosrender.cli.app import app; "
        f"assert CliRunner().invoke(app, ['validate', {str(starter)!r}]).exit_code == 0; "
        "sys.exit(bool({'mitsuba', 'drjit', 'numpy', 'h5py', 'matplotlib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
