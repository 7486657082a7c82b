"""Keys that another value of a choice needs: allowed, without effect, and said once."""

from __future__ import annotations

import itertools
import pickle
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from nlosrender.config.emitters import EmitterConfig
from nlosrender.config.hidden_geometry import HiddenItemConfig
from nlosrender.config.load import config_to_dict, load_config, parse_config, parse_document
from nlosrender.config.relay_wall import RelayWallConfig
from nlosrender.config.sweep_load import sweep_of
from nlosrender.config.unused_keys import fields_by_type
from nlosrender.config.warnings import config_warnings
from nlosrender.errors import ConfigError

ROOT = Path(__file__).parents[2]
CAMERA = {"position": [0, 0, 3], "look_at": [0, 0, 0], "width": 5, "height": 3}
LAMP = {"type": "point", "position": [0, 1, 1], "intensity": 1.0}
# what each scan type needs, or may have, and others do not
OWN: dict[str, dict[str, Any]] = {
    "single": {"capture.laser_point": [0.1, 0.2]},
    "confocal": {},
    "exhaustive": {"capture.laser_grid": {"nx": 2, "ny": 7}},
    "line_of_sight": {"capture.camera": CAMERA, "scene.emitters": [LAMP]},
}
OF_WALLS: dict[str, Any] = {
    "capture.sensor_grid": {"nx": 3, "ny": 4, "width": 1.0},
    "capture.laser_position": [0, 0, 1.5],
    "capture.sensor_position": [0, 0.1, 1.5],
    "capture.laser_energy": 2.0,
    "capture.laser_spot_radius": 0.01,
    "render.laser_sampling": False,
}
WALLS: dict[str, dict[str, Any]] = {
    "rectangle": {"width": 2.0, "height": 1.5, "normal": [0, 0, 1], "up": [0, 1, 0]},
    "sphere": {"radius": 3.0, "inside": True, "width": 2.0, "height": 1.5},
    "cylinder": {"axis": [0, 1, 0], "radius": 3.0, "height": 1.5, "inside": True},
    "mesh": {"filename": "wall.obj", "flip_normals": True, "width": 2.0, "height": 1.5},
}


def config_of(scan: str, *settings: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration of a scan type with dotted keys set."""
    tree: dict[str, Any] = {
        "scene": {
            "relay_wall": {"type": "rectangle", "width": 2.0, "height": 1.5},
            "hidden_geometry": [{"type": "sphere", "center": [0, 0, 1], "radius": 0.5}],
        },
        "capture": {"scan_type": scan},
        "render": {"spp": 4},
    }
    for key, value in itertools.chain.from_iterable(setting.items() for setting in settings):
        section, name = key.split(".")
        tree[section][name] = value
    return tree


def parsed(tree: dict[str, Any], *overrides: str, folder: Path = Path()) -> Any:
    return parse_config(yaml.safe_dump(tree), "z.yaml", folder, overrides)


@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(OWN, 2)))
def test_a_scan_type_can_be_changed_alone(before: str, after: str) -> None:
    """Of a file with the keys of two scan types each makes the capture that its own keys make, and one warning."""
    shared = OF_WALLS if {before, after} != {"line_of_sight"} else {}
    # a camera has an effect on every scan type
    own_before = {key: value for key, value in OWN[before].items() if key != "capture.camera"}
    both = config_of(before, own_before, OWN[after], shared)
    needed = OWN[after] if after == "line_of_sight" else {**OWN[after], **shared}
    changed = parsed(both, f"capture.scan_type={after}")
    assert config_to_dict(changed) == config_to_dict(parsed(config_of(after, needed)))
    idle = {*own_before, *(shared if after == "line_of_sight" else {})} - {*OWN[after]}
    notes = [warning for warning in config_warnings(changed) if "no effect" in warning]
    assert len(notes) == bool(idle)
    if idle:
        named, rest = re.fullmatch(r"(.*) ha(?:s|ve) no effect with (.*)", notes[0]).groups()
        assert set(named.split(", ")) == idle
        assert rest.startswith(f"capture.scan_type: {after}; ")
    # what is stored in the file, and what a worker process is sent, is the capture without them
    assert config_warnings(parsed(config_to_dict(changed))) == tuple(set(config_warnings(changed)) - {*notes})
    assert pickle.loads(pickle.dumps(changed)) == changed


@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(WALLS, 2)))
def test_a_wall_can_be_changed_alone(before: str, after: str, tmp_path: Path) -> None:
    """A wall with the keys of another type as well is that of its own keys; each other key is named."""
    (tmp_path / "wall.obj").write_text("v 0 0 0\n")
    scan = {"capture.sensor_grid": {"nx": 3, "ny": 4}}
    wall = {"type": before, **WALLS[before], **WALLS[after]}
    changed = parsed(
        config_of("confocal", scan, {"scene.relay_wall": wall}), f"scene.relay_wall.type={after}", folder=tmp_path
    )
    plain = parsed(config_of("confocal", scan, {"scene.relay_wall": {"type": after, **WALLS[after]}}), folder=tmp_path)
    assert config_to_dict(changed) == config_to_dict(plain)
    (note,) = [warning for warning in config_warnings(changed) if "no effect" in warning]
    gone = {f"scene.relay_wall.{key}" for key in WALLS[before].keys() - fields_by_type(RelayWallConfig)[after]}
    assert set(re.split(" ha", note)[0].split(", ")) == gone


@pytest.mark.parametrize(
    ("path", "choice"),
    [
        ("scene.relay_wall", RelayWallConfig),
        ("scene.hidden_geometry.0", HiddenItemConfig),
        ("scene.emitters.0", EmitterConfig),
    ],
)
def test_keys_that_place_a_thing_stay_mistakes(path: str, choice: Any) -> None:
    """A thing that is not where it was asked to be is no warning; null takes the key back; misspelt keys are told."""
    tried = 0
    for chosen, fields in fields_by_type(choice).items():
        for key in {"center", "translate", "rotate_deg", "scale"} - fields:
            tree = config_of("line_of_sight", OWN["line_of_sight"])
            with pytest.raises(ConfigError) as caught:
                parsed(tree, f"{path}={{type: {chosen}, {key}: 1}}")
            assert any(problem.key == f"{path}.{key}" for problem in caught.value.issues)
            with pytest.raises(ConfigError) as caught:
                parsed(tree, f"{path}={{type: {chosen}, {key}: null, radios: 1}}")
            assert not any(problem.key == f"{path}.{key}" for problem in caught.value.issues)
            assert any(problem.key == f"{path}.radios" for problem in caught.value.issues)
            tried += 1
    assert tried >= 10


def test_a_goal_on_the_command_line_wins() -> None:
    """spp and target_error exclude each other: a mistake in a file; of those set over it the last one wins."""
    grid = {"capture.sensor_grid": {"nx": 3, "ny": 4}}
    error = parsed(config_of("confocal", grid), "render.target_error=0.1")
    assert (error.render.spp, error.render.target_error) == (None, 0.1)
    assert config_warnings(error) == ("render.spp has no effect beside render.target_error, which is set over it.",)
    paths = parsed(config_of("confocal", grid), "render.target_error=0.1", "render.spp=9")
    assert (paths.render.spp, paths.render.target_error) == (9, None)
    with pytest.raises(ConfigError, match="they exclude each other"):
        parsed(config_of("confocal", grid, {"render.target_error": 0.1}))
    with pytest.raises(ConfigError, match="they exclude each other"):
        parsed(config_of("confocal", grid), "render={spp: 3, target_error: 0.1}")


def test_a_sweep_goes_over_scan_types() -> None:
    """Each capture takes what its own scan type needs."""
    tree = config_of("single", OWN["single"], OWN["exhaustive"], {"capture.sensor_grid": {"nx": 3, "ny": 4}})
    tree["sweep"] = {"keys": {"capture.scan_type": ["single", "confocal", "exhaustive"]}}
    sweep = sweep_of(parse_document(yaml.safe_dump(tree), "z.yaml", Path()))
    assert sweep is not None
    captures = [sweep.config(index).capture for index in range(3)]
    assert [capture.laser_point is not None for capture in captures] == [True, False, False]
    assert [capture.laser_grid is not None for capture in captures] == [False, False, True]


def test_the_examples_of_the_reconstruction_page_run_as_written() -> None:
    """The page tells users to change the scan type of a file with a laser point."""
    page = (ROOT / "docs" / "reconstruction.md").read_text()
    commands = re.findall(r"^nlosrender render (\S+).*?(?:--set (\S+))?$", page, re.MULTILINE)
    assert ("configs/z-letter.yaml", "capture.scan_type=confocal") in commands
    for name, override in commands:
        config = load_config(ROOT / name, [override] if override else [])
        assert config.capture.scan_type == (override.partition("=")[2] or "single")
