"""What is legal in a config but hardly meant: said before a render, never refused."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from nlosrender.config.document import Config
from nlosrender.config.hidden_geometry import (
    BoxConfig,
    CylinderConfig,
    HiddenItemConfig,
    LettersConfig,
    RectangleConfig,
    SphereConfig,
)
from nlosrender.config.relay_wall import RectangleWallConfig
from nlosrender.config.vectors import length

FLOAT32_ROUNDING = 2.0**-24  # relative, at most


def config_warnings(config: Config) -> tuple[str, ...]:
    """Return one sentence for each thing in a valid config that is pointless or surprising."""
    if config.capture.is_line_of_sight:
        return (*config.notes, *_dark_view(config), *_budget(config))
    if config.has_pixel_points:
        return (*config.notes, *_budget(config), *_file(config))
    return (
        *config.notes,
        *_dark_scene(config),
        *_behind_the_wall(config),
        *_bounces(config),
        *_budget(config),
        *_file(config),
    )


def _dark_view(config: Config) -> Iterator[str]:
    if not config.scene.emitters and config.scene.mitsuba is None:
        yield "scene.emitters is empty: nothing shines, the picture is black."


def _dark_scene(config: Config) -> Iterator[str]:
    items = config.scene.hidden_geometry
    if not items:
        yield "scene.hidden_geometry is empty: only light that stays on the relay wall is left, none on a flat one."
    if items and all(_is_black(item.bsdf) for item in items):
        yield "every hidden item has reflectance 0: nothing comes back from the hidden scene."
    if _is_black(config.scene.wall.bsdf):
        yield "scene.relay_wall.bsdf has reflectance 0: H is zero everywhere."


def _is_black(bsdf: Mapping[str, object]) -> bool:
    if bsdf.get("type") == "twosided":
        nested = [value for value in bsdf.values() if isinstance(value, Mapping)]
        return all(_is_black(value) for value in nested)
    return bsdf.get("type") == "diffuse" and bsdf.get("reflectance") in (0.0, (0.0, 0.0, 0.0))


def _behind_the_wall(config: Config) -> Iterator[str]:
    wall = config.scene.relay_wall
    if not isinstance(wall, RectangleWallConfig):
        return
    for index, item in enumerate(config.scene.hidden_geometry):
        sphere = _bounding_sphere(item)
        if sphere is not None and wall.height_above(sphere[0]) + sphere[1] <= 0:
            yield f"scene.hidden_geometry.{index} ({item.name}) lies behind the relay wall, where no light gets to."


def _bounding_sphere(item: HiddenItemConfig) -> tuple[tuple[float, float, float], float] | None:
    """Return centre and radius [m] of a sphere around an item; None where only its file or the wall tells."""
    if isinstance(item, RectangleConfig):
        return item.center, math.hypot(item.width, item.height) / 2
    if isinstance(item, LettersConfig):
        # Twice what is needed: no letter is wider than twice its height.
        width = len(item.text) * (2 * item.height + (item.spacing or item.height))
        return item.center, math.hypot(width, item.height, item.thickness)
    if isinstance(item, BoxConfig):
        return item.center, length(item.size) / 2
    if isinstance(item, SphereConfig):
        return item.center, item.radius
    if isinstance(item, CylinderConfig):
        return item.center, math.hypot(item.radius, item.height / 2)
    return None


def _bounces(config: Config) -> Iterator[str]:
    if config.render.max_bounces == 2 and config.scene.wall.type == "rectangle":
        yield "render.max_bounces is 2: no light goes straight from a point of a flat wall to another, H is zero."


def _budget(config: Config) -> Iterator[str]:
    target = config.render.target_error
    if target is not None and target < FLOAT32_ROUNDING:
        yield (
            f"render.target_error is {target:g}: the samples of the file are 32-bit numbers, rounded by "
            f"{FLOAT32_ROUNDING:.0e}; no render gets there."
        )
    if config.render.spp is None and config.render.target_error is None and config.render.time_limit_s is not None:
        yield "render.time_limit_s alone: the error is whatever the time allows; the file says how large it is."
    if config.render.max_bounces is None and not config.render.russian_roulette:
        yield (
            "render.max_bounces is null and russian_roulette false: paths end when they leave the scene or carry "
            "nothing, and in a closed one that may take for ever. Limit max_bounces."
        )


def _file(config: Config) -> Iterator[str]:
    if config.time_axis.start_opl != 0.0:
        yield "time_axis.start_opl is not 0: many Z-NLOS loaders ignore t0 and shift the capture."
    if not config.capture.account_first_and_last_bounces:
        yield "capture.account_first_and_last_bounces is false: Z-NLOS loaders expect the first and last legs in time."
    capture = config.capture
    grid = capture.sensor_grid
    nx, what = (capture.n_sensors, "sensor_points has 6") if grid is None else (grid.nx, "sensor_grid.nx is 6")
    if capture.scan_type != "confocal" and nx == 6:
        yield (
            f"capture.{what}: y-tal's converter finds the bounce axis by its length 6, and takes the sensor's for it. "
            "Use another number if the file is meant for y-tal."
        )
