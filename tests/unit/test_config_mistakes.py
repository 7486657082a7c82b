"""Every mistake in a config is told with its place, its key, the value found and what is allowed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from nlosrender.config.document import Config
from nlosrender.config.load import load_config, parse_config
from nlosrender.errors import ConfigError, ValidationIssue

BASE = """\
name: z
scene:
  relay_wall:
    type: rectangle
    width: 2.0
    height: 1.5
    bsdf: {type: diffuse, reflectance: 0.9}
  hidden_geometry:
    - {type: rectangle, width: 1.0, height: 0.5, center: [0, 0, 0.8]}
    - type: letters
      text: Z
      height: 0.8
      center: [0, 0, 1]
capture:
  scan_type: exhaustive
  sensor_grid: {nx: 3, ny: 5}
  laser_grid: {nx: 2, ny: 7}
  laser_position: [-0.5, 0, 0.25]
time_axis: {bin_width_opl: 0.003, n_bins: 64}
render:
  spp: 16
output: {path: z.hdf5}
"""
ITEM = "    - {type: rectangle, width: 1.0, height: 0.5, center: [0, 0, 0.8]}\n"
WALL_BSDF = "{type: diffuse, reflectance: 0.9}"
WALL = BASE[BASE.index("    type: rectangle") : BASE.index("  hidden_geometry")]
MARK = "§"  # stands before the character whose line and column the issue has to name


def item(text: str) -> tuple[str, str]:
    """Replace the first hidden item."""
    return ITEM, f"    - {text}\n"


def bsdf(text: str) -> tuple[str, str]:
    """Replace the wall's BSDF."""
    return WALL_BSDF, text


# (old text, new text with the mark, key, what the message has to match)
MISTAKES = [
    # numbers
    ("nx: 3", "nx: §0", "capture.sensor_grid.nx", r"got 0, need an integer >= 1\..*scan_type: single"),
    ("nx: 3", "nx: §3.5", "capture.sensor_grid.nx", r"got 3\.5, need an integer >= 1"),
    ("nx: 3", "nx: §true", "capture.sensor_grid.nx", r"got true, need an integer"),
    ("nx: 3", 'nx: §"3"', "capture.sensor_grid.nx", r"got '3' \(text\), need an integer.*without quotes"),
    ("nx: 3", "nx: §1_0", "capture.sensor_grid.nx", r"got '1_0' \(text\), need an integer.*without underscores"),
    ("nx: 3", "nx: §3e0", "capture.sensor_grid.nx", r"got 3, need an integer.*Write 3, without point and exponent"),
    ("ny: 5", "ny: §[5]", "capture.sensor_grid.ny", r"got \[5\], need an integer"),
    ("width: 2.0", "width: §-1", "scene.relay_wall.width", r"got -1, need a number > 0"),
    ("width: 2.0", "width: §true", "scene.relay_wall.width", r"got true, need a number > 0"),
    ("width: 2.0", "width: §.inf", "scene.relay_wall.width", r"got \.inf, need a finite number"),
    ("width: 2.0", "width: §.nan", "scene.relay_wall.width", r"got \.nan, need a finite number"),
    ("width: 2.0", "width: §1e999", "scene.relay_wall.width", r"got 1e999, need a finite number"),
    ("width: 2.0", "width:§ ", "scene.relay_wall.width", r"got nothing \(null\), need a number > 0"),
    ("width: 2.0", "width: §12:30", "scene.relay_wall.width", r"got '12:30' \(text\), need a number"),
    ("n_bins: 64", "n_bins: §0", "time_axis.n_bins", r"got 0, need auto or an integer >= 1"),
    ("n_bins: 64", "n_bins: §many", "time_axis.n_bins", r"got 'many' \(text\), need auto or an integer"),
    ("n_bins: 64", "n_bins: §" + "9" * 5000, "time_axis.n_bins", r"integer of 5000 digits"),
    ("bin_width_opl: 0.003", "bin_width_opl: §0", "time_axis.bin_width_opl", r"got 0, need a number > 0"),
    ("spp: 16", "spp: §0", "render.spp", r"got 0, need an integer >= 1"),
    ("spp: 16", "target_error: §1.0", "render.target_error", r"got 1, need a number between 0 and 1"),
    ("spp: 16", "time_limit_s: §0", "render.time_limit_s", r"got 0, need a number > 0"),
    ("spp: 16", "max_bounces: §1", "render.max_bounces", r"got 1, need an integer >= 2 or null"),
    ("spp: 16", "seed: §4294967296", "render.seed", r"got 4294967296, need an integer from 0 to 4294967295"),
    ("spp: 16", "seed: §-1", "render.seed", r"got -1, need an integer from 0"),
    ("spp: 16", "memory_limit: §8", "render.memory_limit", r'got 8, need auto or a size.*"8GB"'),
    ("spp: 16", "memory_limit: §8 XB", "render.memory_limit", r"got '8 XB' \(text\), need auto or a size"),
    ("spp: 16", "split_bounces: §yes", "render.split_bounces", r"got 'yes' \(text\), need true or false"),
    ("[-0.5, 0, 0.25]", "§[-0.5, 0]", "capture.laser_position", r"got \[-0\.5, 0\], need 3 finite numbers"),
    ("[-0.5, 0, 0.25]", "§[a, 0, 1]", "capture.laser_position", r"got \['a', 0, 1\], need 3 finite numbers"),
    ("[-0.5, 0, 0.25]", "§1.0", "capture.laser_position", r"got 1, need 3 finite numbers"),
    # names, keys, types
    ("scan_type: exhaustive", "scan_type: §confocl", "capture.scan_type", r"one of single, confocal.*mean confocal\?"),
    (
        "type: rectangle\n",
        "type: §rectangel\n",
        "scene.relay_wall.type",
        r"rectangle, sphere, cylinder.*mean rectangle",
    ),
    ("type: rectangle\n", "type: §torus\n", "scene.relay_wall.type", r"got 'torus' \(text\), need one of rectangle"),
    ("    type: rectangle\n", "", "scene.relay_wall.type", r"missing, need one of rectangle, sphere, cylinder"),
    ("spp: 16", "engine: §virtual_light", "render.engine", r"one of auto, path, virtual_lights.*virtual_lights"),
    ("spp: 16", "engine: §paht", "render.engine", r"one of auto, path.*mean path\?"),
    ("spp: 16", "backend: §gpu", "render.backend", r"got 'gpu' \(text\), need one of auto, llvm, cuda"),
    ("spp: 16", "color: §red", "render.color", r"need one of auto, grey, rgb"),
    ("path: z.hdf5", "format: §hdf5", "output.format", r"got 'hdf5' \(text\), need znlos"),
    ("path: z.hdf5", "compression: §null", "output.compression", r"got nothing \(null\), need one of gzip, none"),
    ("path: z.hdf5", "path: §''", "output.path", r"got '' \(text\), need the name of the file"),
    ("path: z.hdf5", "path: §out/", "output.path", r"name of a file, not of a folder"),
    ("name: z", "name: §42", "name", r"got 42, need text\. Put it in quotes"),
    ("name: z", "name: §a/b", "name", r"got 'a/b' \(text\), need a name without slashes"),
    ("nx: 3", "§nxx: 3, nx: 3", "capture.sensor_grid.nxx", r"unknown key\. Did you mean nx\?"),
    ("render:", "§rendre: {}\nrender:", "rendre", r"unknown key\. Did you mean render\?"),
    ("ny: 5", "ny: 5, §spp: 3", "capture.sensor_grid.spp", r"unknown key, known here: nx, ny.*belongs in render"),
    ("scene:\n", "scene:\n  mitsuba: §a.xml\n", "scene.mitsuba", r"got a\.xml, but there is no file at"),
    ("nx: 3, ", "", "capture.sensor_grid.nx", r"missing, it is required: points along the wall's x axis"),
    ("    height: 1.5\n", "", "scene.relay_wall.height", r"missing, it is required: m, along"),
    ("output: {path: z.hdf5}", "output: §[z]", "output", r"got \['z'\], need a mapping"),
    # hidden items
    (*item("{type: §shpere, radius: 1, center: [0, 0, 1]}"), "scene.hidden_geometry.0.type", r"mean sphere\?"),
    (*item("§{type: sphere, center: [0, 0, 1]}"), "scene.hidden_geometry.0.radius", r"missing, it is required: m"),
    (*item("§sphere"), "scene.hidden_geometry.0", r"got 'sphere' \(text\), need a mapping"),
    (*item("{type: box, center: [0, 0, 1], size: §[1, 0, 2]}"), "scene.hidden_geometry.0.size", r"3 numbers > 0"),
    (*item("{type: mesh, filename: §bunny.fbx}"), "scene.hidden_geometry.0.filename", r"need the name of a \.ply, "),
    (*item("{type: mesh, filename: §bunny.ply}"), "scene.hidden_geometry.0.filename", r"there is no file at /.*bunny"),
    (*item("{type: mesh, filename: §folder.ply}"), "scene.hidden_geometry.0.filename", r"there is a folder at /"),
    (*item("{type: mesh, filename: §quad.plyy}"), "scene.hidden_geometry.0.filename", r"\.off or \.glb file"),
    (*item("{type: mesh, filename: §quda.ply}"), "scene.hidden_geometry.0.filename", r"Did you mean quad\.ply\?"),
    ("text: Z", "text: §z9", "scene.hidden_geometry.1.text", r"got 'z9' \(text\), need A-Z, 0-9.*upper case: Z9"),
    ("text: Z", "text: §'A!'", "scene.hidden_geometry.1.text", r"got 'A!' \(text\), need A-Z"),
    ("text: Z", "text: §' '", "scene.hidden_geometry.1.text", r"at least one of them visible"),
    ("text: Z", "text: §42", "scene.hidden_geometry.1.text", r"got 42, need A-Z.*quotes"),
    (
        "height: 0.8",
        "height: 0.8\n      stroke_width: §0.4",
        "scene.hidden_geometry.1.stroke_width",
        r"half the height",
    ),
    ("text: Z", "text: Z\n      up: §[0, 0, 2]", "scene.hidden_geometry.1.up", r"\[0, 0, 2\] is parallel to normal"),
    (
        "text: Z",
        "text: Z\n      normal: §[0, 0, 0]",
        "scene.hidden_geometry.1.normal",
        r"got \[0, 0, 0\].*not all zero",
    ),
    ("text: Z", "text: Z\n      name: §rectangle-0", "scene.hidden_geometry.1.name", r"the name of hidden_geometry\.0"),
    (
        *item("{type: mitsuba, shape: {type: §torus}}"),
        "scene.hidden_geometry.0.shape.type",
        r"got 'torus' \(text\), need one of .*sphere",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, to_world: §[1, 2]}}"),
        "scene.hidden_geometry.0.shape.to_world",
        r"got \[1, 2\], need 4 rows of 4 finite numbers, or a list of translate",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, to_world: [{scale: §0}]}}"),
        "scene.hidden_geometry.0.shape.to_world.0.scale",
        r"got 0, need a number or \[x, y, z\], none of them 0",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, to_world: [{scale: 2}, §{turn: 3}]}}"),
        "scene.hidden_geometry.0.shape.to_world.1",
        r"a mapping with turn, need exactly one of translate",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, to_world: [{rotate: {axis: §[0, 0, 0], angle_deg: 3}}]}}"),
        "scene.hidden_geometry.0.shape.to_world.0.rotate.axis",
        r"got \[0, 0, 0\], need 3 finite numbers",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, to_world: §[[1,0,0,0],[0,0,0,0],[0,0,1,0],[0,0,0,1]]}}"),
        "scene.hidden_geometry.0.shape.to_world",
        r"singular",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, §bsdf: {type: diffuse}}}"),
        "scene.hidden_geometry.0.shape.bsdf",
        r"belongs beside shape",
    ),
    (
        *item("{type: mitsuba, shape: {type: disk, light: §{type: area}}}"),
        "scene.hidden_geometry.0.shape.light",
        r"Emitters and sensors cannot be part of a shape",
    ),
    # BSDFs
    (*bsdf("{type: §difuse}"), "scene.relay_wall.bsdf.type", r"got 'difuse'.*Did you mean diffuse\?"),
    (*bsdf("{reflectance: 1}"), "scene.relay_wall.bsdf.type", r"missing, need the Mitsuba BSDF: one of"),
    (*bsdf("§0.5"), "scene.relay_wall.bsdf", r"got 0\.5, need a mapping with a type"),
    (
        *bsdf("{type: diffuse, reflectance: §1.2}"),
        "scene.relay_wall.bsdf.reflectance",
        r"got 1\.2, need .* from 0 to 1",
    ),
    (*bsdf("{type: diffuse, reflectance: §[1, 2, 0]}"), "scene.relay_wall.bsdf.reflectance", r"got \[1, 2, 0\], need"),
    (*bsdf("{type: diffuse, reflectance: §true}"), "scene.relay_wall.bsdf.reflectance", r"got true, need a number"),
    (*bsdf("{type: diffuse, §reflectence: 1}"), "scene.relay_wall.bsdf.reflectence", r"Did you mean reflectance\?"),
    (
        *bsdf("{type: blendbsdf, a: {type: diffuse}, b: {type: diffuse}}"),
        "scene.relay_wall.bsdf.weight",
        r"missing, the blendbsdf BSDF needs it",
    ),
    (*bsdf("{type: twosided, a: {type: §dielectric}}"), "scene.relay_wall.bsdf.a.type", r"lets light through"),
    (*bsdf("{type: mask, opacity: 0.5}"), "scene.relay_wall.bsdf", r"got 0 nested BSDFs, need 1 in a mask"),
    (
        *bsdf("{type: diffuse, reflectance: {type: bitmap, filename: §no.png}}"),
        "scene.relay_wall.bsdf.reflectance.filename",
        r"there is no file at /.*no\.png",
    ),
    (*bsdf("{type: diffuse, §reflectance: {type: bitmap}}"), "scene.relay_wall.bsdf.reflectance.filename", r"missing"),
    (
        *bsdf("{type: diffuse, reflectance: {type: rgb, value: §[0, 1, 2]}}"),
        "scene.relay_wall.bsdf.reflectance.value",
        r"need \[r, g, b\] with each from 0 to 1",
    ),
    (*bsdf("{type: roughconductor, §alpha_u: 0.1}"), "scene.relay_wall.bsdf.alpha_u", r"needs alpha_v beside it"),
    (*bsdf("{type: plastic, int_ior: §0}"), "scene.relay_wall.bsdf.int_ior", r"got 0, need a number > 0 or the name"),
    (*bsdf("{type: retroreflector, width: §-1, albedo: 1}"), "scene.relay_wall.bsdf.width", r"need .* 0\.01 to 60"),
    (*bsdf("{type: retroreflector, width: 1}"), "scene.relay_wall.bsdf.albedo", r"missing"),
    (*bsdf("{type: retroreflector, width: 1, albedo: §1.2}"), "scene.relay_wall.bsdf.albedo", r"got 1\.2, need"),
    (
        *bsdf("{type: retroreflector, width: 1, albedo: [0, 0.8, 0], diffuse: §0.3}"),
        "scene.relay_wall.bsdf.diffuse",
        r"got 0\.3 beside albedo \[0, 0\.8, 0\], need a sum of at most 1",
    ),
    (*bsdf("{type: conductor, §material: Au, k: 1}"), "scene.relay_wall.bsdf.material", r"exclude each other"),
    # rules over several keys
    ("  laser_grid: {nx: 2, ny: 7}\n", "", "capture.laser_grid", r"missing, an exhaustive scan needs it"),
    (
        "exhaustive\n  sensor_grid: {nx: 3, ny: 5}\n  laser_grid: {nx: 2, ny: 7}\n",
        "single\n  sensor_grid: {nx: 3, ny: 5}\n  laser_point: §[0, 0.76]\n",
        "capture.laser_point",
        r"got \[0, 0\.76\], off the relay wall; need x from -1 to 1 m and y from -0\.75 to 0\.75 m",
    ),
    ("ny: 5", "ny: 5, width: §2.1", "capture.sensor_grid.width", r"got 2\.1 m, need at most 2 m"),
    ("ny: 7", "ny: 7, height: §1.6", "capture.laser_grid.height", r"got 1\.6 m, need at most 1\.5 m, the height of"),
    ("[-0.5, 0, 0.25]", "§[0, 0, -0.5]", "capture.laser_position", r"0\.5 m behind the relay wall"),
    (
        "  laser_pos",
        "  sensor_position: §[1, 1, 0]\n  laser_pos",
        "capture.sensor_position",
        r"in the plane of the relay",
    ),
    ("spp: 16", "spp: 16\n  §target_error: 0.1", "render.target_error", r"got 0\.1 beside spp 16; they exclude"),
    ("spp: 16", "laser_sampling: §false", "render.laser_sampling", r"need capture\.laser_spot_radius > 0"),
    (
        "n_bins: 64",
        "n_bins: §9999999999",
        "time_axis.n_bins",
        r"210 pairs .*9_999_999_999 bins each, need at most 2\*\*40",
    ),
    ("up: ", "", "", r""),
    (
        WALL,
        "    {type: sphere, radius: 1}\n",
        "capture.laser_spot_radius",
        r"got 0\.1 on a sphere wall; need 0 there",
    ),
    (WALL, "    {type: sphere, radius: 1, width: §7, height: 2}\n", "scene.relay_wall.width", r"at most 6\.28319 m"),
    (WALL, "    {type: cylinder, radius: 1, height: 2, axis: §[0, 0, 0]}\n", "scene.relay_wall.axis", r"not all zero"),
    # the text itself
    ("spp: 16", "spp: 16\n  §spp: 32", "render.spp", r"appears twice, first at z\.yaml:21:3; keep one"),
    ("spp: 16", "spp: §!!python/object/apply:os.system [ls]", "render.spp", r"tag !!python/.* is not allowed"),
    ("spp: 16", "spp: §!!int x", "render.spp", r"got 'x' \(text\) with the tag !!int, need a number"),
    ("spp: 16", "§3: 16", "render", r"got '3' \(text\) as a key, need text"),
    ("spp: 16", "spp: [16]§]", "", r"not usable as YAML: something stands behind a finished value"),
    ("spp: 16", "spp: [16", "", r"not usable as YAML: .*not closed; add , or \]"),
    ("  spp: 16", "§\tspp: 16", "", r"not usable as YAML: .*indent with spaces"),
    ("spp: 16", "spp: §*none", "", r"not usable as YAML: nothing above is marked &none"),
    ("spp: 16", "spp: 16§\x07", "", r"character U\+0007 may not stand in YAML"),
    ("name: z", "name: z\n---\nname: y", "", r"not usable as YAML: there is a second document"),
    (
        "    height: 1.5",
        "   §height: 1.5",
        "",
        r"not usable as YAML: the indentation does not fit the lines above.*line \d+",
    ),
    ("name: z", "name: z§: y", "", r"not usable as YAML: a second colon in one line.*put the text in quotes"),
    ("name: z", "name: §'z", "", r"not usable as YAML: a quoted text is not closed"),
    ("name: z", "name: §@z", "", r"not usable as YAML: a value cannot begin with @; put the text in quotes"),
]
MISTAKES = [mistake for mistake in MISTAKES if mistake[0] != "up: "]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a mesh, and a folder that is called like one."""
    (tmp_path / "quad.ply").write_text("ply\n")
    (tmp_path / "folder.ply").mkdir()
    return tmp_path


def issues_of(text: str, folder: Path, overrides: tuple[str, ...] = ()) -> tuple[ValidationIssue, ...]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "z.yaml", folder, overrides)
    assert caught.value.exit_code == 3
    return caught.value.issues


def test_the_base_is_sound(folder: Path) -> None:
    """Without a mistake the table's config is valid, so each case fails by its own mistake alone."""
    assert isinstance(parse_config(BASE, "z.yaml", folder), Config)


@pytest.mark.parametrize(("old", "new", "key", "message"), MISTAKES)
def test_one_mistake_is_told_once_with_place_key_and_reason(
    old: str, new: str, key: str, message: str, folder: Path
) -> None:
    """One mistake gives one issue: its line and column, its key, the value found and what is allowed."""
    assert BASE.count(old) >= 1
    marked = BASE.replace(old, new, 1)
    if key == "capture.laser_spot_radius":
        marked = marked.replace("capture:\n", "capture:\n  laser_spot_radius: §0.1\n")
    (issue,) = issues_of(marked.replace(MARK, ""), folder)
    assert issue.key == key
    assert re.search(message, issue.message, re.IGNORECASE), issue.message
    if MARK in marked:
        before = marked[: marked.index(MARK)]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        assert issue.place == f"z.yaml:{line}:{column}"


def test_the_table_is_long_enough() -> None:
    """The table covers at least 60 kinds of mistake."""
    assert len(MISTAKES) >= 60


@pytest.mark.parametrize(
    ("removed", "place", "key"),
    [
        ("    height: 1.5\n", "z.yaml:3:3", "scene.relay_wall.height"),
        ("  sensor_grid: {nx: 3, ny: 5}\n", "z.yaml:14:1", "capture.sensor_grid"),
        ("  scan_type: exhaustive\n", "z.yaml:14:1", "capture.scan_type"),
        ("      height: 0.8\n", "z.yaml:10:7", "scene.hidden_geometry.1.height"),
    ],
)
def test_a_missing_key_is_placed_at_its_mapping(removed: str, place: str, key: str, folder: Path) -> None:
    """A key that is not there is told at the key (or list item) that holds the mapping it belongs in."""
    (issue,) = issues_of(BASE.replace(removed, ""), folder)
    assert (issue.place, issue.key) == (place, key)


def test_all_mistakes_come_at_once_in_reading_order(folder: Path) -> None:
    """Mistakes of syntax, type, value and combination are all told in one run, from top to bottom."""
    edits = {
        "width: 2.0": "width: 2.0\n    widht: 3",  # unknown key
        "reflectance: 0.9": "reflectance: 9",  # range, in a plugin dictionary
        "text: Z": "text: z",
        "nx: 3, ny: 5": "nx: 3, ny: 5, width: 2.5",  # combination over sections
        "nx: 2, ny: 7": "nx: 0, ny: 7",
        "[-0.5, 0, 0.25]": "[-0.5, 0, -0.25]",  # combination over sections
        "n_bins: 64": "n_bins: 6.4",
        "spp: 16": "spp: 16\n  spp: 17\n  target_error: 0.1",  # duplicate and combination
        "path: z.hdf5": "path: .nan",
    }
    text = BASE
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new, 1)
    issues = issues_of(text, folder)
    assert [issue.key for issue in issues] == [
        "scene.relay_wall.widht",
        "scene.relay_wall.bsdf.reflectance",
        "scene.hidden_geometry.1.text",
        "capture.sensor_grid.width",
        "capture.laser_grid.nx",
        "capture.laser_position",
        "time_axis.n_bins",
        "render.spp",
        "render.target_error",
        "output.path",
    ]
    lines = [int(issue.place.split(":")[1]) for issue in issues]
    assert lines == sorted(lines)


def test_a_wrong_value_gives_no_second_complaint_by_a_rule_that_reads_it(folder: Path) -> None:
    """A broken wall size says nothing about the grids on it."""
    text = BASE.replace("width: 2.0", "width: wide").replace("nx: 3, ny: 5", "nx: 3, ny: 5, width: 500")
    (issue,) = issues_of(text, folder)
    assert issue.key == "scene.relay_wall.width"


def test_one_wrong_item_hides_no_mistake_of_the_others(folder: Path) -> None:
    """Items without a known type, and keys that are unknown, leave the rules between the others in force."""
    text = BASE.replace(ITEM, ITEM + "    - {type: shpere}\n    - {type: room, size: [1, 1, 1], name: letters-3}\n")
    text = text.replace(WALL, "    {type: cylinder, radius: 1, height: 1, widht: 2}\n")
    text = text.replace("nx: 3", "nx: 3, height: 2")
    assert [issue.key for issue in issues_of(text, folder)] == [
        "scene.relay_wall.widht",
        "scene.hidden_geometry.1.type",
        "scene.hidden_geometry.2.type",
        "scene.hidden_geometry.3.name",
        "capture.sensor_grid.height",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "the file is empty"), ("# only a comment\n", "the file is empty"), ("- a\n", r"got \['a'\], need a mapping")],
)
def test_a_file_that_is_no_mapping_is_refused(text: str, message: str, folder: Path) -> None:
    """The root of a config is a mapping, and an empty file says which keys it needs."""
    (issue,) = issues_of(text, folder)
    assert re.search(message, issue.message)
    assert "scene, capture" in issue.message


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("no.yaml", None, "there is no such file. nlosrender new"),
        ("latin.yaml", b"name: caf\xe9\n", "no UTF-8 text: byte 0xe9 at offset 9"),
        ("utf16.yaml", "name: z\n".encode("utf-16"), "no UTF-8 text: byte 0xff at offset 0"),
        ("big.yaml", b"#" * (2**20 + 1), "larger than 1024 KiB"),
        ("binary.yaml", b"\x89HDF\r\n\x1a\n" + bytes(50), "no UTF-8 text"),
        ("zeros.yaml", bytes(50), r"character U\+0000 may not stand in YAML"),
        (".", None, "this is a folder, need a YAML file"),
        ("a\0b", None, "cannot be read"),
        ("x" * 3000, None, "cannot be read"),
    ],
)
def test_a_file_that_cannot_be_read_is_explained(
    name: str, content: bytes | None, message: str, tmp_path: Path
) -> None:
    """A missing, unreadable, foreign or huge file is one issue, never a traceback."""
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(path)
    assert len(caught.value.issues) == 1
