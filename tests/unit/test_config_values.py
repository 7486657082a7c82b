"""What a valid config means: defaults, numbers, file names, immutability, hash."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import pytest
import yaml

from nlosrender.config.document import Config
from nlosrender.config.load import config_hash, config_to_dict, load_config, parse_config

SMALLEST = """\
scene: {relay_wall: {type: rectangle, width: 2, height: 1.5}}
capture: {scan_type: single, sensor_grid: {nx: 3, ny: 5}}
"""


def parse(text: str, folder: Path = Path("."), overrides: tuple[str, ...] = ()) -> Config:
    return parse_config(text, "dir/two-planes.yaml", folder, overrides)


def with_wall_bsdf(bsdf: str) -> Config:
    return parse(SMALLEST.replace("height: 1.5", "height: 1.5, bsdf: " + bsdf))


def test_what_is_left_out_gets_the_documented_default() -> None:
    """A config of the required keys alone is complete, and named after its file."""
    config = parse(SMALLEST)
    assert config.name == "two-planes"
    assert config.output.path == Path("two-planes.hdf5")
    assert config.scene.hidden_geometry == ()
    assert dict(config.scene.relay_wall.bsdf) == {"type": "diffuse", "reflectance": 1.0}
    assert config.capture.laser_point == (0.0, 0.0)
    assert config.capture.laser_position is None
    assert config.capture.account_first_and_last_bounces is True
    assert (config.time_axis.start_opl, config.time_axis.bin_width_opl, config.time_axis.n_bins) == (0.0, 0.003, "auto")
    assert (config.render.max_bounces, config.render.target_error, config.render.spp) == (7, 0.05, None)
    assert config.render.memory_limit_bytes is None
    assert config.output.variance is True


def test_hidden_items_face_the_wall_and_are_named_by_type_and_index() -> None:
    """An unnamed item is <type>-<index>; rectangles and letters look along -z by default."""
    config = parse(
        SMALLEST.replace(
            "1.5}",
            "1.5}, hidden_geometry: [{type: sphere, center: [0, 0, 1], radius: 0.5}, "
            "{type: letters, text: NO, height: 0.5, center: [0, 0, 1]}, {name: k, type: room, size: [3, 2, 1]}]",
        )
    )
    items = config.scene.hidden_geometry
    assert [item.name for item in items] == ["sphere-0", "letters-1", "k"]
    assert items[1].type == "letters"
    assert items[1].text == "NO"  # YAML 1.1 would read false
    assert (items[1].normal, items[1].up, items[1].thickness) == ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 0.0)
    assert items[0].bsdf["reflectance"] == 1.0


@pytest.mark.parametrize(
    ("written", "meant"),
    [("1e-3", 1e-3), ("1e3", 1000.0), (".5e2", 50.0), ("3", 3.0), ("+0.25", 0.25), ("1.e-2", 0.01), ("0x10", 16.0)],
)
def test_every_way_to_write_a_number_is_one(written: str, meant: float) -> None:
    """Numbers as YAML 1.2 has them; PyYAML alone reads 1e-3 as text."""
    config = parse(SMALLEST + f"time_axis: {{bin_width_opl: {written}}}")
    assert config.time_axis.bin_width_opl == meant
    assert isinstance(config.time_axis.bin_width_opl, float)


@pytest.mark.parametrize(
    ("written", "n_bytes"),
    [("600MB", 600_000_000), ("8GB", 8_000_000_000), ("2GiB", 2 * 2**30), ("1.5 kb", 1500), ("auto", None)],
)
def test_memory_limits_are_bytes(written: str, n_bytes: int | None) -> None:
    """MB is 10^6 and MiB is 2^20 bytes."""
    assert parse(SMALLEST + f"render: {{memory_limit: {written}}}").render.memory_limit_bytes == n_bytes


def test_another_stopping_rule_leaves_no_target_error() -> None:
    """The default error goal holds only when no other goal is given."""
    assert parse(SMALLEST + "render: {spp: 4}").render.target_error is None
    assert parse(SMALLEST + "render: {time_limit_s: 4}").render.target_error is None


def test_wall_extents_are_those_of_the_wall_coordinates() -> None:
    """Sphere: circumference by diameter; cylinder: circumference by height; a sphere's patch becomes the grid's."""
    sphere = parse(SMALLEST.replace("rectangle, width: 2, height: 1.5", "sphere, radius: 0.5, width: 0.75"))
    assert sphere.scene.relay_wall.extent == (math.pi, 1.0)
    assert (sphere.capture.sensor_grid.width, sphere.capture.sensor_grid.height) == (0.75, None)
    cylinder = parse(SMALLEST.replace("rectangle, width: 2, height: 1.5", "cylinder, radius: 0.5, height: 3"))
    assert cylinder.scene.relay_wall.extent == (math.pi, 3.0)


def test_a_grid_may_be_as_wide_as_the_wall_in_decimal() -> None:
    """0.1 + 0.2 is not 0.3: rounding does not push a grid off the wall."""
    text = SMALLEST.replace("width: 2,", "width: 0.3,").replace("ny: 5", f"ny: 5, width: {0.1 + 0.2!r}")
    assert parse(text).capture.sensor_grid.width == 0.1 + 0.2


def test_file_names_start_at_the_yaml_and_are_stored_absolute(tmp_path: Path) -> None:
    """Meshes, textures and files of Mitsuba shapes are found from the YAML's folder, whatever the current one is."""
    (tmp_path / "meshes").mkdir()
    for name in ("a.PLY", "t.png"):
        (tmp_path / "meshes" / name).write_text("x")
    items = (
        "{type: mesh, filename: meshes/a.PLY, bsdf: {type: twosided, nested: "
        "{type: diffuse, reflectance: {type: bitmap, filename: meshes/t.png}}}}, "
        "{type: mitsuba, shape: {type: ply, filename: meshes/a.PLY}}"
    )
    path = tmp_path / "c.yaml"
    path.write_text(SMALLEST.replace("1.5}", f"1.5}}, hidden_geometry: [{items}]"))
    mesh, shape = load_config(path).scene.hidden_geometry
    assert mesh.type == "mesh"
    assert mesh.filename == (tmp_path / "meshes" / "a.PLY").resolve()
    assert mesh.bsdf["nested"]["reflectance"]["filename"] == str((tmp_path / "meshes" / "t.png").resolve())
    assert shape.type == "mitsuba"
    assert shape.shape["filename"] == str(mesh.filename)


def test_transforms_of_shapes_are_checked_and_kept_in_order() -> None:
    """to_world is a matrix or a list of steps; numbers become floats, a single scale becomes three."""
    steps = "[{scale: 2}, {rotate: {axis: [0, 1, 0], angle_deg: 90}}, {translate: [0, 0, 1]}]"
    item = f"{{type: mitsuba, shape: {{type: disk, to_world: {steps}}}}}"
    (disk,) = parse(SMALLEST.replace("1.5}", f"1.5}}, hidden_geometry: [{item}]")).scene.hidden_geometry
    assert disk.type == "mitsuba"
    assert [dict(step) for step in disk.shape["to_world"]] == [
        {"scale": (2.0, 2.0, 2.0)},
        {"rotate": {"axis": (0.0, 1.0, 0.0), "angle_deg": 90.0}},
        {"translate": (0.0, 0.0, 1.0)},
    ]


@pytest.mark.parametrize(
    ("bsdf", "colored"),
    [
        ("{type: diffuse, reflectance: 0.5}", False),
        ("{type: diffuse, reflectance: [0.5, 0.5, 0.5]}", False),
        ("{type: diffuse, reflectance: [0.5, 0.4, 0.5]}", True),
        ("{type: twosided, any: {type: diffuse, reflectance: [0.5, 0.4, 0.5]}}", True),
        ("{type: diffuse, reflectance: {type: rgb, value: [0.1, 0.2, 0.3]}}", True),
        ("{type: diffuse, reflectance: {type: uniform, value: 0.3}}", False),
        ("{type: diffuse, reflectance: {type: spectrum, value: [[400, 0.1], [700, 0.2]]}}", True),
        ("{type: diffuse, reflectance: {type: checkerboard, color0: 0.1, color1: 0.9}}", False),
        ("{type: diffuse, reflectance: {type: checkerboard, to_uv: [{scale: [4, 8, 1]}]}}", False),
        ("{type: roughconductor, material: Au, alpha: 0.1}", True),
        ("{type: roughconductor, material: none, alpha: 0.1}", False),
        ("{type: blendbsdf, weight: 0.5, a: {type: diffuse}, b: {type: hair}}", True),
        ("{type: dielectric, int_ior: bk7, ext_ior: 1}", False),
    ],
)
def test_colour_is_found_wherever_it_is(bsdf: str, colored: bool) -> None:
    """Three channels are needed exactly when a BSDF differs between them, or may."""
    config = with_wall_bsdf(bsdf)
    assert config.scene.is_colored is colored
    assert config.is_colored is colored


def test_the_colour_setting_wins_over_the_scene() -> None:
    """render.color: grey and rgb do not ask the scene."""
    assert parse(SMALLEST + "render: {color: rgb}").is_colored is True
    red = SMALLEST.replace("height: 1.5", "height: 1.5, bsdf: {type: diffuse, reflectance: [1, 0, 0]}")
    assert parse(red + "render: {color: grey}").is_colored is False


def test_numbers_of_a_bsdf_are_floats() -> None:
    """Mitsuba refuses the integer 1 as an index of refraction."""
    assert isinstance(with_wall_bsdf("{type: dielectric, int_ior: 2}").scene.relay_wall.bsdf["int_ior"], float)


def test_a_config_cannot_be_changed() -> None:
    """Frozen all the way down: sections, tuples, BSDF dictionaries and what is nested in them."""
    config = with_wall_bsdf("{type: twosided, a: {type: diffuse, reflectance: [0.1, 0.2, 0.3]}}")
    bsdf = config.scene.relay_wall.bsdf
    with pytest.raises(ValueError, match="frozen"):
        config.name = "other"  # type: ignore[misc]
    with pytest.raises(ValueError, match="frozen"):
        config.capture.sensor_grid.nx = 4
    for change in (
        lambda: bsdf.update(a=1),
        lambda: bsdf["a"].__setitem__("reflectance", 1),
        lambda: bsdf.pop("a"),
        lambda: bsdf.__ior__({"b": 1}),
    ):
        with pytest.raises(TypeError, match="frozen"):
            change()
    assert isinstance(bsdf["a"]["reflectance"], tuple)
    assert hash(config) == hash(pickle.loads(pickle.dumps(config)))


def test_the_resolved_config_reads_back_as_itself() -> None:
    """config_to_dict holds every default as plain JSON, and a config made from it is the same one."""
    config = parse(SMALLEST.replace("1.5}", "1.5}, hidden_geometry: [{type: room, size: [1, 2, 3]}]"))
    resolved = config_to_dict(config)
    assert json.loads(json.dumps(resolved)) == resolved
    assert resolved["render"]["max_bounces"] == 7
    again = parse(yaml.safe_dump(resolved))
    assert again == config
    assert config_hash(again) == config_hash(config)


def test_the_hash_knows_values_not_writing() -> None:
    """Order of keys, comments, flow or block style, 2 or 2.0, and written-out defaults do not change the hash."""

    def reordered(value: Any) -> Any:
        return {key: reordered(value[key]) for key in reversed(value)} if isinstance(value, dict) else value

    plain = with_wall_bsdf("{type: roughplastic, alpha: 0.1, int_ior: 2}")
    reversed_text = yaml.safe_dump(reordered(config_to_dict(plain)), sort_keys=False)
    assert reversed_text.index("output") < reversed_text.index("scene")
    assert config_hash(parse(reversed_text)) == config_hash(plain)
    rewritten = parse(SMALLEST.replace("width: 2", "width: 2.0") + "# remark\nrender:\n  seed: 0\n")
    assert config_hash(rewritten) == config_hash(parse(SMALLEST))
    assert config_hash(parse(SMALLEST + "render: {seed: 1}")) != config_hash(parse(SMALLEST))
    assert len(config_hash(plain)) == 64


WALL_CAPTURE = """\
scene:
  relay_wall: {type: sphere, center: [0, 0, 1], radius: 2, width: 1.5, height: 1,
    bsdf: {type: diffuse, reflectance: 0.9}}
  hidden_geometry:
    - {type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9]}
    - {type: letters, text: Z 1, height: 8e-1, thickness: 0.1, center: [0, 0, 1], bsdf: {type: plastic, int_ior: bk7}}
    - {type: mitsuba, shape: {type: cube, to_world: [{scale: 0.2}, {rotate: {axis: [0, 1, 0], angle_deg: 90}}]}}
capture: {scan_type: exhaustive, sensor_grid: {nx: 5, ny: 3}, laser_grid: {nx: 2, ny: 7, width: 0.3}, laser_energy: 2}
time_axis: {start_opl: -0, n_bins: auto}
render: {max_bounces: null, spp: 16, memory_limit: 2GiB, seed: 3}
output: {path: "out/{name}.hdf5", frame: scene}
"""
CAMERA_CAPTURE = """\
scene:
  emitters:
    - {type: spot, position: [0, 1, 1], look_at: [0, 0, 0], intensity: [1, 0.5, 0.2], cutoff_deg: 30}
    - {type: box, center: [0, 2, 0], size: [1, 2, 3], radiance: 10}
  hidden_geometry: [{type: cylinder, center: [0, 0, 0], radius: 0.1, height: 1, inside: true}]
capture:
  scan_type: line_of_sight
  camera: {position: [0, 0, 4], look_at: [0, 0, 0], width: 5, height: 3}
render: {polarized: true, target_error: 0.1, time_limit_s: 60}
"""


@pytest.mark.parametrize(
    ("text", "known"),
    [
        (WALL_CAPTURE, "2787618d400ac2085beada084c895dce203477b0ca719957a6f90210535ac331"),
        (CAMERA_CAPTURE, "173a301cae6c2d69d261c603de7d59e23b5f1bc29cf4e426b0c43128dec460d3"),
    ],
)
def test_the_hash_of_a_config_stays(text: str, known: str) -> None:
    """Captures and datasets are resumed by it: a new key needs a default that is left out of the canonical JSON."""
    assert config_hash(parse(text)) == known
