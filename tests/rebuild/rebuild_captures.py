"""The small captures whose bytes a rebuild of the renderer may not change: configurations, and the files they name.

Only YAML keys and command-line options of the documented interface stand here, nothing of the package is imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Item = dict[str, Any]
Engine = Literal["path", "virtual_lights", "line_of_sight"]
Mode = Literal["render", "shards", "lasers", "kill", "stop", "dask"]


@dataclass(frozen=True)
class CaptureCase:
    """One capture of the list."""

    name: str
    engine: Engine  # that has to render it
    config: Mapping[str, Any]  # the YAML
    mode: Mode = "render"  # shards, lasers: parts merged; kill, stop: SIGKILL or SIGTERM, then gone on with
    same_as: str | None = None  # capture whose samples this one has to have as well
    is_zero: bool = False  # no light is expected


# --- items -----------------------------------------------------------------------------------------------------------


def diffuse(reflectance: Any) -> Item:
    """Return a Lambertian BSDF."""
    return {"type": "diffuse", "reflectance": reflectance}


def plate(center: Sequence[float], normal: Sequence[float], size: tuple[float, float], bsdf: Any = 0.7) -> Item:
    """Return a rectangle; anything but a dict is the reflectance of a Lambertian one."""
    up = [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 * math.hypot(*normal) else [1.0, 0.0, 0.0]
    pose = {"center": list(center), "normal": list(normal), "up": up, "width": size[0], "height": size[1]}
    return {"type": "rectangle", **pose, "bsdf": bsdf if isinstance(bsdf, dict) else diffuse(bsdf)}


def ball(center: Sequence[float], radius: float, reflectance: float = 0.7, *, inside: bool = False) -> Item:
    """Return a Lambertian sphere."""
    pose = {"center": list(center), "radius": radius, "inside": inside}
    return {"type": "sphere", **pose, "bsdf": diffuse(reflectance)}


def tube(center: Sequence[float], axis: Sequence[float], radius: float, height: float, *, inside: bool = False) -> Item:
    """Return a Lambertian cylinder."""
    pose = {"center": list(center), "axis": list(axis), "radius": radius, "height": height, "inside": inside}
    return {"type": "cylinder", **pose, "bsdf": diffuse(0.8)}


def mesh(filename: str, bsdf: Any = 0.8, **pose: Any) -> Item:
    """Return a mesh of a file that ``write_files`` writes."""
    return {"type": "mesh", "filename": filename, "bsdf": bsdf if isinstance(bsdf, dict) else diffuse(bsdf), **pose}


def nlos(
    *hidden: Item,
    scan: str = "single",
    sensors: tuple[int, int] = (5, 3),
    lasers: tuple[int, int] = (2, 3),
    bins: tuple[float, float, int | str] = (0.2, 0.06, 80),
    wall: Item | None = None,
    capture: Item | None = None,
    output: Item | None = None,
    **render: Any,
) -> Item:
    """Return the configuration of hidden items before a grey wall of 2.0 x 1.6 m, legs not counted, four bounces.

    ``target_error`` 0.05 unless ``render`` has ``spp``. Grids have another size on every axis.
    """
    grids: Item = {"sensor_grid": {"nx": sensors[0], "ny": sensors[1]}}
    if scan == "exhaustive":
        grids["laser_grid"] = {"nx": lasers[0], "ny": lasers[1], "width": 1.5, "height": 1.2}
    if scan == "single":
        grids["laser_point"] = [0.3, -0.2]
    goal: Item = {} if "spp" in render else {"target_error": 0.05}
    flat = {"type": "rectangle", "width": 2.0, "height": 1.6, "bsdf": diffuse(0.5)}
    return {
        "scene": {
            "relay_wall": wall if wall and "type" in wall else flat | (wall or {}),
            "hidden_geometry": list(hidden),
        },
        "capture": {"scan_type": scan, **grids, "account_first_and_last_bounces": False, **(capture or {})},
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
        "render": {"max_bounces": 4, **goal, **render},
        "output": output or {},
    }


def seen(
    *surfaces: Item,
    emitters: Sequence[Item],
    bins: tuple[float, float, int | str] = (0.0, 0.1, 160),
    capture: Item | None = None,
    **render: Any,
) -> Item:
    """Return a line-of-sight configuration: surfaces and emitters seen by 7 x 5 pixels at z = 4."""
    camera = {"position": [0, 0, 4], "look_at": [0, 0, 0], "fov_deg": 35, "width": 7, "height": 5}
    goal: Item = {} if "target_error" in render else {"spp": 64}
    return {
        "scene": {"hidden_geometry": list(surfaces), "emitters": list(emitters)},
        "capture": {"scan_type": "line_of_sight", "camera": camera, **(capture or {})},
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
        "render": {"max_bounces": 4, **goal, **render},
    }


SLANTED = plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6))
SIDE = plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), 0.8)
SCREEN = plate((0.3, 0.0, 0.35), (0.1, 0.0, -1.0), (0.25, 0.3), 0.4)
STANDING = plate((0.52, 0.0, 0.3), (-1.0, 0.0, 0.0), (0.6, 0.6), 0.8)  # touches the wall between sensor points
FAR_BOX = {"type": "box", "center": [0.1, 0.05, 1.2], "size": [0.3, 0.2, 0.2], "rotate_deg": [20, 30, 10]}
DEVICES = {"laser_position": [-0.5, 0, 0.25], "sensor_position": [0.4, 0.3, 1.1]}
LEGS = {"account_first_and_last_bounces": True} | DEVICES
EQUAL_LEGS = {"account_first_and_last_bounces": True, "laser_position": [0, 0, 1], "sensor_position": [0, 0, 1]}
SPOT = {"laser_spot_radius": 0.05}
BITMAP = {"type": "bitmap", "filename": "grey.png", "raw": True}
COLOURS = {"type": "bitmap", "filename": "colours.png"}
CHECKER = {"type": "checkerboard", "color0": 0.2, "color1": 0.9}
ROUGH = {"type": "roughconductor", "alpha": 0.4}
ROUGH_PLASTIC = {"type": "roughplastic", "alpha": 0.3}
PLASTIC = {"type": "plastic", "diffuse_reflectance": 0.6, "nonlinear": True}
MIRROR = {"type": "conductor", "material": "none"}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.3], "bsdf": diffuse(0.6)}
TURNED_BOX = {"type": "box", "center": [0.3, -0.2, 0.6], "size": [0.3, 0.4, 0.2], "rotate_deg": [20, 30, 10]}
LETTER = {"type": "letters", "text": "T", "height": 0.6, "center": [-0.3, 0.1, 0.7], "normal": [0.3, 0.0, -1.0]}
SOLID = {"type": "letters", "text": "ZE", "height": 0.6, "thickness": 0.1, "center": [0.0, 0.0, 0.5]}
BALLS = (ball((0.1, -0.1, 0.6), 0.25, 0.9), ball((-0.42, 0.2, 0.7), 0.3, 0.8), ball((0.5, 0.35, 0.55), 0.18, 0.9))
POSED = {"center": [0.5, -0.3, 1.0], "normal": [0.3, 0.2, 1.0], "up": [0.1, 1.0, 0.3]}
BEFORE_POSED = (
    plate((0.95, 0.15, 1.8), (-0.5, -0.3, -1.0), (0.9, 0.7), 0.8),
    ball((0.15, 0.2, 1.7), 0.2, 0.6),
    plate((0.3, -0.6, 1.7), (0.1, 1.0, 0.1), (0.9, 0.6), 0.9),
)
IN_SPHERE = {"type": "sphere", "radius": 1.2, "width": 2.0, "height": 1.2, "bsdf": diffuse(0.5)}
IN_CYLINDER = {"type": "cylinder", "radius": 1.1, "height": 1.5, "bsdf": diffuse(0.5)}
ON_SPHERE = {"type": "sphere", "radius": 0.8, "inside": False, "width": 1.0, "height": 0.8}
WAVY_WALL = {"type": "mesh", "filename": "wavy-wall.ply", "bsdf": diffuse(0.7)}
LAMP = plate((0.2, 1.4, 0.5), (0.0, -1.0, 0.0), (0.8, 0.6), 0.0) | {"radiance": 3.0}
FLOOR = plate((0.0, -0.9, 0.0), (0.0, 1.0, 0.0), (3.0, 3.0), 0.6)
BACK = plate((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (3.0, 2.4), 0.7)
POINT = {"type": "point", "position": [0.8, 0.9, 1.0], "intensity": 2.0}


def _virtual_lights() -> dict[str, Item]:
    """Captures of the virtual-light engine: what ``auto`` gives it, and what it takes by name."""
    by_name = {"engine": "virtual_lights"}
    grid = {"sensors": (18, 16), "max_bounces": 3, "bins": (0.2, 0.08, 50)}  # enough points for visibility masks
    many = {"sensors": (33, 32), "max_bounces": 3, "bins": (0.0, 0.12, 30), "target_error": 0.1}  # and for regions
    return {
        "single-two-plates": nlos(SLANTED, SIDE, max_bounces=5),
        "single-one-plate": nlos(SLANTED, max_bounces=3),
        "single-seed-7": nlos(SLANTED, SIDE, max_bounces=5, seed=7),
        "single-occluders": nlos(SLANTED, SCREEN, ball((-0.1, 0.2, 0.4), 0.1), SIDE),
        "single-thick-letters": nlos(SOLID | {"normal": [0.1, 0.0, -1.0], "bsdf": diffuse(0.8)}),
        "single-near-wall": nlos(STANDING, SLANTED, bins=(0.0, 0.06, 80)),
        "single-through-wall": nlos(
            plate((0.0, 0.45, 0.1), (0.3, -1.0, -0.2), (0.8, 0.6), 0.8),
            ball((-0.62, -0.24, 0.05), 0.15, 0.9),
            bins=(0.0, 0.06, 80),
        ),
        "single-posed-wall-legs": nlos(
            *BEFORE_POSED,
            wall=POSED,
            capture=LEGS | {"laser_position": [0.3, 0.0, 1.6], "sensor_position": [0.9, 0.2, 2.1]},
            bins=(1.0, 0.07, 90),
        ),
        "single-closed-room": nlos(ROOM, max_bounces=None, bins=(0.0, 0.1, 120)),
        "single-summed-bounces": nlos(TURNED_BOX, LETTER, SIDE, split_bounces=False, max_bounces=6),
        "single-late-window": nlos(SLANTED, SIDE, bins=(2.6, 0.05, 12), capture={"laser_point": [-0.2, 0.4]}),
        "single-auto-bins": nlos(SLANTED, bins=(0.0, 0.05, "auto"), max_bounces=3),
        "single-in-a-sphere": nlos(ball((0.1, 0.0, 0.3), 1.6, 0.5, inside=True), max_bounces=5, bins=(0.5, 0.1, 60)),
        "single-in-a-tube": nlos(tube((0, 0, 0.6), (1, 0, 0), 1.0, 1.5, inside=True), bins=(0.0, 0.1, 60)),
        "single-no-variance": nlos(SLANTED, SIDE, output={"variance": False, "compression": "none", "frame": "scene"}),
        "single-colour": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), [0.9, 0.3, 0.05]),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), [0.05, 0.5, 0.9]),
            wall={"bsdf": diffuse([0.9, 0.6, 0.3])},
        ),
        "single-checkerboard": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), diffuse(CHECKER)), SIDE, color="grey"
        ),
        "single-bitmap": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), diffuse(BITMAP)), SIDE, color="grey"
        ),
        "single-vertex-normals": nlos(mesh("waves.obj", translate=[0.1, 0.0, 0.6]), SIDE),
        "single-smooth-normals": nlos(mesh("waves.obj", translate=[0.1, 0.0, 0.6], normals="smooth"), max_bounces=3),
        "single-rough-by-name": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), ROUGH_PLASTIC),
            target_error=0.2,
            **by_name,
        ),
        "single-rough-third-only": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH), SIDE, max_bounces=3, **by_name
        ),
        "single-rough-5-bounces": nlos(  # the further ones by paths
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH),
            SIDE,
            max_bounces=5,
            target_error=0.3,
            **by_name,
        ),
        "single-many-patches": nlos(  # more than are kept for the next batch
            SLANTED,
            SIDE,
            sensors=(3, 2),
            bins=(0.8, 0.0008, 1500),
            max_bounces=3,
            memory_limit="404MB",
            target_error=0.0008,
        ),
        "single-clusters": nlos(mesh("fine.ply", translate=[0.1, 0.0, 0.9]), max_bounces=3, bins=(0.2, 0.1, 50)),
        "single-clusters-occluded": nlos(mesh("fine.ply", translate=[0.1, 0.0, 0.9]), SCREEN, bins=(0.2, 0.1, 50)),
        "single-masks": nlos(SLANTED, SCREEN, SIDE, **grid),
        "single-masks-4-bounces": nlos(SLANTED, SCREEN, ball((-0.1, 0.2, 0.4), 0.1), **grid | {"max_bounces": 4}),
        "single-regions": nlos(STANDING, SLANTED, **many),
        "single-regions-letters": nlos(SOLID | {"center": [0.0, 0.0, 0.0501], "bsdf": diffuse(0.8)}, **many),
        "confocal-plates": nlos(SLANTED, ball((-0.45, 0.2, 0.7), 0.25), SIDE, scan="confocal"),
        "confocal-third-only": nlos(SLANTED, scan="confocal", max_bounces=3, capture=LEGS, bins=(0.5, 0.06, 80)),
        "confocal-masks": nlos(SLANTED, SCREEN, scan="confocal", **grid),
        "confocal-regions": nlos(STANDING, SLANTED, scan="confocal", **many),
        "exhaustive-screen-legs": nlos(
            SLANTED,
            SIDE,
            plate((0.0, 0.0, 0.3), (1.0, 0.0, -0.1), (0.4, 1.2), 0.6),
            scan="exhaustive",
            sensors=(3, 2),
            lasers=(3, 3),
            capture=LEGS,
            bins=(1.0, 0.07, 80),
            max_bounces=6,
        ),
        "exhaustive-near-wall": nlos(STANDING, SLANTED, scan="exhaustive", bins=(0.0, 0.06, 80), target_error=0.1),
        "exhaustive-rough-third-only": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH),
            scan="exhaustive",
            max_bounces=3,
            **by_name,
        ),
        "single-near-laser": nlos(
            plate((0.301, -0.2, 0.2), (-1.0, 0.0, 0.0), (0.4, 0.4), 0.8), SLANTED, target_error=0.2, **by_name
        ),
        "exhaustive-three-balls": nlos(*BALLS, scan="exhaustive", sensors=(3, 2), lasers=(2, 3)),
        "exhaustive-reciprocal": nlos(
            SLANTED,
            SCREEN,
            scan="exhaustive",
            capture={"laser_grid": {"nx": 5, "ny": 3}} | EQUAL_LEGS,
            bins=(1.0, 0.1, 60),
        ),
        "exhaustive-masks": nlos(SLANTED, SCREEN, scan="exhaustive", lasers=(2, 1), **grid),
        "sphere-wall-inside": nlos(ball((0, 0, 0), 0.3, 0.8), wall=IN_SPHERE, bins=(0.0, 0.1, 70)),
        "sphere-wall-outside": nlos(
            plate((0.0, 0.2, 1.6), (0.1, 0, -1), (0.8, 0.6)), wall=ON_SPHERE, bins=(0.5, 0.08, 60)
        ),
        "sphere-wall-confocal": nlos(
            ball((0, 0, 0), 0.3, 0.8), wall=IN_SPHERE, scan="confocal", max_bounces=3, bins=(0.0, 0.1, 70)
        ),
        "cylinder-wall-inside": nlos(
            tube((0, 0, 0.1), (0, 1, 0), 0.2, 0.6),
            plate((0.1, 0.5, 0), (0.0, -1.0, 0.2), (0.5, 0.4)),
            wall=IN_CYLINDER,
            bins=(0.0, 0.1, 70),
        ),
        "mesh-wall-by-name": nlos(
            plate((0.0, 0.0, 1.0), (0.1, 0, -1), (0.8, 0.6)),
            wall=WAVY_WALL,
            capture={"laser_point": [0.13, -0.07], "sensor_grid": {"nx": 5, "ny": 3, "width": 1.7, "height": 1.3}},
            max_bounces=3,
            target_error=0.2,
            **by_name,
        ),
    }


def _paths() -> dict[str, Item]:
    """Captures of the path engine: every technique, and what only paths can carry."""
    by_name = {"engine": "path", "spp": 128}
    two = (SLANTED, SIDE)
    small = plate((0.1, 0.05, 0.9), (0.1, 0.0, -1.0), (0.25, 0.2))  # hidden geometry sampling alone serves best
    glass = plate((0.0, 0, 0.4), (0, 0, -1), (0.3, 0.4), {"type": "thindielectric", "int_ior": 1.5})
    mask = plate((0.1, 0, 0.4), (0, 0, -1), (0.6, 1.0), {"type": "mask", "opacity": 0.5, "a": diffuse(0.5)})
    solid_glass = {"type": "sphere", "center": [0.1, 0, 0.5], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    blend = {"type": "blendbsdf", "weight": 0.4, "a": diffuse(0.6), "b": MIRROR}
    return {
        "single": nlos(*two, **by_name),
        "single-small-far-plate": nlos(small, max_bounces=6, **by_name),
        "single-spot-far-box": nlos(FAR_BOX, capture=SPOT, **by_name),  # most sampled points show their dark side
        "single-polarised-far-box": nlos(FAR_BOX, polarized=True, engine="path", spp=64),
        # enough paths for the pilot of the continuation period, in either loop
        "single-pilot-third-loop": nlos(small, SLANTED, sensors=(16, 16), spp=4096, max_bounces=5, engine="path"),
        "single-pilot-third-loop-no-limit": nlos(FAR_BOX, sensors=(16, 16), spp=4096, max_bounces=None, engine="path"),
        "single-pilot-full-loop": nlos(
            *two, sensors=(16, 16), spp=4096, max_bounces=5, split_bounces=False, engine="path"
        ),
        "single-pilot-full-loop-no-limit": nlos(
            ball((0.1, 0.05, 0.9), 0.1),
            SIDE,
            sensors=(16, 16),
            spp=4096,
            max_bounces=None,
            split_bounces=False,
            engine="path",
        ),
        "single-small-far-ball": nlos(ball((0.1, 0.05, 0.9), 0.1), max_bounces=6, **by_name),
        "single-seed-7": nlos(*two, seed=7, **by_name),
        "single-target-error": nlos(*two, engine="path", target_error=0.3),
        "single-third-target-error": nlos(*two, engine="path", target_error=0.2, max_bounces=3),
        "single-third-only": nlos(*two, max_bounces=3, **by_name),
        "single-summed-bounces": nlos(*two, split_bounces=False, max_bounces=6, **by_name),
        "single-room-no-limit": nlos(ROOM, max_bounces=None, bins=(0.0, 0.1, 120), **by_name),
        "single-no-roulette": nlos(*two, russian_roulette=False, **by_name),
        "single-time-gate": nlos(ROOM, max_bounces=8, bins=(0.5, 0.05, 30), **by_name),
        "single-time-gate-legs": nlos(*two, max_bounces=6, bins=(2.0, 0.05, 30), capture=LEGS, **by_name),
        "single-temporal-kernel": nlos(*two, temporal_kernel_opl=0.3, **by_name),
        "single-spot": nlos(*two, capture=SPOT, **by_name),
        "single-spot-by-chance": nlos(
            *two, capture={"laser_spot_radius": 0.3}, laser_sampling=False, **by_name | {"spp": 512}
        ),
        "single-bsdf-sampling": nlos(*two, hidden_geometry_sampling=False, **by_name),
        "single-bsdf-sampling-far-box": nlos(
            plate((0.3, 0.2, 1.5), (0, 0, -1), (0.2, 0.2)), hidden_geometry_sampling=False, **by_name
        ),
        "single-no-technique": nlos(
            *two,
            capture={"laser_spot_radius": 0.3},
            laser_sampling=False,
            hidden_geometry_sampling=False,
            **by_name | {"spp": 512},
        ),
        "single-rough": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), ROUGH_PLASTIC),
            spp=128,
        ),
        "single-plastic": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), PLASTIC), SIDE, capture=SPOT, spp=128
        ),
        "single-rough-wall": nlos(*two, wall={"bsdf": ROUGH_PLASTIC}, spp=128),
        "single-mirror-spot": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), MIRROR), SIDE, capture=SPOT, spp=128
        ),
        "single-mirror-point": nlos(plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), MIRROR), SIDE, spp=128),
        "single-blend": nlos(plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), blend), SIDE, spp=128),
        "single-pane": nlos(glass, plate((0.1, 0, 1.0), (0, 0, -1), (0.9, 0.8)), max_bounces=5, spp=128),
        "single-mask": nlos(mask, plate((0.1, 0, 1.0), (0, 0, -1), (0.9, 0.8)), max_bounces=5, spp=128),
        "single-glass-ball": nlos(solid_glass, SIDE, capture=SPOT, max_bounces=6, spp=128),
        "single-colour-bitmap": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), diffuse(COLOURS)), SIDE, color="rgb", spp=64
        ),
        "single-polarised": nlos(
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), ROUGH), SIDE, polarized=True, spp=64
        ),
        "single-vertex-normals": nlos(mesh("waves.obj", translate=[0.1, 0.0, 0.6]), SIDE, **by_name),
        "single-vertex-colours": nlos(
            mesh(
                "coloured.ply",
                diffuse({"type": "mesh_attribute", "name": "vertex_color"}),
                translate=[0.1, 0.0, 0.6],
            ),
            **by_name,
        ),
        "single-mitsuba-disk": nlos(
            {
                "type": "mitsuba",
                "shape": {
                    "type": "disk",
                    "to_world": [[-0.4, 0, 0, 0.1], [0, 0.4, 0, 0], [0, 0, -0.4, 0.7], [0, 0, 0, 1]],
                },
                "bsdf": diffuse(0.8),
            },
            SIDE,
            target_error=0.3,
        ),
        "single-round-touches-wall": nlos(ball((0.4, 0.0, 0.2), 0.2), target_error=0.3),
        "single-empty": nlos(spp=64, max_bounces=3),
        "confocal": nlos(*two, scan="confocal", **by_name),
        "confocal-time-gate": nlos(ROOM, scan="confocal", max_bounces=6, bins=(0.5, 0.05, 30), **by_name),
        "confocal-touching": nlos(
            plate((0.4, 0.0, 0.3), (-1.0, 0.0, 0.0), (0.6, 0.6), 0.8), scan="confocal", target_error=0.5
        ),
        "exhaustive": nlos(*two, scan="exhaustive", **by_name),
        "exhaustive-spot-legs": nlos(*two, scan="exhaustive", capture=LEGS | SPOT, bins=(1.0, 0.08, 60), **by_name),
        "exhaustive-target-error": nlos(*two, scan="exhaustive", engine="path", target_error=0.4),
        "sphere-wall": nlos(ball((0, 0, 0), 0.3, 0.8), wall=IN_SPHERE, bins=(0.0, 0.1, 70), **by_name),
        "sphere-wall-alone": nlos(wall=IN_SPHERE, bins=(0.0, 0.1, 70), **by_name),
        "sphere-wall-second-only": nlos(wall=IN_SPHERE, bins=(0.0, 0.1, 70), **by_name | {"max_bounces": 2}),
        "sphere-wall-confocal": nlos(
            ball((0, 0, 0), 0.3, 0.8), wall=IN_SPHERE, scan="confocal", bins=(0.0, 0.1, 70), **by_name
        ),
        "cylinder-wall": nlos(tube((0, 0, 0.1), (0, 1, 0), 0.2, 0.6), wall=IN_CYLINDER, bins=(0.0, 0.1, 70), **by_name),
        "mesh-wall": nlos(
            LETTER,
            wall=WAVY_WALL,
            capture={"laser_point": [0.13, -0.07], "sensor_grid": {"nx": 5, "ny": 3, "width": 1.7, "height": 1.3}},
            target_error=0.3,
        ),
        "mesh-wall-exhaustive": nlos(
            SLANTED,
            wall=WAVY_WALL,
            scan="exhaustive",
            capture={"sensor_grid": {"nx": 5, "ny": 3, "width": 1.7, "height": 1.3}},
            **by_name,
        ),
    }


def _line_of_sight() -> dict[str, Item]:
    """Captures of a camera."""
    glass = {"type": "sphere", "center": [-0.5, -0.3, 0.3], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    metal = {
        "type": "sphere",
        "center": [0.6, -0.3, 0.2],
        "radius": 0.4,
        "bsdf": {"type": "roughconductor", "alpha": 0.2},
    }
    red = plate((-1.2, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 2.0), [0.8, 0.2, 0.1])
    spot = {"type": "spot", "position": [0.5, 1.2, 1.5], "look_at": [0, 0, -1], "intensity": 5.0, "cutoff_deg": 30}
    bulb = ball((0.7, 0.8, 0.2), 0.15, 0.0) | {"radiance": 4.0}
    from_file: Item = {
        "capture": {"scan_type": "line_of_sight"},
        "time_axis": {"bin_width_opl": 0.1, "n_bins": "auto"},
        "render": {"max_bounces": 5, "spp": 64},
    }
    textured = plate((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (3.0, 2.4), diffuse(COLOURS))
    return {
        "area-lamp": seen(FLOOR, BACK, TURNED_BOX, emitters=[LAMP]),
        "point-and-spot": seen(FLOOR, BACK, emitters=[POINT, spot]),
        "bulb-glass-metal": seen(FLOOR, BACK, glass, metal, emitters=[bulb], max_bounces=7),
        "rough-glass": seen(
            FLOOR, BACK, plate((0, 0, 0.5), (0, 0, 1), (1.0, 1.0), {"type": "roughdielectric"}), emitters=[LAMP]
        ),
        "colour-texture": seen(FLOOR, red, textured, emitters=[LAMP]),
        "polarised": seen(FLOOR, BACK, metal, glass, emitters=[LAMP], polarized=True),
        "target-error": seen(FLOOR, BACK, emitters=[POINT], target_error=0.2),
        "summed-no-limit": seen(FLOOR, BACK, metal, emitters=[LAMP, POINT], split_bounces=False, max_bounces=None),
        "window-without-leg": seen(
            FLOOR, BACK, emitters=[LAMP], bins=(1.0, 0.05, 40), capture={"account_first_and_last_bounces": False}
        ),
        "emission-only": seen(BACK, emitters=[bulb], max_bounces=0, bins=(0.0, 0.1, "auto")),
        "no-roulette": seen(FLOOR, BACK, emitters=[LAMP], russian_roulette=False, seed=3),
        "mitsuba-xml": {"scene": {"mitsuba": "scene.xml"}, **from_file},
        "mitsuba-xml-sky": {"scene": {"mitsuba": "sky.xml"}, **from_file},
    }


def capture_cases() -> tuple[CaptureCase, ...]:
    """Return the whole list; names begin with the engine, or with the way of rendering."""
    cases = [CaptureCase(f"vl-{name}", "virtual_lights", config) for name, config in _virtual_lights().items()]
    cases += [
        CaptureCase(f"path-{name}", "path", config, is_zero=name == "single-empty") for name, config in _paths().items()
    ]
    cases += [CaptureCase(f"los-{name}", "line_of_sight", config) for name, config in _line_of_sight().items()]
    return (*cases, *_ways_of_rendering())


def _ways_of_rendering() -> list[CaptureCase]:
    """One capture per engine, whole and in every other way that has to give the same bytes."""
    # 401 MB leave a batch about 1 MB: many work items
    paths = nlos(
        SLANTED,
        SIDE,
        scan="exhaustive",
        sensors=(5, 3),
        lasers=(2, 7),
        bins=(0.4, 0.02, 150),
        engine="path",
        spp=64,
        memory_limit="401MB",
    )
    lights = nlos(SLANTED, SCREEN, scan="exhaustive", sensors=(5, 3), lasers=(2, 7), bins=(0.4, 0.02, 150))
    lights["render"] = lights["render"] | {"engine": "virtual_lights", "target_error": 0.1, "memory_limit": "401MB"}
    view = seen(FLOOR, BACK, emitters=[LAMP], bins=(0.0, 0.05, 300), memory_limit="404MB")
    cases: list[CaptureCase] = []
    ways: dict[Engine, tuple[str, Item, tuple[Mode, ...]]] = {
        "path": ("path", paths, ("shards", "lasers", "kill", "stop", "dask")),
        "virtual_lights": ("vl", lights, ("shards", "lasers", "kill", "stop", "dask")),
        "line_of_sight": ("los", view, ("shards", "dask")),
    }
    reciprocal = _virtual_lights()["exhaustive-reciprocal"]
    cut = {**reciprocal, "render": {**reciprocal["render"], "memory_limit": "401MB"}}
    cases.append(CaptureCase("cut-reciprocal", "virtual_lights", cut, same_as="vl-exhaustive-reciprocal"))
    for engine, (short, config, modes) in ways.items():
        whole = f"whole-{short}"
        # three processes share the limit, and each takes the 400 MB for itself
        limits = {whole: "2GB", f"dask-{short}": "1212MB"}
        for name, mode in ((whole, "render"), (f"cut-{short}", "render"), *((f"{m}-{short}", m) for m in modes)):
            limit = limits.get(name, config["render"]["memory_limit"])
            limited = {**config, "render": {**config["render"], "memory_limit": limit}}
            cases.append(CaptureCase(name, engine, limited, mode, None if name == whole else whole))
    return cases


# --- files that the configurations name ------------------------------------------------------------------------------

XML = """<scene version="3.0.0">
    <default name="pixels" value="7"/>
    <integrator type="path"/>
    <sensor type="perspective">
        <float name="fov" value="45"/>
        <transform name="to_world"><lookat origin="0.4, 1.2, 3.5" target="0, 0.7, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$pixels"/><integer name="height" value="5"/></film>
    </sensor>
    <bsdf type="diffuse" id="matt"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf>
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform><ref id="matt"/>
    </shape>
    <shape type="rectangle">
        <transform name="to_world"><scale value="2"/><translate y="1" z="-1.5"/></transform><ref id="matt"/>
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale x="0.4" y="0.4" z="0.04"/><rotate y="1" angle="20"/><translate x="-0.5" y="0.45" z="0.3"/>
        </transform>
        <bsdf type="dielectric"><float name="int_ior" value="1.5"/></bsdf>
    </shape>
    <shape type="rectangle">
        <transform name="to_world">
            <rotate x="1" angle="90"/><scale value="0.8"/><translate y="2.2" z="0.5"/>
        </transform>
        <emitter type="area"><rgb name="radiance" value="3, 3, 3"/></emitter>
    </shape>
</scene>
"""

Array = NDArray[np.float64]


def write_files(folder: Path) -> None:
    """Write the meshes, pictures and scenes that the configurations name."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    Image.fromarray(rng.integers(0, 256, (5, 7)).astype(np.uint8)).save(folder / "grey.png")
    Image.fromarray(rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)).save(folder / "colours.png")
    (folder / "scene.xml").write_text(XML)
    (folder / "sky.xml").write_text(XML.replace("</scene>", '<emitter type="constant"/></scene>'))
    waves, normals = _sheet(0.8, 0.6, 6, 5, lambda x, y: 0.05 * np.sin(9 * x))
    _write_obj(folder / "waves.obj", waves, normals, _faces(6, 5)[:, ::-1])
    fine, _ = _sheet(0.8, 0.6, 90, 70, lambda x, y: 0.02 * np.sin(25 * x) * np.cos(19 * y))
    _write_ply(folder / "fine.ply", {"x y z": fine}, _faces(90, 70)[:, ::-1])
    colours = rng.uniform(0.1, 0.9, (len(waves), 3))
    _write_ply(folder / "coloured.ply", {"x y z": waves, "r g b": colours}, _faces(6, 5)[:, ::-1])
    wall, _ = _sheet(2.0, 1.6, 12, 10, lambda x, y: 0.08 * np.sin(4 * x) * np.cos(3 * y))
    uv = wall[:, :2] / (2.0, 1.6) + 0.5
    _write_ply(folder / "wavy-wall.ply", {"x y z": wall, "u v": uv}, _faces(12, 10))


def _sheet(
    width: float, height: float, columns: int, rows: int, depth: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    """Return the vertices of a sheet around the origin, and its normals towards -z, by differences."""
    grid = np.meshgrid(np.linspace(-width / 2, width / 2, columns + 1), np.linspace(-height / 2, height / 2, rows + 1))
    x, y = (values.ravel() for values in grid)
    step = 1e-4
    slopes = (depth(x + step, y) - depth(x - step, y)) / 2e-4, (depth(x, y + step) - depth(x, y - step)) / 2e-4
    normals = np.stack([*slopes, -np.ones_like(x)], axis=1)
    return np.stack([x, y, depth(x, y)], axis=1), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _faces(columns: int, rows: int) -> NDArray[np.int64]:
    """Return the triangles of a sheet; they face +z."""
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _write_ply(path: Path, properties: Mapping[str, Array], faces: NDArray[np.int64]) -> None:
    names = [name for group in properties for name in group.split()]
    rows = np.concatenate(list(properties.values()), axis=1)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{x:.9g}" for x in row) for row in rows] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")


def _write_obj(path: Path, vertices: Array, normals: Array, faces: NDArray[np.int64]) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{k}//{k}" for k in face) for face in faces + 1]
    path.write_text("\n".join(lines) + "\n")
