"""Configurations of line-of-sight captures: what they may hold, and how mistakes are told."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.rendering import configured, flat_wall
from support.views import view_config

from nlosrender.config.load import config_to_dict, load_config
from nlosrender.config.mitsuba_xml import is_colored_xml, read_mitsuba_xml
from nlosrender.config.warnings import config_warnings
from nlosrender.errors import ConfigError
from nlosrender.files.identity import capture_hash

ROOT = Path(__file__).parents[2]
LAMP = {"type": "point", "position": [0, 1, 0], "intensity": 1.0}


def problem_of(config: dict[str, Any], folder: Path | None = None) -> tuple[str, str]:
    """Return key and message of the one mistake in a configuration."""
    with pytest.raises(ConfigError) as caught:
        configured(config, folder=folder)
    (problem,) = caught.value.issues
    return problem.key, problem.message


@pytest.mark.parametrize(
    "name", ["paper/cornell-box", "paper/interior-mirror", "paper/polarised-cornell-box", "mitsuba-scene"]
)
def test_configurations_that_come_along(name: str) -> None:
    """They are valid, say nothing, and survive being written out and read again."""
    config = load_config(ROOT / "configs" / f"{name}.yaml")
    assert config.capture.is_line_of_sight
    assert config_warnings(config) == ()
    assert config_to_dict(configured(yaml.safe_dump(config_to_dict(config)))) == config_to_dict(config)


def test_pixels_are_the_sensor_grid() -> None:
    """The camera's pixels take the place of the sensor points."""
    config = configured(view_config(emitters=[LAMP], camera={"width": 7, "height": 3}))
    assert (config.capture.sensor_grid.nx, config.capture.sensor_grid.ny) == (7, 3)


@pytest.mark.parametrize(
    ("changes", "key", "message"),
    [
        ({"capture": {"camera": None}}, "capture.camera", r"missing, a line_of_sight capture needs it"),
        ({"camera": {"look_at": [0, 0, 4]}}, "capture.camera.look_at", r"the camera's position, need another"),
        ({"camera": {"up": [0, 0, 1]}}, "capture.camera.up", r"the direction the camera looks in"),
        ({"camera": {"fov_deg": 180}}, "capture.camera.fov_deg", r"an angle between 0 and 180"),
        ({"camera": {"width": 0}}, "capture.camera.width", r"got 0, need an integer >= 1"),
        ({"render": {"engine": "virtual_lights"}}, "render.engine", r"need a relay wall"),
        ({"render": {"max_bounces": -1}}, "render.max_bounces", r"got -1, need an integer >= 0 or null"),
        ({"render": {"max_bounces": 1.5}}, "render.max_bounces", r"got 1.5, need an integer, or null"),
        ({"render": {"polarized": True, "color": "rgb"}}, "render.polarized", r"rendered in grey"),
        ({"render": {"temporal_kernel_opl": 0.1}}, "render.temporal_kernel_opl", r"has plain bins"),
    ],
)
def test_mistakes_of_a_capture(changes: dict[str, Any], key: str, message: str) -> None:
    """Each is told once, at its key, with what to do."""
    arguments = {"emitters": [LAMP], **{k: v for k, v in changes.items() if k != "render"}, **changes.get("render", {})}
    found, text = problem_of(view_config(**arguments))
    assert found == key
    assert re.search(message, text), text


@pytest.mark.parametrize(
    ("emitter", "key", "message"),
    [
        ({"type": "lamp"}, "type", "need one of"),
        ({"type": "sphere", "center": [0, 0, 0], "radius": 1}, "radiance", "missing"),
        ({**LAMP, "intensity": -1}, "intensity", "got -1, need a number from 0"),
        ({**LAMP, "intensity": [1, 2]}, "intensity", r"or \[r, g, b\]"),
        ({**LAMP, "type": "spot", "look_at": [0, 1, 0]}, "look_at", "the spot's position"),
        ({**LAMP, "type": "spot", "look_at": [0, 0, 0], "beam_deg": 30}, "beam_deg", "less than cutoff_deg, 20"),
    ],
)
def test_mistakes_of_an_emitter(emitter: dict[str, Any], key: str, message: str) -> None:
    """Emitters are told apart by their type, and checked like any item."""
    with pytest.raises(ConfigError, match=message) as caught:
        configured(view_config(emitters=[emitter]))
    assert caught.value.issues[0].key == f"scene.emitters.0.{key}"


def test_a_whole_scene_is_for_cameras(tmp_path: Path) -> None:
    """Whatever the scan, it is seen by a camera, its own or the configuration's."""
    (tmp_path / "box.xml").write_text("<scene version='3.0.0'/>", encoding="utf-8")
    config = flat_wall(scan="confocal")
    config["scene"] |= {"mitsuba": "box.xml"}
    key, text = problem_of(config, tmp_path)
    assert key == "capture.camera"
    assert "box.xml has no perspective sensor" in text


def test_a_relay_wall_is_missing() -> None:
    """Only cameras do without."""
    config = flat_wall()
    del config["scene"]["relay_wall"]
    key, text = problem_of(config)
    assert key == "scene.relay_wall"
    assert text.startswith("missing, it is required")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<scene", "not well-formed XML"),
        ("<?xml version='1.0' encoding='bogus'?><scene/>", "unknown encoding"),
        ("<scene>" * 2000 + "</scene>" * 2000, "more than 64 deep"),
        ("<scene>" + "<bsdf type='diffuse'/>" * 100_000 + "</scene>", "more than 100000 elements"),
        (
            f"<scene><default name='a' value='{'x' * 100_000}'/><string name='b' value='{'$a' * 10_000}'/></scene>",
            "<default>s stand for is too large",
        ),
        ("<scene><shape type='sphere'><float name='radius' value='1e400'/></shape></scene>", "need finite numbers"),
        ("<scene><shape type='sphere'><point name='center' x='nan'/></shape></scene>", "holds nan"),
        (
            "<scene><bsdf type='diffuse'><rgb name='reflectance' value='0.5 1.5 0'/></bsdf></scene>",
            "holds 1.5, need numbers from 0 to 1 for reflectance",
        ),
        (
            "<scene>\n<bsdf type='retroreflector'><float name='width' value='1'/></bsdf></scene>",
            "line 2: <bsdf type='retroreflector'>: albedo: missing, the retroreflector BSDF needs it",
        ),
        (
            "<scene><bsdf type='retroreflector'><float name='width' value='0'/><float name='albedo' value='1'/></bsdf>"
            "</scene>",
            "width: got 0, need a number of degrees from 0.01 to 60",
        ),
        ("<scene><emitter type='point'><rgb name='intensity' value='-1'/></emitter></scene>", "need numbers >= 0"),
        ("<!DOCTYPE scene [<!ENTITY a 'b'>]><scene/>", "document type or entities"),
        ("<shape/>", "its root is <shape>"),
        ("<scene><include filename='other.xml'/></scene>", "line 1: got other.xml, but there is no file at"),
        ("<scene><shape type='../../evil'/></scene>", "need one of"),
        (
            "<scene><medium type='homogeneous'/></scene>",
            "<medium> is not supported; participating media are not rendered; remove it",
        ),
        ("<scene><shape type='$kind'/></scene>", r"\$kind has no <default>"),
        ("<scene><shape type='ply'/></scene>", "has no filename"),
        (
            "<scene><shape type='ply'><string name='filename' value='gone.ply'/></shape></scene>",
            "there is no file at",
        ),
        ("<scene><bsdf type='diffuse'><texture type='bitmap'/></bsdf></scene>", "has no filename"),
        (
            "<scene><sensor type='perspective'><film type='hdrfilm'><integer name='width' value='x'/></film></sensor>"
            "</scene>",
            "need two integers",
        ),
    ],
)
def test_mistakes_of_a_mitsuba_scene(content: str, message: str, tmp_path: Path) -> None:
    """They are found before Mitsuba sees the file."""
    (tmp_path / "scene.xml").write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        configured(view_config(emitters=[LAMP], scene={"mitsuba": "scene.xml"}), folder=tmp_path)
    assert caught.value.issues[0].key == "scene.mitsuba"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_refused_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    """A short file cannot unpack to a large one, nor name other files, however its characters are stored."""
    content = f"<?xml version='1.0' encoding='{encoding}'?><!DOCTYPE scene [<!ENTITY a 'b'>]><scene/>"
    (tmp_path / "scene.xml").write_bytes(content.encode(encoding))
    with pytest.raises(ValueError, match="document type or entities"):
        read_mitsuba_xml(tmp_path / "scene.xml")


def test_a_scene_is_another_one_when_a_file_it_names_changes(tmp_path: Path) -> None:
    """A render does not go on with another mesh or image than it began with, though the .xml stays the same."""
    (tmp_path / "scene.xml").write_text(
        "<scene><shape type='ply'><string name='filename' value='mesh.ply'/></shape></scene>", encoding="utf-8"
    )
    hashes = []
    for content in ("one", "one", "other"):
        (tmp_path / "mesh.ply").write_text(content, encoding="utf-8")
        hashes.append(capture_hash({"scene": {"mitsuba": str(tmp_path / "scene.xml")}}))
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_mitsuba_scene_without_camera_needs_one(tmp_path: Path) -> None:
    """A file without sensor goes with a configured camera, and not without."""
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'><shape type='sphere'/></scene>", encoding="utf-8")
    config = view_config(emitters=[LAMP], scene={"mitsuba": "scene.xml"})
    assert configured(config, folder=tmp_path).capture.sensor_grid.n_points == 15
    del config["capture"]["camera"]
    key, text = problem_of(config, tmp_path)
    assert key == "capture.camera"
    assert "scene.xml has no perspective sensor" in text


def test_what_is_left_of_a_mitsuba_scene(tmp_path: Path) -> None:
    """Defaults are filled in, integrators gone, of films only their size left, files absolute; colour is seen."""
    root, size = read_mitsuba_xml(ROOT / "scenes" / "glass-and-mirror.xml")
    assert size == (48, 32)
    assert not list(root.iter("integrator")) + list(root.iter("default"))
    (film,) = root.iter("film")
    assert [(item.get("name"), item.get("value")) for item in film] == [("width", "48"), ("height", "32")]
    assert is_colored_xml(root)  # the mirror is silver
    for value in ("<rgb name='reflectance' value='0.5 0.1 0.1'/>", "<spectrum name='r' value='400:0.1, 700:0.5'/>"):
        content = f"<scene><bsdf type='diffuse'>{value}</bsdf></scene>"
        (tmp_path / "colored.xml").write_text(content, encoding="utf-8")
        assert is_colored_xml(read_mitsuba_xml(tmp_path / "colored.xml")[0]), value


def test_warnings() -> None:
    """A scene in which nothing shines is legal and pointless."""
    assert any("nothing shines" in text for text in config_warnings(configured(view_config(emitters=[]))))
