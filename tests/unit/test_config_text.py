"""The YAML text, ``--set``, the starter and the warnings."""

from __future__ import annotations

import random
import re
import time
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

from nlosrender.config import document, hidden_geometry, relay_wall
from nlosrender.config.load import config_to_dict, parse_config
from nlosrender.config.template import starter_config
from nlosrender.config.warnings import config_warnings
from nlosrender.errors import ConfigError

SMALL = """\
scene:
  relay_wall: {type: rectangle, width: 2, height: 1.5}
  hidden_geometry:
    - {type: sphere, center: [0, 0, 1], radius: 0.5}
    - {type: box, center: [0, 0, 1], size: [1, 2, 3]}
capture: {scan_type: single, sensor_grid: {nx: 3, ny: 5}}
"""


def parse(text: str, *overrides: str) -> document.Config:
    return parse_config(text, "z.yaml", Path("."), overrides)


def refused(text: str, *overrides: str, match: str) -> ConfigError:
    with pytest.raises(ConfigError, match=match) as caught:
        parse(text, *overrides)
    return caught.value


# --- aliases and bounds ---


def test_aliases_and_merges_are_written_out() -> None:
    """An alias stands for the anchored value; << adds keys that are not there, the mapping's own win."""
    text = SMALL.replace("sensor_grid: {", "sensor_grid: &grid {").replace("single", "exhaustive")
    config = parse(text.replace("}}", "}, laser_grid: {ny: 7, <<: *grid}}"))
    assert config.capture.laser_grid is not None
    assert (config.capture.laser_grid.nx, config.capture.laser_grid.ny) == (3, 7)


def test_a_wrong_value_behind_an_alias_is_placed_where_it_is_written() -> None:
    """The value to change is at the anchor."""
    text = SMALL.replace("radius: 0.5", "radius: &r -1").replace("size: [1, 2, 3]", "name: *r, size: [1, 2, 3]")
    error = refused(text, match=r"z\.yaml:4:49: scene\.hidden_geometry\.0\.radius")
    assert "got -1, need text" in str(error)


def bomb(levels: int, width: int) -> str:
    lines = ["a0: &a0 [" + ", ".join(["x"] * width) + "]"]
    lines += [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * width) + "]" for i in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (bomb(9, 9), "aliases grow it beyond 100000 values"),
        (bomb(30, 10), "aliases grow it beyond 100000 values"),
        (bomb(33, 1), "aliases grow it beyond 100000 values or 32 levels"),
        ("a: &a [*a]", "an alias inside its own anchor never ends"),
        ("a: &a {b: {c: *a}}", "an alias inside its own anchor never ends"),
        ("a: " + "[" * 40, "nested deeper than 32 levels"),
        ("a: " + "{b: " * 40, "nested deeper than 32 levels"),
        ("\n".join("- " * 40 for _ in range(3)), "nested deeper than 32 levels"),
        ("[" * 500_000, "nested deeper than 32 levels"),
    ],
)
def test_text_that_grows_without_bound_is_refused_before_it_grows(text: str, message: str) -> None:
    """The size after aliases are written out is counted in the node graph, in milliseconds, not in memory."""
    start = time.process_time()  # of this process alone, however busy the machine is
    error = refused(text, match=message)
    # Some 20 ms on a slow machine; written out, the bombs hold 9^9 and 10^30 values.
    assert time.process_time() - start < 2.0
    assert re.match(r"z\.yaml:\d+:\d+$", error.issues[0].place)


def test_many_values_are_refused_too() -> None:
    """The bound of 100_000 values also holds without aliases."""
    refused("a: [" + "1," * 100_001 + "]", match="more than 100000 keys and values")


def test_broken_text_never_gives_a_traceback() -> None:
    """Any damage to a config is a config or a ConfigError: 150 random edits of the starter."""
    generator = random.Random(7)
    start = starter_config("exhaustive")
    refusals: list[ConfigError] = []
    for _ in range(150):
        text = start
        for _ in range(generator.randint(1, 3)):
            i = generator.randrange(len(text))
            insert = generator.choice(
                ["", "[", "}", ": ", "\n", "-", "&a ", "*a", "!!set ", "\t", "1e9", "null", "'", "<<: "]
            )
            text = text[:i] + insert + text[i + generator.randint(0, 4) :]
        try:
            parse(text)
        except ConfigError as error:
            refusals.append(error)
    assert all(error.issues and all(problem.message for problem in error.issues) for error in refusals)
    assert len(refusals) > 15  # edits inside comments, a half of the text, change nothing


# --- overrides ---


def test_overrides_win_over_the_file_before_validation() -> None:
    """Values are YAML, numbers index lists, missing mappings are made, later ones win."""
    config = parse(
        SMALL,
        "capture.sensor_grid.nx=16",
        "scene.hidden_geometry.1.size=[1, 1, 1e-1]",
        "render.spp=8",
        "render.spp=9",
        "scene.relay_wall.bsdf={type: diffuse, reflectance: 0.5}",
        "name=a=b",
        "capture.laser_position=",
    )
    assert config.capture.sensor_grid.nx == 16
    assert config.scene.hidden_geometry[1].type == "box"
    assert config.scene.hidden_geometry[1].size == (1.0, 1.0, 0.1)
    assert config.render.spp == 9
    assert config.scene.relay_wall.bsdf["reflectance"] == 0.5
    assert config.name == "a=b"
    assert config.output.path == Path("a=b.hdf5")
    assert config.capture.laser_position is None


def test_an_override_can_repair_the_file() -> None:
    """Only what is left after overriding is judged."""
    assert parse(SMALL.replace("nx: 3", "nx: 0"), "capture.sensor_grid.nx=2").capture.sensor_grid.nx == 2


@pytest.mark.parametrize(
    ("override", "key", "message"),
    [
        ("capture.sensor_grid.nx=0", "capture.sensor_grid.nx", "got 0, need an integer >= 1"),
        ("capture.sensor_grdi.nx=4", "capture.sensor_grdi", "unknown key. Did you mean sensor_grid?"),
        (
            "scene.hidden_geometry.2.radius=1",
            "scene.hidden_geometry.2",
            "got 2 in a list of 2, need an index from 0 to 1",
        ),
        ("scene.hidden_geometry.-1.radius=1", "scene.hidden_geometry.-1", "got -1 in a list of 2"),
        ("scene.hidden_geometry.x.radius=1", "scene.hidden_geometry.x", "got x in a list of 2"),
        ("capture.scan_type.x=1", "capture.scan_type", "cannot set x in capture.scan_type, which holds 'single'"),
        ("render.spp", "", "need KEY=VALUE with dots between keys"),
        ("=3", "", "need KEY=VALUE"),
        ("render..spp=3", "", "need KEY=VALUE"),
        ("render.spp=[1", "render.spp", "not usable as YAML"),
        ("render.spp=.inf", "render.spp", "got .inf, need a finite number"),
        (
            "scene.hidden_geometry.0={type: sphere, radius: 1}",
            "scene.hidden_geometry.0.center",
            "missing, it is required",
        ),
        ("scene.hidden_geometry.0.bsdf.x=4", "scene.hidden_geometry.0.bsdf.type", "missing"),
    ],
)
def test_a_wrong_override_is_placed_at_the_override(override: str, key: str, message: str) -> None:
    """The place of a mistake that came by --set is that option, as it was typed."""
    error = refused(SMALL, override, match=re.escape(message))
    (problem,) = [problem for problem in error.issues if problem.key == key]
    assert problem.place == f"--set {override}"


# --- starter ---


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive", "line_of_sight"])
def test_the_starter_is_valid_and_has_the_asked_scan(scan_type) -> None:
    """What `new` writes can be rendered as it is, without a warning."""
    config = parse(starter_config(scan_type, "two planes #1"))
    assert config.capture.scan_type == scan_type
    assert config.name == "two-planes--1"
    assert config_warnings(config) == ()


@pytest.mark.parametrize("name", ["007", "null", "-x", "é", "a: b", "1e5", "", "true", "{", "x" * 300])
def test_the_starter_survives_any_file_name(name: str) -> None:
    """The capture's name stays text, whatever the file is called."""
    assert parse(starter_config("single", name, f"{name}.yaml")).name


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive", "line_of_sight"])
def test_the_starter_names_every_key(scan_type) -> None:
    """Every key of every section and item type is in the starter, as a value or an example, with a comment."""
    text = starter_config(scan_type)
    sections: list[type[BaseModel]] = [
        document.Config,
        document.SceneConfig,
        document.CaptureConfig,
        document.TimeAxisConfig,
        document.RenderConfig,
        document.OutputConfig,
        document.SensorConfig,
    ]
    sections += [
        value
        for module in (hidden_geometry, relay_wall)
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, BaseModel) and "type" in value.model_fields
    ]
    assert len(sections) == 7 + 8 + 4
    for section in sections:
        for key in section.model_fields:
            assert re.search(rf"\b{key}:", text), f"{section.__name__}.{key}"
    assert all("#" in line for line in text.splitlines() if re.match(r" {2,4}\w+: [^{]", line))


def test_the_values_in_the_starter_that_are_called_default_are() -> None:
    """Leaving out time_axis, render and output changes nothing but the stated choices."""
    starter = config_to_dict(parse(starter_config("confocal")))
    raw = yaml.safe_load(starter_config("confocal"))
    bare = config_to_dict(parse(yaml.safe_dump({key: raw[key] for key in ("name", "scene", "capture")})))
    assert bare == starter


def test_the_examples_in_the_starter_are_valid(tmp_path: Path) -> None:
    """Each commented item and wall becomes valid when its comment sign goes."""
    (tmp_path / "bunny.ply").write_text("ply\n")
    text = starter_config("single")
    items = re.findall(r"^    # - (\{.*\})$", text, re.MULTILINE)
    walls = re.findall(r"^  # relay_wall: (\{.*\})$", text, re.MULTILINE)
    assert (len(items), len(walls)) == (7, 2)
    for wall in ["{type: rectangle, width: 2, height: 2}", *walls]:
        fitting = [item for item in items if "rectangle" in wall or "room" not in item]
        scene = f"scene: {{relay_wall: {wall}, hidden_geometry: [{', '.join(fitting)}]}}\n"
        config = parse_config(scene + SMALL[SMALL.index("capture") :], "z.yaml", tmp_path)
        assert len(config.scene.hidden_geometry) == len(fitting)


# --- warnings ---


@pytest.mark.parametrize(
    ("override", "match"),
    [
        ("scene.hidden_geometry=[]", "hidden_geometry is empty"),
        ("render.max_bounces=2", "max_bounces is 2"),
        ("scene.relay_wall.bsdf={type: diffuse, reflectance: 0}", "relay_wall.bsdf has reflectance 0"),
        ("scene.hidden_geometry.0.center=[0, 0, -1]", r"hidden_geometry.0 \(sphere-0\) lies behind the relay wall"),
        ("time_axis.start_opl=1", "start_opl is not 0"),
        ("capture.account_first_and_last_bounces=false", "loaders expect the first and last legs"),
        ("render.time_limit_s=3", "time_limit_s alone"),
        ("render={max_bounces: null, russian_roulette: false}", "may take for ever. Limit max_bounces"),
        ("capture.sensor_grid.nx=6", r"sensor_grid\.nx is 6: y-tal's converter"),
        ("capture.laser_grid={nx: 2, ny: 2}", r"^capture\.laser_grid has no effect with .* single; it is for exh"),
        ("scene.hidden_geometry.0.size=[1, 1, 1]", r"^scene\.hidden_geometry\.0\.size has no effect with .*: sphere"),
        ("scene.relay_wall.radius=1", r"^scene\.relay_wall\.radius has no effect with .*: rectangle; it is for sphere"),
    ],
)
def test_what_is_legal_but_pointless_is_said(override: str, match: str) -> None:
    """Each pointless setting gives exactly its own warning; the plain config gives none."""
    assert config_warnings(parse(SMALL)) == ()
    (warning,) = config_warnings(parse(SMALL, override))
    assert re.search(match, warning)


def test_six_columns_are_harmless_where_the_file_has_no_laser_axes() -> None:
    """A confocal file is 5-D: y-tal does not look for the bounce axis by its length there."""
    text = SMALL.replace("single", "confocal")
    assert config_warnings(parse(text, "capture.sensor_grid.nx=6")) == ()
    assert config_warnings(parse(text, "capture.sensor_grid.ny=6")) == ()


def test_black_hidden_items_are_said_only_when_all_are() -> None:
    """One reflecting item is enough."""
    black = "{type: twosided, a: {type: diffuse, reflectance: 0}}"
    one = parse(SMALL, f"scene.hidden_geometry.0.bsdf={black}")
    both = parse(
        SMALL, f"scene.hidden_geometry.0.bsdf={black}", "scene.hidden_geometry.1.bsdf={type: diffuse, reflectance: 0}"
    )
    assert config_warnings(one) == ()
    assert "every hidden item has reflectance 0" in config_warnings(both)[0]


# --- what a shell hands over ---


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("output.path={name}/{name}.hdf5", "output.path", "z/z.hdf5"),
        ("output.path=out/{name}.hdf5", "output.path", "out/z.hdf5"),
        ("output.path=a: b #1.hdf5", "output.path", "a: b #1.hdf5"),
        ("output.path=[a].hdf5", "output.path", "[a].hdf5"),
        ('output.path="caf\\udce9.hdf5"', "output.path", "caf\udce9.hdf5"),
        ("output.path=caf\udce9.hdf5", "output.path", "caf\udce9.hdf5"),
        ("name=1e3", "name", "1e3"),
        ("name=yes", "name", "yes"),
        ("name=true", "name", "true"),
        ("name=*x", "name", "*x"),
        ("name='a b'", "name", "a b"),
        ('name="\\ud83d\\ude00"', "name", "\U0001f600"),
    ],
)
def test_text_needs_no_quotes_on_the_command_line(override: str, key: str, value: str) -> None:
    """Where a key takes text, VALUE is that text, whatever YAML would make of it: the shell has taken the quotes."""
    config = parse(SMALL, override)
    assert str(config.output.path if key == "output.path" else config.name) == value


def test_surrogate_pairs_are_one_character() -> None:
    """A config that is JSON writes an emoji as two escapes; as key, value or part of a list it is one character."""
    text = SMALL + '"name": "\\ud83d\\ude00 \\u00e9"\n'
    assert parse(text).name == "\U0001f600 é"
    refused(SMALL + '"\\ud83d\\ude00": 1\n', match="\U0001f600: unknown key")
    refused(SMALL + 'name: "\\ud83d"\n', match=r"z\.yaml:\d+:7: name: .*halves of characters")
