"""Configurations for the reference renderer: the plain kinds of items, read from the YAML by code of its own.

What it cannot say in its own terms it refuses with ``Unsupported``, so that a comparison never passes by leaving
something out. Everything stays in scene coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike
from PIL import Image
from reference.meshes import Unsupported, read_mesh
from reference.renderer import Array, Reference, Scene, WallPoint, Window, render

LAST_SLOT = 6  # bounces 2 to 7 have an index of their own, later ones share the last
INDEX = {"air": 1.000277, "bk7": 1.5046, "vacuum": 1.0, "water": 1.333, "polypropylene": 1.49, "diamond": 2.419}


@dataclass(frozen=True)
class Task:
    """A capture as the reference renders it."""

    scene: Scene
    pairs: list[tuple[WallPoint, WallPoint]]
    window: Window
    legs: bool
    energy: float
    spot_radius: float

    def render(self, samples: int, **options: Any) -> Reference:
        """Render every pair with ``samples`` paths."""
        fixed = {"legs": self.legs, "energy": self.energy, "spot_radius": self.spot_radius}
        return render(self.scene, self.pairs, self.window, samples, **fixed, **options)


def load_task(path: Path) -> Task:
    """Read a YAML file."""
    return as_task(yaml.safe_load(path.read_text()), path.parent)


def as_task(config: Mapping[str, Any], folder: Path = Path()) -> Task:
    """Turn a configuration into a task; pairs run as ``(laser_y, laser_x, sensor_y, sensor_x)``."""
    scene, wall = Scene(), config["scene"]["relay_wall"]
    if wall["type"] != "rectangle":
        raise Unsupported(f"a relay wall that is a {wall['type']}")
    center, axes = np.array(wall.get("center", (0, 0, 0)), float), _axes(wall, (0, 0, 1))
    _rectangle(scene, wall, center, axes, _material(scene, wall.get("bsdf"), folder), hidden=False)
    for item in config["scene"].get("hidden_geometry") or []:
        _add_item(scene, item, folder, center, axes)
    capture = config["capture"]
    devices = [
        np.array(capture[key], float) if key in capture else center + axes[2]
        for key in ("sensor_position", "laser_position")
    ]

    def points(grid: Mapping[str, Any], device: Array) -> list[WallPoint]:
        size = [grid.get("width", wall["width"]), grid.get("height", wall["height"])]
        return [
            _wall_point(
                center, axes, ((i + 0.5) / grid["nx"] - 0.5) * size[0], ((j + 0.5) / grid["ny"] - 0.5) * size[1], device
            )
            for j in range(grid["ny"])
            for i in range(grid["nx"])
        ]

    sensors = points(capture["sensor_grid"], devices[0])
    if capture["scan_type"] == "confocal":
        pairs = list(zip(sensors, points(capture["sensor_grid"], devices[1]), strict=True))
    elif capture["scan_type"] == "exhaustive":
        pairs = [(sensor, laser) for laser in points(capture["laser_grid"], devices[1]) for sensor in sensors]
    elif capture["scan_type"] == "single":
        laser = _wall_point(center, axes, *capture.get("laser_point", (0.0, 0.0)), devices[1])
        pairs = [(sensor, laser) for sensor in sensors]
    else:
        raise Unsupported(f"scan type {capture['scan_type']}")
    axis, highest = config["time_axis"], config.get("render", {}).get("max_bounces", 7)
    if not isinstance(axis["n_bins"], int):
        raise Unsupported("n_bins: auto")
    slots = LAST_SLOT if highest is None else min(highest - 1, LAST_SLOT)
    window = Window(
        float(axis["start_opl"]),
        float(axis["bin_width_opl"]),
        axis["n_bins"],
        10_000 if highest is None else highest,
        slots,
    )
    legs = capture.get("account_first_and_last_bounces", True)
    return Task(scene, pairs, window, legs, capture.get("laser_energy", 1.0), capture.get("laser_spot_radius", 0.0))


def _wall_point(center: Array, axes: Array, x: float, y: float, device: Array) -> WallPoint:
    return WallPoint(center + x * axes[0] + y * axes[1], 0, device)


def _axes(item: Mapping[str, Any], normal: ArrayLike) -> Array:
    """Rows: x, y and normal of a posed item; up is made perpendicular to the normal, x = up x normal."""
    n = _unit(item.get("normal", normal))
    up = np.asarray(item.get("up", (0, 1, 0)), float)
    y = _unit(up - up.dot(n) * n)
    return np.array([np.cross(y, n), y, n])


def _unit(vector: ArrayLike) -> Array:
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


def rotation(degrees: ArrayLike) -> Array:
    """Rotation about x, then y, then z."""
    result = np.eye(3)
    for axis, angle in enumerate(np.radians(np.asarray(degrees, float))):
        turn, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
        sign = -1 if axis == 1 else 1
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[i, j], turn[j, i] = -sign * math.sin(angle), sign * math.sin(angle)
        result = turn @ result
    return result


def _rectangle(
    scene: Scene, item: Mapping[str, Any], center: Array, axes: Array, material: int, hidden: bool = True
) -> None:
    x, y = axes[0] * item["width"] / 2, axes[1] * item["height"] / 2
    _quad(scene, [center - x - y, center + x - y, center + x + y, center - x + y], material, hidden)


def _quad(scene: Scene, corners: ArrayLike, material: int, hidden: bool = True) -> None:
    p, uv = np.asarray(corners, float), np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for face in ([0, 1, 2], [0, 2, 3]):
        scene.triangle(p[face], material, uvs=uv[face], hidden=hidden)


def _add_item(scene: Scene, item: Mapping[str, Any], folder: Path, origin: Array, wall: Array) -> None:
    kind, material = item["type"], _material(scene, item.get("bsdf"), folder)
    if kind == "rectangle":
        _rectangle(scene, item, np.array(item["center"], float), _axes(item, (0, 0, -1)), material)
    elif kind == "box":
        for corners in _box_sides():
            _quad(
                scene,
                (corners * item["size"]) @ rotation(item.get("rotate_deg", (0, 0, 0))).T + item["center"],
                material,
            )
    elif kind == "room":
        for corners in _box_sides():
            if corners[:, 2].max() > -0.5 + 1e-9:  # all but the side on the wall, seen from within
                _quad(scene, ((corners + np.array([0, 0, 0.5])) * item["size"])[::-1] @ wall + origin, material)
    elif kind == "sphere":
        if _has_texture(scene, material):
            raise Unsupported("a picture on a sphere")
        scene.sphere(item["center"], item["radius"], material, inside=item.get("inside", False))
    elif kind == "cylinder":
        if _has_texture(scene, material):
            raise Unsupported("a picture on a cylinder")
        axis = _unit(item.get("axis", (0, 1, 0)))
        base = np.array(item["center"], float) - axis * item["height"] / 2
        scene.cylinder(base, axis, item["radius"], item["height"], material, inside=item.get("inside", False))
    elif kind == "mesh":
        _mesh(scene, item, folder, material)
    else:
        raise Unsupported(f"a hidden item of type {kind}")


def _box_sides() -> list[Array]:
    """Corners of the six sides of the unit cube about the origin, counter-clockwise from outside."""
    sides = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, i], corners[:, j] = [-0.5, 0.5, 0.5, -0.5], [-0.5, -0.5, 0.5, 0.5]
            sides.append(corners if sign > 0 else corners[::-1])
    return sides


def _mesh(scene: Scene, item: Mapping[str, Any], folder: Path, material: int) -> None:
    mesh = read_mesh(folder / item["filename"])
    if _has_texture(scene, material) and any(face.uvs is None for face in mesh):
        raise Unsupported("a picture on a mesh without texture coordinates")
    scale = np.ones(3) * item.get("scale", 1.0)
    turn, mirrored = rotation(item.get("rotate_deg", (0, 0, 0))), np.prod(scale) < 0
    normals = item.get("normals", "flat" if item.get("face_normals") else "auto")
    if normals == "smooth":
        raise Unsupported("normals: smooth")
    order = [0, 2, 1] if mirrored else [0, 1, 2]
    for face in mesh:
        shading = None
        if face.normals is not None and normals != "flat":
            shading = (face.normals / scale) @ turn.T
            shading = (shading / np.linalg.norm(shading, axis=1, keepdims=True))[order]
        corners = ((face.corners * scale) @ turn.T + np.array(item.get("translate", (0, 0, 0)), float))[order]
        scene.triangle(corners, material, normals=shading, uvs=None if face.uvs is None else face.uvs[order])


def _has_texture(scene: Scene, material: int) -> bool:
    kind, _ = scene.materials[material]
    return kind[3] >= 0 or any(child >= 0 and _has_texture(scene, child) for child in kind[1:3])


def _material(scene: Scene, bsdf: Mapping[str, Any] | None, folder: Path) -> int:
    if bsdf is None:
        return scene.material("diffuse", 1.0)
    kind = bsdf["type"]
    children = [_material(scene, value, folder) for value in bsdf.values() if _is_bsdf(value)]
    allowed = {
        "diffuse": {"reflectance"},
        "conductor": {"material", "eta", "k", "specular_reflectance"},
        "roughconductor": {"material", "eta", "k", "specular_reflectance", "alpha", "distribution", "sample_visible"},
        "dielectric": {"int_ior", "ext_ior"},
        "thindielectric": {"int_ior", "ext_ior"},
        "plastic": {"diffuse_reflectance", "specular_reflectance", "int_ior", "ext_ior", "nonlinear"},
        "blendbsdf": {"weight"},
        "mask": {"opacity"},
        "twosided": set(),
        "null": set(),
    }.get(kind)
    odd = set() if allowed is None else {k for k, value in bsdf.items() if not _is_bsdf(value)} - allowed - {"type"}
    if allowed is None or odd:
        raise Unsupported(f"BSDF {kind} {sorted(odd)}")
    ratio = _index(bsdf.get("int_ior", "polypropylene" if kind == "plastic" else "bk7")) / _index(
        bsdf.get("ext_ior", "air")
    )
    if kind == "diffuse":
        number, texture = _value(scene, bsdf.get("reflectance", 0.5), folder)
        return scene.material("diffuse", number, texture=texture)
    if kind in ("conductor", "roughconductor"):
        if bsdf.get("material") == "none":
            eta = k = 0.0
        elif isinstance(bsdf.get("eta"), (int, float)) and isinstance(bsdf.get("k"), (int, float)):
            eta, k = bsdf["eta"], bsdf["k"]
        else:
            raise Unsupported("metals by name")
        number, texture = _value(scene, bsdf.get("specular_reflectance", 1.0), folder)
        if texture >= 0:
            raise Unsupported("a picture as specular_reflectance")
        beckmann = bsdf.get("distribution", "beckmann") == "beckmann"
        return scene.material(kind, number, eta=eta, k=k, alpha=bsdf.get("alpha", 0.1), beckmann=beckmann)
    if kind in ("dielectric", "thindielectric"):
        return scene.material(kind, eta=ratio)
    if kind == "plastic":
        number, texture = _value(scene, bsdf.get("diffuse_reflectance", 0.5), folder)
        specular = float(bsdf.get("specular_reflectance", 1.0))
        return scene.material(
            kind, number, texture=texture, eta=ratio, specular=specular, nonlinear=bool(bsdf.get("nonlinear", False))
        )
    number, texture = _value(scene, bsdf.get({"blendbsdf": "weight", "mask": "opacity"}.get(kind, ""), 0.5), folder)
    return scene.material(kind, number, texture=texture, children=children)


def _is_bsdf(value: object) -> bool:
    from reference.renderer import MATERIALS

    return (
        isinstance(value, Mapping)
        and value.get("type") not in (None, "bitmap", "rgb", "uniform", "checkerboard")
        and (
            value["type"] in MATERIALS
            or "bsdf" in value["type"]
            or value["type"] in ("principled", "normalmap", "bumpmap")
        )
    )


def _index(value: float | str) -> float:
    if isinstance(value, str):
        if value not in INDEX:
            raise Unsupported(f"index of {value}")
        return INDEX[value]
    return float(value)


def _value(scene: Scene, value: Any, folder: Path) -> tuple[float, int]:
    """A number, or 0 and the index of a picture."""
    if isinstance(value, (int, float)):
        return float(value), -1
    if isinstance(value, list) and len(set(value)) == 1:
        return float(value[0]), -1
    if isinstance(value, Mapping) and value.get("type") == "uniform":
        return float(value["value"]), -1
    if (
        isinstance(value, Mapping)
        and value.get("type") == "bitmap"
        and not set(value) - {"type", "filename", "raw", "filter_type"}
    ):
        with Image.open(folder / value["filename"]) as picture:
            if picture.mode != "L":
                raise Unsupported(f"a picture of mode {picture.mode}")
            texels = np.asarray(picture, dtype=np.float64) / 255
        if not value.get("raw", False):
            texels = np.where(texels <= 0.04045, texels / 12.92, ((texels + 0.055) / 1.055) ** 2.4)
        return 0.0, scene.texture(texels, value.get("filter_type") == "nearest")
    raise Unsupported(f"a value of {value}")
