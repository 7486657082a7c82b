"""Scene of a scan whose points a camera sees: with a relay wall where all of them lie on one, else without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from nlosrender.config.hidden_geometry import RectangleConfig
from nlosrender.config.relay_wall import CylinderWallConfig, RectangleWallConfig, SphereWallConfig
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import box_corners, joined_bounds
from nlosrender.scene.build import BuiltScene, SceneWithoutWall, build_scene
from nlosrender.scene.loading.first_hits import pixel_points
from nlosrender.scene.loading.loaded_surfaces import CORNERS, loaded_surface, to_world_of_shape
from nlosrender.scene.loading.materials import LOADED
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID, shape_bounds, triangles_of
from nlosrender.scene.loading.number_of_shape import pointer_index
from nlosrender.scene.picture_orientation import has_picture
from nlosrender.scene.pixel_points import PixelPoints
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.surfaces import Surface, all_surfaces
from nlosrender.scene.view import BuiltView, build_view
from nlosrender.scene.walls.any_surface import AnySurface
from nlosrender.scene.walls.wall import RectangleWall, RelayWall
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig
    from nlosrender.config.scene import SceneConfig

FLATNESS = 1e-5  # of a rectangle's size: corners of a file are float32, and rounded in decimals


def build_pixel_scene(scene_config: SceneConfig, capture_config: CaptureConfig) -> BuiltScene:
    """Build the scene of a scan with a camera; the backend has to be started before.

    Raises
    ------
    ConfigError
        As of ``build_view``; no pixel sees a surface, or a beam of the laser meets none.
    """
    view = build_view(scene_config, capture_config)
    pixels = pixel_points(view, capture_config)
    if pixels.areas is not None:
        return _scene_without_wall(view, pixels, "sensor points stand for all that their pixels see")
    try:
        built = _scene_with_wall(view, scene_config, pixels)
    except _NoWallError as obstacle:
        return _scene_without_wall(view, pixels, str(obstacle))
    warnings = tuple(dict.fromkeys((*view.warnings, *built.warnings)))
    return replace(built, pixels=pixels, warnings=warnings, meshes=view.meshes)


class _NoWallError(Exception):
    """Why laser and sensor points lie on no rectangle that can be the relay wall."""


def _scene_without_wall(view: BuiltView, pixels: PixelPoints, reason: str) -> SceneWithoutWall:
    box = joined_bounds([shape_bounds(shape, view.metres_per_engine_unit) for shape in view.hidden_shapes])
    assert box is not None  # a ray has met something
    built = SceneWithoutWall(
        scene=view.scene,
        wall=AnySurface(view.frame, box, pixels.sensors.origin),
        wall_shape=None,
        surfaces=view.surfaces,
        hidden_shapes=view.hidden_shapes,
        hidden_bounds=box,
        metres_per_engine_unit=view.metres_per_engine_unit,
        n_triangles=view.n_triangles,
        warnings=view.warnings,
        meshes=view.meshes,
        pixels=pixels,
        reason=reason,
    )
    built.set_up()
    return built


def _scene_with_wall(view: BuiltView, scene_config: SceneConfig, pixels: PixelPoints) -> BuiltScene:
    """Build the scene before the relay wall that all points lie on; _NoWallError where there is none."""
    both = pixels.sensors, pixels.lasers
    numbers = {int(number) for hits in both for number in np.unique(hits.shapes[~hits.is_empty])}
    if len(numbers) > 1:
        raise _NoWallError(f"laser and sensor points lie on {len(numbers)} surfaces")
    shape = view.scene.shapes()[numbers.pop()]
    place = [pointer_index(own) for own in view.hidden_shapes].index(pointer_index(shape))
    surface = view.surfaces[place] if place < len(view.surfaces) else None
    name = f"a surface of scene.mitsuba ({shape.id()})" if surface is None else surface.key
    if scene_config.relay_wall is not None and (surface is None or surface.name != WALL_ID):
        raise _NoWallError(f"laser and sensor points lie on {name}, not on scene.relay_wall")
    fronts = np.concatenate([hits.is_front[hits.is_reached] for hits in both])
    if fronts.any() and not fronts.all():
        raise _NoWallError(f"{name} is seen or lit from both sides")
    is_front = bool(fronts.all())
    if not is_front and not shape.bsdf().flags() & mi.BSDFFlags.BackSide:
        raise _NoWallError(f"{name} is seen from behind, where it is black")
    bsdf = {LOADED: shape.bsdf()} if surface is None else _lit_side(surface.bsdf, is_front)
    has_uvs = any(key.endswith((".data", ".to_uv")) for key, _ in mi.traverse(shape.bsdf()))
    if has_picture(bsdf) or has_uvs or "MeshAttribute" in str(shape.bsdf()):
        raise _NoWallError(f"{name} has a picture")
    if bool(shape.bsdf().flags() & mi.BSDFFlags.Transmission):
        raise _NoWallError(f"{name} lets light through")
    wall = _configured_wall(scene_config, surface, is_front) or _wall_of(view, shape, pixels, name)
    others = (own for index, own in enumerate(view.hidden_shapes) if index != place)
    lowest = min((float(wall.pose.to_local(_corners(view, own))[:, 2].min()) for own in others), default=0.0)
    if scene_config.relay_wall is None and lowest < -FLATNESS * max(wall.width, wall.height):
        raise _NoWallError(f"{name}, which laser and sensor points lie on, has surfaces behind it")
    configured = [item for item in all_surfaces(scene_config, wall.pose) if surface is None or item.key != surface.key]
    whole = [(index, own) for index, own in enumerate(view.hidden_shapes) if index >= len(view.surfaces)]
    in_scene = wall.pose.seen_from(view.frame)
    try:
        loaded = [loaded_surface(own, in_scene, index) for index, own in whole if index != place]
    except ConfigError as error:
        raise _NoWallError(f"virtual lights do not take {error.issues[0]}") from error
    return build_scene(wall, bsdf, [*configured, *loaded])


def _lit_side(bsdf: Mapping[str, object], is_front: bool) -> Mapping[str, object]:
    """Return what a BSDF dictionary has on one side, without the wrapper of two."""
    nested = [part for part in bsdf.values() if isinstance(part, Mapping)]
    return nested[0 if is_front else -1] if bsdf.get("type") == "twosided" and nested else bsdf


def _configured_wall(scene_config: SceneConfig, surface: Surface | None, is_front: bool) -> RelayWall | None:
    """Return the wall of a rectangle, or a round relay wall, as configured, with its pose; None for other surfaces."""
    item: object = scene_config.relay_wall
    if isinstance(item, (SphereWallConfig, CylinderWallConfig)) and is_front:
        return relay_wall_from_config(item)
    if surface is not None and surface.key.startswith("scene.hidden_geometry."):
        item = scene_config.hidden_geometry[int(surface.key.rsplit(".", 1)[1])]
    if not isinstance(item, (RectangleConfig, RectangleWallConfig)) or surface is None:
        return None
    normal = np.array(item.normal) * (1 if is_front else -1)
    return RectangleWall(Pose.from_normal_up(item.center, normal, item.up), float(item.width), float(item.height))


def _wall_of(view: BuiltView, shape: mi.Shape, pixels: PixelPoints, name: str) -> RectangleWall:
    """Return the wall of a shape that is a flat rectangle, upright in the camera's picture; else _NoWallError."""
    corners = np.unique(_corners(view, shape), axis=0)
    if not shape.is_mesh() or len(corners) != 4 or shape.face_count() != 2:
        raise _NoWallError(f"laser and sensor points lie on {name}, which is no rectangle")
    order = np.argsort(np.linalg.norm(corners - corners[0], axis=1))
    first, second = (corners[number] - corners[0] for number in order[1:3])
    size = float(np.linalg.norm(corners[order[3]] - corners[0]))
    is_even = np.linalg.norm(corners[0] + first + second - corners[order[3]]) < FLATNESS * size
    if not is_even or abs(first @ second) > FLATNESS * size**2:
        raise _NoWallError(f"laser and sensor points lie on {name}, which is no rectangle")
    picture_up = view.wall.pose.direction_to_scene([0.0, 1.0, 0.0])
    x_edge, y_edge = sorted((first, second), key=lambda edge: abs(float(edge @ picture_up)) / np.linalg.norm(edge))
    hits = pixels.sensors
    normal = pixels.frame.direction_to_scene(hits.normals[hits.is_reached][0])
    pose = Pose.from_normal_up(corners.mean(axis=0), normal, y_edge * np.sign(y_edge @ picture_up))
    return RectangleWall(pose, float(np.linalg.norm(x_edge)), float(np.linalg.norm(y_edge)))


def _corners(view: BuiltView, shape: mi.Shape) -> Float64:
    """Return the vertices (n, 3) of a shape, or the corners of its box [m, scene]."""
    unit = view.metres_per_engine_unit
    if shape.class_name() == "Rectangle":
        to_world = to_world_of_shape(shape)
        points = CORNERS @ to_world[:3, :3].T + to_world[:3, 3]
    elif shape.is_mesh():
        points = triangles_of(shape).vertices
    else:
        box = shape_bounds(shape, 1.0)
        points = np.zeros((1, 3)) if box is None else box_corners(box)
    return view.frame.to_scene(np.asarray(points, dtype=np.float64) * unit)
