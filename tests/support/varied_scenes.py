"""Scenes chosen to break the virtual lights, each for a reason of its own, and how they are rendered again and again.

Every sensor point of a batch looks at the same sites, so that its errors go along with those of its neighbours, and
so do the bins of one row: variances of bins may not be added. What is tested is therefore always a sum (of bins, rows)
whose noise is the spread of that same sum over independent seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages
from support.engines import with_options
from support.rendering import configured, flat_wall

Array = NDArray[np.float64]
Item = dict[str, Any]


def diffuse(reflectance: Any) -> Item:
    """Return a one-sided Lambertian BSDF."""
    return {"type": "diffuse", "reflectance": reflectance}


def plate(center: Sequence[float], normal: Sequence[float], size: tuple[float, float], bsdf: Any = 0.7) -> Item:
    """Return a rectangle; a number or colour is the reflectance of a Lambertian one."""
    kind = bsdf if isinstance(bsdf, dict) else diffuse(bsdf)
    at = {"center": list(center), "normal": list(normal), "width": size[0], "height": size[1]}
    up = [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 * math.hypot(*normal) else [1.0, 0.0, 0.0]
    return {"type": "rectangle", **at, "up": up, "bsdf": kind}


def ball(center: Sequence[float], radius: float, reflectance: Any = 0.7, inside: bool = False) -> Item:
    """Return a Lambertian sphere."""
    return {
        "type": "sphere",
        "center": list(center),
        "radius": radius,
        "inside": inside,
        "bsdf": diffuse(reflectance),
    }


def room(size: Sequence[float], reflectance: Any = 0.5) -> Item:
    """Return a Lambertian room before the wall."""
    return {"type": "room", "size": list(size), "bsdf": diffuse(reflectance)}


def waves_mesh(folder: Path) -> str:
    """Write a coarse wavy sheet of 0.8 x 0.6 m with the normals of the smooth surface; return the file's name.

    Its vertex normals differ from those of its faces by up to 20 degrees.
    """
    nx, ny = 7, 6
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-0.4, 0.4, nx), np.linspace(-0.3, 0.3, ny)))
    z, slope = 0.05 * np.sin(9 * x), 0.45 * np.cos(9 * x)
    normals = np.stack([slope, np.zeros_like(x), -np.ones_like(x)], axis=1)  # towards -z
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel() + 1
    lines = [f"v {a:.9g} {b:.9g} {c:.9g}" for a, b, c in zip(x, y, z, strict=True)]
    lines += [f"vn {a:.9g} {b:.9g} {c:.9g}" for a, b, c in normals]
    for first, second, third in zip(corner, corner + nx, corner + 1, strict=True):
        lines.append(f"f {first}//{first} {second}//{second} {third}//{third}")
        fourth = second + 1
        lines.append(f"f {third}//{third} {second}//{second} {fourth}//{fourth}")
    (folder / "waves.obj").write_text("\n".join(lines) + "\n")
    return "waves.obj"


@dataclass(frozen=True, eq=False)
class Stage:
    """A configured capture with its engine, ready to be rendered with any seed."""

    engine: Any
    batch: Any  # the whole capture
    bounces: Any

    @classmethod
    def of(cls, config: Item, folder: Path | None = None) -> Stage:
        """Set up the engine that a configuration leads to."""
        validated = configured(config, folder=folder)
        backend = start_backend("llvm", colored=validated.is_colored)
        built = stages.load_scene(validated)
        capture, time_axis = stages.describe_capture(validated, built.wall, built)
        plan, engine = stages.prepare(validated, backend, built, capture, time_axis)
        first = plan.batches[0]
        grids = {"sensors": capture.sensor_grid, "lasers": capture.laser_grid}
        whole = {
            name: replace(getattr(first, name), y0=0, y1=grid.ny, x0=0, x1=grid.nx) for name, grid in grids.items()
        }
        return cls(engine, replace(first, **whole), engine.options.bounces)

    def seeded(self, seed: int) -> Any:
        """Return the engine with another seed."""
        return with_options(self.engine, seed=seed)

    def tuned(self, **changes: Any) -> Stage:
        """Return the stage with other numbers of ``VirtualLightTuning``."""
        from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
        from nlosrender.engine.virtual_lights.visibility.masks import VisibilityMasks

        engine = self.engine
        tuning = replace(engine.tessellator.tuning, **changes)
        bin_width = engine.time_axis.bin_width_opl / engine.built.metres_per_engine_unit
        engine.tessellator = Tessellator(engine.built, engine.capture, bin_width, tuning=tuning)
        for part in (engine.third, *([engine.further] if engine.further else [])):
            part.tessellator = engine.tessellator
            part.masks = VisibilityMasks(engine.built, tuning) if part.masks is not None else None
        engine.third.forget()
        return self

    def repeated(self, budget: Any, seeds: Sequence[int]) -> Repeated:
        """Render the capture once per seed."""
        results = [self.seeded(seed).render(self.batch, budget) for seed in seeds]
        return Repeated(
            np.stack([result.mean for result in results]),
            np.stack([result.variance for result in results]),
            np.stack([result.outside for result in results]),
        )


@dataclass(frozen=True, eq=False)
class Repeated:
    """Independent renders of a capture, (seed, channel, bounce, laser, sensor, bin)."""

    means: Array
    variances: Array  # as the engine states them
    outsides: Array  # (seed, channel, bounce, laser, sensor)

    @property
    def mean(self) -> Array:
        """Mean over the seeds."""
        return self.means.mean(axis=0)


@dataclass(frozen=True, eq=False)
class Trap:
    """A scene and what may go wrong in it."""

    point: str
    hidden: tuple[Item, ...]
    settings: Item  # of ``flat_wall``
    is_quick: bool = False

    def config(self, engine: str = "virtual_lights", **render: Any) -> Item:
        """Return the configuration for an engine; ``render`` adds to its section."""
        settings: Item = {"bins": (0.2, 0.06, 80), "max_bounces": 5, "spp": None, "target_error": 0.01} | self.settings
        return flat_wall(*self.hidden, engine=engine, **(settings | render))

    def stage(self, folder: Path, engine: str = "virtual_lights", **render: Any) -> Stage:
        """Set it up; meshes are written to ``folder``."""
        waves_mesh(folder)
        config = self.config(engine, **render)
        return Stage.of(config, folder)


SLANTED = plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6))
SIDE = plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), 0.8)
GREY_WALL = {"bsdf": diffuse(0.5)}
LEGS = {"account_first_and_last_bounces": True, "laser_position": [-0.5, 0, 0.25], "sensor_position": [0.4, 0.3, 1.1]}
CHECKER = {"type": "checkerboard", "color0": 0.2, "color1": 0.9}
WAVES = {"type": "mesh", "filename": "waves.obj", "translate": [0.1, 0.0, 0.6], "bsdf": diffuse(0.8)}

TRAPS = {
    "two facing plates": Trap(
        "bounces 4 and 5 go over both plates and back over the wall",
        (SLANTED, SIDE),
        {"wall": GREY_WALL},
    ),
    "occluders": Trap(
        "a grey screen and a ball hide parts of a plate from the laser, from the sensors and from each other",
        (SLANTED, plate((0.3, 0.0, 0.35), (0.1, 0.0, -1.0), (0.25, 0.3), 0.4), ball((-0.1, 0.2, 0.4), 0.1), SIDE),
        {"max_bounces": 4},
    ),
    "thin sheets": Trap(
        "two sheets 4 mm apart, one hiding most of the other, before a plate that lights them from behind",
        (
            plate((0.1, 0.0, 0.5), (0.0, 0.0, -1.0), (0.5, 0.5), 0.6),
            plate((0.15, 0.05, 0.504), (0.0, 0.0, -1.0), (0.5, 0.5), 0.9),
            plate((0.1, 0.0, 0.508), (0.0, 0.0, 1.0), (0.5, 0.5), 0.8),
            plate((0.1, 0.0, 0.9), (0.1, 0.0, -1.0), (1.4, 1.2), 0.8),
        ),
        {"wall": GREY_WALL},
    ),
    "thick letters": Trap(
        "a solid letter: its own flanks hide and light each other; one side faces the wall edge on",
        (
            {"type": "letters", "text": "ZE", "height": 0.6, "thickness": 0.1, "center": [0.0, 0.0, 0.5]}
            | {"normal": [0.1, 0.0, -1.0], "bsdf": diffuse(0.8)},
        ),
        {},
    ),
    "standing on the wall": Trap(
        "a plate that touches the wall between the sensor points, 10 cm from some of them",
        (plate((0.52, 0.0, 0.3), (-1.0, 0.0, 0.0), (0.6, 0.6), 0.8), SLANTED),
        {"max_bounces": 4, "bins": (0.0, 0.06, 80)},
        is_quick=True,
    ),
    "through the wall": Trap(
        "a plate and a ball that cross the plane of the wall: what lies behind it is neither lit nor seen",
        (
            plate((0.0, 0.45, 0.1), (0.3, -1.0, -0.2), (0.8, 0.6), 0.8),
            ball((-0.62, -0.24, 0.05), 0.15, 0.9),
            plate((0.3, 0.0, 0.7), (0.0, 0.0, -1.0), (0.5, 0.5)),
        ),
        {"bins": (0.0, 0.06, 80), "wall": {"bsdf": diffuse(0.8)}},
    ),
    "slanted wall": Trap(
        "a wall off the origin, in a general pose, with legs that are no whole number of bins",
        (
            plate((0.95, 0.15, 1.8), (-0.5, -0.3, -1.0), (0.9, 0.7), 0.8),
            ball((0.15, 0.2, 1.7), 0.2, 0.6),
            plate((0.3, -0.6, 1.7), (0.1, 1.0, 0.1), (0.9, 0.6), 0.9),
        ),
        {
            "wall": {"center": [0.5, -0.3, 1.0], "normal": [0.3, 0.2, 1.0], "up": [0.1, 1.0, 0.3]},
            "capture": LEGS | {"laser_position": [0.3, 0.0, 1.6], "sensor_position": [0.9, 0.2, 2.1]},
            "bins": (1.0, 0.07, 90),
        },
    ),
    "checkerboard": Trap(
        "a reflectance that jumps within patches and within the cells that sites are drawn from",
        (
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), diffuse(CHECKER)),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), diffuse(CHECKER)),
        ),
        {"color": "grey"},
    ),
    "rough metal": Trap(
        "BSDFs that are not Lambertian, in the gather of patches and of VPLs",
        (
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), {"type": "roughconductor", "alpha": 0.4}),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), {"type": "roughplastic", "alpha": 0.3}),
            ball((0.2, 0.5, 0.5), 0.15),
        ),
        {"max_bounces": 4},
    ),
    "colour": Trap(
        "three channels with reflectances of their own; the grey expectation of walks fits none of them",
        (
            plate((0.15, -0.1, 0.6), (0.2, -0.1, -1.0), (0.8, 0.6), [0.9, 0.3, 0.05]),
            plate((-0.6, 0.0, 0.55), (1.0, 0.1, -0.2), (0.6, 0.8), [0.05, 0.5, 0.9]),
        ),
        {"wall": {"bsdf": diffuse([0.9, 0.6, 0.3])}, "max_bounces": 4},
    ),
    "closed room": Trap(
        "a room that closes with the wall: all bounces, corners where surfaces meet the wall",
        (room((2.0, 1.6, 1.3), 0.6),),
        {"max_bounces": None, "bins": (0.0, 0.1, 120), "wall": {"bsdf": diffuse(0.7)}},
        is_quick=True,
    ),
    "furnished room": Trap(
        "a room wider than the wall with a box and a ball on its floor: no light is seen whole",
        (
            room((2.6, 2.0, 1.5), 0.6),
            {"type": "box", "center": [0.4, -0.6, 0.8], "size": [0.5, 0.8, 0.4], "rotate_deg": [0, 30, 0]}
            | {"bsdf": diffuse(0.8)},
            ball((-0.5, -0.6, 0.6), 0.3, 0.9),
        ),
        {"max_bounces": 6, "bins": (0.0, 0.1, 90), "wall": GREY_WALL},
    ),
    "inside a sphere": Trap(
        "the wall lies in a sphere seen from within: curved cells that face each other, all bounces",
        (ball((0.1, 0.0, 0.3), 1.6, 0.5, inside=True),),
        {"max_bounces": None, "bins": (0.5, 0.1, 100), "wall": GREY_WALL},
    ),
    "three balls": Trap(
        "round shapes that hide and light each other, every sensor point for every laser point",
        (ball((0.1, -0.1, 0.6), 0.25, 0.9), ball((-0.42, 0.2, 0.7), 0.3, 0.8), ball((0.5, 0.35, 0.55), 0.18, 0.9)),
        {"scan": "exhaustive", "sensors": (3, 2), "lasers": (2, 3), "wall": GREY_WALL},
    ),
    "smooth waves": Trap(
        "a mesh whose shading normals differ from its faces', lit from its side",
        (WAVES, SIDE),
        {"max_bounces": 4, "wall": GREY_WALL},
    ),
    "small grid, late window": Trap(
        "sensor points on a corner of an off-centre wall, a window that cuts most of the light, legs counted",
        (plate((0.55, -0.4, 0.9), (0.2, -0.1, -1.0), (0.8, 0.6)), plate((-0.2, -0.3, 0.7), (1, 0, -0.2), (0.6, 0.8))),
        {
            "wall": {"center": [0.4, -0.3, 0.2]},
            "capture": LEGS | {"sensor_grid": {"nx": 5, "ny": 3, "width": 0.8, "height": 0.5}},
            "bins": (3.9, 0.05, 12),
        },
    ),
    "confocal": Trap(
        "laser and sensor on one point: walks have no laser of their own and are traced",
        (SLANTED, ball((-0.45, 0.2, 0.7), 0.25), SIDE),
        {"scan": "confocal", "max_bounces": 4},
    ),
    "5D with a screen": Trap(
        "every pair of points of two grids in one batch; legs; lasers that see different halves of the scene",
        (SLANTED, SIDE, plate((0.0, 0.0, 0.3), (1.0, 0.0, -0.1), (0.4, 1.2), 0.6)),
        {"scan": "exhaustive", "sensors": (3, 2), "lasers": (3, 3), "capture": LEGS, "bins": (1.0, 0.07, 80)}
        | {"max_bounces": 6, "wall": GREY_WALL},
    ),
    "white corridor": Trap(
        "white surfaces on three sides: many bounces carry the light, none may be lost by the roulette",
        (
            plate((0.7, 0.0, 0.5), (-1.0, 0.0, 0.0), (1.0, 1.2), 0.95),
            plate((-0.7, 0.0, 0.5), (1.0, 0.0, 0.0), (1.0, 1.2), 0.95),
            plate((0.0, 0.0, 1.1), (0.0, 0.0, -1.0), (1.4, 1.2), 0.95),
        ),
        {"max_bounces": None, "bins": (0.0, 0.08, 100)},
    ),
    "summed bounces": Trap(
        "clutter of a box, a flat letter and a ball; bounces share one index",
        (
            {"type": "box", "center": [0.3, -0.2, 0.6], "size": [0.3, 0.4, 0.2], "rotate_deg": [20, 30, 10]},
            {"type": "letters", "text": "T", "height": 0.6, "center": [-0.3, 0.1, 0.7], "normal": [0.3, 0.0, -1.0]},
            ball((0.1, 0.4, 0.5), 0.15),
            SIDE,
        ),
        {"split_bounces": False, "max_bounces": 6},
    ),
    "mirror wall": Trap(
        "a room with one side of gold: its images of lasers, of sensor points and of VPLs, behind a ball",
        (
            plate((0.0, 0.0, 1.3), (0.0, 0.0, -1.0), (2.0, 1.6), 0.6),
            plate((-1.0, 0.0, 0.65), (1.0, 0.0, 0.0), (1.3, 1.6), 0.6),
            plate((0.9, 0.0, 0.65), (-1.0, 0.1, -0.2), (1.3, 1.6), {"type": "conductor", "material": "Au"}),
            ball((0.3, 0.1, 0.5), 0.15, 0.8),
        ),
        {"max_bounces": 6, "bins": (0.0, 0.1, 90), "wall": GREY_WALL},
    ),
    "mirror behind, exhaustive": Trap(
        "a two-sided mirror mesh whose edges cut the images, all pairs of points, legs, a checkerboard seen in it",
        (
            plate((0.15, -0.1, 0.6), (0.2, -0.1, 1.0), (0.8, 0.6), diffuse(CHECKER)),
            SIDE,
            plate((0.1, 0.1, 1.2), (0.1, -0.2, -1.0), (0.9, 0.8), {"type": "twosided", "bsdf": {"type": "conductor"}}),
        ),
        {"scan": "exhaustive", "sensors": (3, 2), "lasers": (3, 2), "capture": LEGS, "bins": (1.0, 0.07, 80)}
        | {"max_bounces": 5, "wall": GREY_WALL, "color": "grey"},
    ),
    "only third": Trap(
        "nothing but the third bounce of two surfaces in each other's shadow",
        (SLANTED, ball((0.1, 0.0, 0.3), 0.12)),
        {"max_bounces": 3},
    ),
}
