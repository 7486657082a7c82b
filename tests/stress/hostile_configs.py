"""Hypothesis strategies for configurations that someone damaged: in structure, type, size, or as text."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import yaml
from hypothesis import strategies as st

PLATE = {"type": "rectangle", "width": 0.6, "height": 0.4, "center": [0.1, 0.0, 0.9]}
ITEMS: tuple[dict[str, Any], ...] = (
    PLATE,
    {"type": "letters", "text": "Z", "height": 0.5, "thickness": 0.02, "center": [0, 0, 1]},
    {"type": "box", "center": [0, 0, 1], "size": [0.3, 0.2, 0.1], "rotate_deg": [0, 20, 30]},
    {"type": "sphere", "center": [0, 0, 1], "radius": 0.3, "inside": False},
    {"type": "cylinder", "center": [0, 0, 1], "axis": [0, 1, 0], "radius": 0.1, "height": 0.5},
    {"type": "room", "size": [2.5, 2.5, 2.0]},
    {"type": "mitsuba", "shape": {"type": "disk", "to_world": [{"scale": 0.3}, {"translate": [0, 0, 1]}]}},
    {"type": "mitsuba", "shape": {"type": "cylinder", "p0": [0, 0, 1], "p1": [0, 0.2, 1], "radius": 0.1}},
    {"type": "mitsuba", "shape": {"type": "sphere", "center": [0, 0, 1], "radius": 0.1}},
)
BSDFS: tuple[dict[str, Any], ...] = (
    {"type": "diffuse", "reflectance": 0.7},
    {"type": "diffuse", "reflectance": [0.1, 0.5, 0.9]},
    {"type": "twosided", "inner": {"type": "diffuse", "reflectance": 0.5}},
    {"type": "roughconductor", "alpha": 0.2, "distribution": "ggx"},
    {"type": "plastic", "diffuse_reflectance": 0.5, "int_ior": 1.5},
    {"type": "principled", "base_color": 0.5, "roughness": 0.4, "metallic": 0.2},
    {"type": "retroreflector", "width": 0.5, "albedo": 0.6, "diffuse": 0.3},
    {"type": "mask", "opacity": 0.5, "inner": {"type": "diffuse"}},
    {"type": "blendbsdf", "weight": 0.3, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
    {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": [{"scale": 4}]}},
    {"type": "dielectric", "int_ior": 1.5},
)
WALLS: tuple[dict[str, Any], ...] = (
    {"type": "rectangle", "width": 2.0, "height": 1.6},
    {"type": "sphere", "radius": 1.5, "width": 1.0, "height": 1.0},
    {"type": "cylinder", "radius": 1.0, "height": 1.5},
)
MILD_NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.5, 2, 3, 17, 1e-3, 1e-6, 1e-8, 1e3, 1e5, 1e8])
_TINY_OR_HUGE = [1e-9, 1e-12, 1e-38, 1e-45, 5e-324, 1e9, 1e12, 1e30, 3.5e38, 1e39, 1e308, -1e308]
_WIDE_INTEGERS = [2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**64, 10**30, 10**80]
NUMBERS = st.sampled_from([0, -0.0, -1, *_TINY_OR_HUGE, *_WIDE_INTEGERS, float("inf"), float("nan")])
TEXTS = st.one_of(
    st.sampled_from(
        ["", " ", "auto", "null", "1e3", "..", "/", "/etc/passwd", "~", "%s", "{x}", "\u202e", "Ä", "💡" * 30]
    ),
    st.text(max_size=20),
)
VALUES = st.recursive(
    st.one_of(NUMBERS, TEXTS, st.none(), st.booleans(), st.floats(), st.integers()),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=6,
)
_BOMB = ["b: &b [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", *(f"b{i}: &b [*b, *b, *b, *b, *b, *b, *b, *b]" for i in range(9))]
LINES = st.sampled_from(
    (
        "x: !!python/object/apply:os.system ['exit 99']",
        "x: !!python/name:os.system",
        "? [a, b]\n: 1",
        "? \n: 1",
        "x: &x [*x]",
        "x: {<<: *y}",
        "&a a: *a",
        "scene: 1",
        "---\nx: 1",
        "%YAML 9.9",
        "x: " + "[" * 40 + "]" * 40,
        "\t- x",
        "x: 'y",
        "\n".join(_BOMB),
        "x: " + "9" * 5000,
        "x: " + "a" * 5000,
        "x: 0x" + "f" * 200,
        "'\\ud800': 1",
        "x: \x07",
        "x: \u2028",
    )
)


@st.composite
def sound_configs(draw: st.DrawFn) -> dict[str, Any]:
    """Return a small configuration that renders in a second or less."""
    scan = draw(st.sampled_from(["single", "confocal", "exhaustive"]))
    hidden = [copy.deepcopy(item) for item in draw(st.lists(st.sampled_from(ITEMS), max_size=3))]
    for item in hidden:
        item["bsdf"] = copy.deepcopy(draw(st.sampled_from(BSDFS)))
    wall = copy.deepcopy(draw(st.sampled_from(WALLS)))
    wall["bsdf"] = copy.deepcopy(draw(st.sampled_from(BSDFS[:4])))
    capture: dict[str, Any] = {"scan_type": scan, "sensor_grid": {"nx": 3, "ny": 2}, "sensor_position": [0.1, 0, 0.5]}
    if scan == "exhaustive":
        capture["laser_grid"] = {"nx": 2, "ny": 2, "width": 0.4, "height": 0.4}
    if scan == "single":
        capture["laser_point"] = [0.1, -0.2]
    return {
        "scene": {"relay_wall": wall, "hidden_geometry": hidden},
        "capture": capture,
        "time_axis": {"start_opl": 0.0, "bin_width_opl": 0.05, "n_bins": draw(st.sampled_from([64, 1, "auto"]))},
        "render": {
            "engine": draw(st.sampled_from(["auto", "path", "virtual_lights"])),
            "max_bounces": draw(st.sampled_from([3, 4, None])),
            "time_limit_s": 0.1,
        },
        "output": {"compression": "none"},
    }


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _places(tree: Any, path: tuple = ()) -> list[tuple]:
    """Return the path of every value in a tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place for key, value in items for place in ((*path, key), *_places(value, (*path, key)))]


def _at(tree: Any, path: Sequence[Any]) -> Any:
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def damaged_configs(draw: st.DrawFn) -> str:
    """Return the text of a configuration with one to three values, keys or lines that someone damaged."""
    config = draw(sound_configs())
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        places = _places(config)
        if draw(st.booleans()):  # numbers are few among all values
            places = [place for place in places if _is_number(_at(config, place))] or places
        *path, last = draw(st.sampled_from(places))
        container = _at(config, path)
        if _is_number(container[last]) and draw(st.integers(0, 3)):
            container[last] = draw(MILD_NUMBERS)  # a number for a number: what passes the rules, and is odd
            continue
        match draw(st.sampled_from(["replace", "number", "delete", "rename", "repeat", "move"])):
            case "replace":
                container[last] = draw(VALUES)
            case "number":
                container[last] = draw(NUMBERS)
            case "delete":
                del container[last]
            case "rename" if isinstance(container, dict):
                container[draw(TEXTS)] = container.pop(last)
            case "repeat" if isinstance(container, list):
                container *= draw(st.integers(0, 30))
            case _:
                container[last] = copy.deepcopy(config)
        if not _places(config):
            break
    text = yaml.safe_dump(config, allow_unicode=draw(st.booleans()), default_flow_style=draw(st.booleans()))
    for _ in range(draw(st.sampled_from([0, 0, 0, 0, 1]))):
        at = draw(st.integers(0, len(text)))
        text = draw(st.sampled_from([f"{text}\n{draw(LINES)}\n", f"{draw(LINES)}\n{text}", text[:at], text[at:]]))
    return text
