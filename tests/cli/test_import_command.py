"""``import`` as a user types it, and what other commands say of files that it is for."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.commands import run

from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, EXIT_USAGE

XML = """<scene version="3.0.0">
<integrator type="transient_nlos_path"><integer name="max_depth" value="4"/></integrator>
<emitter type="projector"><float name="fov" value="0.2"/></emitter>
<shape type="rectangle"><sensor type="nlos_capture_meter">
<point name="sensor_origin" x="0" y="0" z="1"/>
<film type="transient_hdr_film">
<integer name="width" value="3"/>
<integer name="height" value="2"/></film></sensor></shape>
</scene>
"""
YAML = """num_bins: 1_000
geometry:
- {name: wall, mesh: {type: rectangle}, material: {id: white}}
relay_wall: wall
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a scene of mitransient and one of y-tal."""
    (tmp_path / "m.xml").write_text(XML)
    (tmp_path / "y.yaml").write_text(YAML)
    return tmp_path


def test_one_line_for_every_key_and_a_configuration(folder: Path) -> None:
    """Each key of the file is told once, with its place and a verdict; what is written passes validate."""
    for file, options, n_keys in (("m.xml", ("--laser", "0.5,0.25"), 9), ("y.yaml", (), 5)):
        done = run(folder, "import", file, "-o", "z.yaml", "--force", *options)
        assert done.returncode == EXIT_OK, done.stderr
        told = re.findall(rf"^(taken|changed|dropped) +{file}:\d+\S* (\S+):", done.stdout, re.MULTILINE)
        assert len(told) == len({key for _, key in told}) == n_keys
        assert done.stdout.splitlines()[-1].startswith("z.yaml: written")
        assert run(folder, "validate", "z.yaml").returncode == EXIT_OK


def test_a_refusal_writes_nothing(folder: Path) -> None:
    """The reason is among the lines, and an error with its place; exit code 3."""
    done = run(folder, "import", "m.xml", "-o", "z.yaml")  # its laser looks along the wall's back
    assert done.returncode == EXIT_BAD_INPUT
    assert re.search(r"^refused +m.xml:3: emitter.to_world: the laser does not look at", done.stdout, re.MULTILINE)
    assert "error: m.xml:3: emitter.to_world: the laser" in done.stderr
    assert not (folder / "z.yaml").exists()
    done = run(folder, "import", "m.xml", "-o", "z.yaml", "--json")
    told = json.loads(done.stdout)
    assert (told["output"], told["problems"][0]["line"], told["exit_code"]) == (None, 3, EXIT_BAD_INPUT)
    assert {"place", "key", "value", "verdict", "remark"} == {*told["keys"][0]}


def test_nothing_else_is_replaced(folder: Path) -> None:
    """An existing file needs --force, and what is no configuration stays; so does what is read."""
    (folder / "z.yaml").write_text("scene: mine\n")
    (folder / "thesis.tex").write_text("thesis\n")
    assert "--force overwrites it" in run(folder, "import", "y.yaml", "-o", "z.yaml").stderr
    for target in ("thesis.tex", "y.yaml"):
        kept = (folder / target).read_text()
        assert run(folder, "import", "y.yaml", "-o", target, "--force").returncode == EXIT_BAD_INPUT
        assert (folder / target).read_text() == kept


@pytest.mark.parametrize("laser", ["1", "a,b", "1,2,3", "nan,0"])
def test_a_laser_point_is_two_numbers(folder: Path, laser: str) -> None:
    """Anything else is a mistake in the arguments."""
    done = run(folder, "import", "m.xml", "-o", "z.yaml", "--laser", laser)
    assert done.returncode == EXIT_USAGE
    assert "two numbers such as 0.1,-0.2" in done.stderr


@pytest.mark.parametrize("command", ["validate", "render", "plan"])
@pytest.mark.parametrize(("file", "kind"), [("m.xml", "a Mitsuba scene in XML"), ("y.yaml", "a scene of y-tal")])
def test_other_commands_name_the_command(folder: Path, command: str, file: str, kind: str) -> None:
    """A scene of another renderer is told as one, not as a configuration full of mistakes."""
    done = run(folder, command, file)
    assert done.returncode == EXIT_BAD_INPUT
    advice = f"nlosrender import {file} -o capture.yaml makes one of it"
    assert f"{file}:1:1: this is {kind}, no configuration; {advice}" in done.stderr


def test_what_is_neither_is_refused(folder: Path) -> None:
    """No file, no YAML, a list, a configuration of ours."""
    (folder / "list.yaml").write_text("[1, 2]\n")
    (folder / "ours.yaml").write_text("scene: {}\ncapture: {}\n")
    for file, message in (
        ("none.xml", "cannot be read: No such file"),
        ("list.yaml", "no scene of y-tal"),
        ("ours.yaml", "ours.yaml:1:8: scene: unknown here"),
    ):
        done = run(folder, "import", file, "-o", "z.yaml")
        assert (done.returncode, message in done.stderr) == (EXIT_BAD_INPUT, True), done.stderr
