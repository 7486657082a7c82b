"""Thirty scenes from seeds, ten kinds of three: what light does beyond matt plates that stand apart.

Of each kind one is single, one confocal, one exhaustive with first and last legs. Everything is drawn from
``numpy.random.default_rng(seed)``; files (pictures, meshes) are written into a folder.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from PIL import Image

Item = dict[str, Any]
SEEDS = range(30)
_DEVICES = {"laser_position": [-0.5, 0.0, 0.25], "sensor_position": [-0.4, 0.1, 0.35]}


def configuration(seed: int, folder: Path) -> Item:
    """Return the configuration of a scene and write the files it names into ``folder``."""
    rng = np.random.default_rng(seed)
    make = KINDS[seed % len(KINDS)]
    bounces, items = make(rng, folder)
    return {
        "name": name(seed),
        "scene": {"relay_wall": {"type": "rectangle", "width": 2.0, "height": 1.8}, "hidden_geometry": items},
        "capture": {**_scan(rng, seed), **_DEVICES},
        "time_axis": {"start_opl": 0.0, "bin_width_opl": 0.04, "n_bins": 200},
        "render": {"max_bounces": bounces, "target_error": 0.04, "seed": seed, "color": "grey"},
        "output": {"frame": "scene"},
    }


def _scan(rng: Generator, seed: int) -> Item:
    if seed < 10:
        laser = _vector(rng, (-0.4, -0.4), (0.4, 0.4))
        grids: Item = {"scan_type": "single", "sensor_grid": {"nx": 5, "ny": 4}, "laser_point": laser}
    elif seed < 20:
        grids = {"scan_type": "confocal", "sensor_grid": {"nx": 5, "ny": 4, "width": 1.6, "height": 1.2}}
    else:
        lasers = {"nx": 3, "ny": 2, "width": 1.5, "height": 1.0}
        grids = {"scan_type": "exhaustive", "sensor_grid": {"nx": 3, "ny": 4}, "laser_grid": lasers}
    return grids | {"account_first_and_last_bounces": seed >= 20}


def name(seed: int) -> str:
    """Return the kind and the seed."""
    return f"{KINDS[seed % len(KINDS)].__name__.strip('_').replace('_', '-')}-{seed}"


def _vector(rng: Generator, low: tuple[float, ...], high: tuple[float, ...]) -> list[float]:
    return [round(float(x), 4) for x in rng.uniform(low, high)]


def _matt(rng: Generator) -> Item:
    return {"type": "diffuse", "reflectance": round(float(rng.uniform(0.3, 0.95)), 3)}


def _plate(rng: Generator, bsdf: Item, z: tuple[float, float] = (0.6, 1.1)) -> Item:
    width, height = _vector(rng, (0.4, 0.4), (1.0, 0.9))
    return {
        "type": "rectangle",
        "center": _vector(rng, (-0.4, -0.3, z[0]), (0.4, 0.3, z[1])),
        "normal": _vector(rng, (-0.3, -0.3, -1.0), (0.3, 0.3, -1.0)),
        "width": width,
        "height": height,
        "bsdf": bsdf,
    }


def _side(rng: Generator, bsdf: Item) -> Item:
    sign = float(rng.choice([-1.0, 1.0]))
    pose = {"center": [sign * 0.85, 0.0, 0.7], "normal": [-sign, 0.0, round(float(rng.uniform(-0.5, 0)), 3)]}
    return {"type": "rectangle", **pose, "width": 0.7, "height": 1.0, "bsdf": bsdf}


def _ball(rng: Generator, bsdf: Item) -> Item:
    radius = round(float(rng.uniform(0.1, 0.3)), 3)
    return {
        "type": "sphere",
        "center": _vector(rng, (-0.5, -0.4, 0.5), (0.5, 0.4, 0.9)),
        "radius": radius,
        "bsdf": bsdf,
    }


def _picture(rng: Generator, folder: Path, texels: int) -> Item:
    values = rng.integers(0, 256, (texels, texels + 3)) if texels > 8 else rng.choice([20, 230], (texels, texels + 1))
    Image.fromarray(values.astype(np.uint8), "L").save(folder / f"picture-{texels}.png")
    return {"type": "bitmap", "filename": f"picture-{texels}.png", "raw": True}


def _mirrors(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """Mirrors with and without matt surfaces beside them, one of them a box."""
    metal = {
        "type": "conductor",
        "eta": round(float(rng.uniform(0.2, 1.5)), 2),
        "k": round(float(rng.uniform(2, 5)), 2),
    }
    box = {"type": "box", "center": _vector(rng, (-0.4, -0.3, 0.9), (0.4, 0.3, 1.1)), "size": [0.3, 0.4, 0.2]}
    turned = box | {
        "rotate_deg": _vector(rng, (0, 0, 0), (360, 360, 360)),
        "bsdf": {"type": "conductor", "material": "none"},
    }
    return 4, [_plate(rng, metal, (0.9, 1.2)), _side(rng, _matt(rng)), turned]


def _blends(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A plate half matt, half mirror, and a matt ball."""
    weight = round(float(rng.uniform(0.2, 0.8)), 3)
    mixed = {"type": "blendbsdf", "weight": weight, "a": _matt(rng), "b": {"type": "conductor", "material": "none"}}
    return 4, [_plate(rng, mixed), _ball(rng, _matt(rng))]


def _plastic(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """Smooth plastic: a matt base under a mirror coat."""
    coat = {"type": "plastic", "diffuse_reflectance": 0.6, "nonlinear": bool(rng.integers(2))}
    return 4, [_plate(rng, coat), _side(rng, coat | {"diffuse_reflectance": 0.3})]


def _rough_metal(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """Rough conductors, wide and narrow lobes, and a matt side."""
    lobes = [
        {"type": "roughconductor", "material": "none", "alpha": alpha, "distribution": shape}
        for alpha, shape in zip(_vector(rng, (0.08, 0.2), (0.2, 0.5)), ("ggx", "beckmann"), strict=True)
    ]
    return 4, [_plate(rng, lobes[0]), _ball(rng, lobes[1]), _side(rng, _matt(rng))]


def _smooth_meshes(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A coarse ball and a wavy sheet whose vertex normals are those of the smooth surface."""
    _write_ball(folder / "ball.obj", int(rng.integers(5, 9)))
    _write_waves(folder / "waves.obj", int(rng.integers(6, 14)), float(rng.uniform(0.02, 0.08)))
    turn = _vector(rng, (-20, -20, 0), (20, 20, 360))
    ball = {
        "type": "mesh",
        "filename": "ball.obj",
        "scale": 0.25,
        "translate": _vector(rng, (-0.5, -0.3, 0.5), (0.5, 0.3, 0.7)),
    }
    waves = {"type": "mesh", "filename": "waves.obj", "rotate_deg": turn, "translate": [0.1, 0.0, 1.2]}
    return 4, [ball | {"bsdf": _matt(rng)}, waves | {"bsdf": _matt(rng)}]


def _pictures(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A coarse picture on a plate, a fine one on a side, on a two-sided plate or as the weight of a blend."""
    coarse, fine = (_picture(rng, folder, n) for n in (int(rng.integers(2, 5)), int(rng.integers(20, 90))))
    matt = {"type": "diffuse", "reflectance": fine}
    mixed = {"type": "blendbsdf", "weight": fine, "a": _matt(rng), "b": {"type": "diffuse", "reflectance": 0.1}}
    wrapped = ({"type": "twosided", "a": matt}, matt, mixed)[int(rng.integers(3))]
    return 4, [_plate(rng, {"type": "diffuse", "reflectance": coarse}), _side(rng, wrapped)]


def _round(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """Balls and thin tubes that hide and light each other."""
    tubes = [
        {
            "type": "cylinder",
            "center": _vector(rng, (-0.7, -0.3, 0.5), (0.7, 0.3, 1.0)),
            "axis": _vector(rng, (-1, -1, -0.5), (1, 1, 0.5)),
            "radius": round(float(rng.uniform(0.01, 0.1)), 3),
            "height": 0.6,
            "bsdf": _matt(rng),
        }
        for _ in range(4)
    ]
    return 4, [*tubes, _ball(rng, _matt(rng)), _ball(rng, _matt(rng))]


def _coincident(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A board with a poster on its front, a decal on a box, plates that overlap in one plane, a double-walled ball."""
    gap = 10 ** float(rng.uniform(-7, -3.5))
    board = _plate(rng, _matt(rng)) | {"normal": [0, 0, -1]}
    x, y, z = board["center"]
    poster = board | {"center": [x + 0.05, y, z - gap], "width": 0.25, "height": 0.3, "bsdf": _matt(rng)}
    beside = board | {"center": [x + 0.3, y + 0.1, z]}
    ball = _ball(rng, _matt(rng))
    shell = ball | {"radius": ball["radius"] + gap, "bsdf": {"type": "diffuse", "reflectance": 0.05}}
    box = {
        "type": "box",
        "center": [-0.6, -0.5, 0.7],
        "size": [0.3, 0.3, 0.3],
        "bsdf": {"type": "diffuse", "reflectance": 0.9},
    }
    decal = {"type": "rectangle", "center": [-0.6, -0.5, 0.55 - gap], "width": 0.2, "height": 0.2, "bsdf": _matt(rng)}
    return 4, [board, poster, beside, ball, shell, box, decal]


def _rooms(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A furnished room, to the sixth bounce."""
    room = {"type": "room", "size": _vector(rng, (2.0, 1.8, 1.4), (2.6, 2.2, 2.0)), "bsdf": _matt(rng)}
    box = {
        "type": "box",
        "center": [0.4, -0.5, 0.8],
        "size": [0.5, 0.6, 0.4],
        "rotate_deg": [0, 30, 0],
        "bsdf": _matt(rng),
    }
    return 6, [room, box, _ball(rng, _matt(rng))]


def _panes(rng: Generator, folder: Path) -> tuple[int, list[Item]]:
    """A thin pane or a half-open mask before a matt plate."""
    screens = (
        {"type": "thindielectric", "int_ior": 1.5},
        {"type": "mask", "opacity": round(float(rng.uniform(0.3, 0.7)), 3), "a": _matt(rng)},
    )
    screen = _plate(rng, screens[int(rng.integers(2))], (0.4, 0.5)) | {"width": 0.6, "height": 1.0}
    return 5, [screen, _plate(rng, _matt(rng), (0.9, 1.2))]


KINDS: tuple[Callable[[Generator, Path], tuple[int, list[Item]]], ...] = (
    *(_mirrors, _blends, _plastic, _rough_metal, _smooth_meshes),
    *(_pictures, _round, _coincident, _rooms, _panes),
)


def _write_ball(path: Path, n: int) -> None:
    """Write a unit ball of n bands and 2 n segments, with its own normals."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, n + 1), np.arange(2 * n) * np.pi / n, indexing="ij")
    p = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1).reshape(-1, 3)
    faces = []
    for i in range(n):
        for j in range(2 * n):
            a, b = i * 2 * n + j, i * 2 * n + (j + 1) % (2 * n)
            c, d = a + 2 * n, b + 2 * n
            faces += ([[a, c, d]] if i < n else []) + ([[a, d, b]] if i > 0 else [])
    _write_obj(path, p, p, [face for face in faces if len({tuple(np.round(p[k], 9)) for k in face}) == 3])


def _write_waves(path: Path, n: int, height: float) -> None:
    """Write a sheet of 1 x 1 m around the origin that faces -z, z = height sin(6 x) cos(5 y), with its own normals."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, n + 1), np.linspace(-0.5, 0.5, n + 1))
    z = height * np.sin(6 * x) * np.cos(5 * y)
    slopes = height * 6 * np.cos(6 * x) * np.cos(5 * y), -height * 5 * np.sin(6 * x) * np.sin(5 * y)
    normals = np.stack([*slopes, -np.ones_like(x)], -1).reshape(-1, 3)
    corner = [j * (n + 1) + i for j in range(n) for i in range(n)]
    faces = [[a, a + n + 2, a + 1] for a in corner] + [[a, a + n + 1, a + n + 2] for a in corner]
    _write_obj(path, np.stack([x, y, z], -1).reshape(-1, 3), normals / np.linalg.norm(normals, axis=1)[:, None], faces)


def _write_obj(path: Path, p: np.ndarray, n: np.ndarray, faces: list[list[int]]) -> None:
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in p] + [f"vn {x:.9f} {y:.9f} {z:.9f}" for x, y, z in n]
    lines += ["f " + " ".join(f"{k + 1}//{k + 1}" for k in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
