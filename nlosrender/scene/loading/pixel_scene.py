"""Scene of a scan whose points a camera sees: with a relay wall where they lie on one rectangle, else without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from nlosrender.config.hidden_geometry import RectangleConfig
from nlosrender.scene.bounding_box import box_corners, joined_bounds
from nlosrender.scene.build import BuiltScene, SceneWithoutWall, build_scene
from nlosrender.scene.loading.first_hits import pixel_points
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID, shape_bounds
from nlosrender.scene.loading.number_of_shape import pointer_index
from nlosrender.scene.picture_orientation import has_picture
from nlosrender.scene.pixel_points import PixelPoints
from nlosrender.scene.pose import Pose
from nlosrender.scene.surfaces import hidden_surfaces
from nlosrender.scene.view import BuiltView, build_view
from nlosrender.scene.walls.any_surface import AnySurface
from nlosrender.scene.walls.wall import RectangleWall

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig
    from nlosrender.config.hidden_geometry import HiddenItemConfig
    from nlosrender.config.relay_wall import RelayWallConfig
    from nlosrender.config.scene import SceneConfig

TWO_SIDED = mi.BSDFFlags.BackSide | mi.BSDFFlags.Transmission
IN_FRONT = 1e-6  # of the rectangle's size: float32 rounds what stands on its plane


def build_pixel_scene(scene_config: SceneConfig, capture_config: CaptureConfig) -> BuiltScene:
    """Build the scene of a scan with a camera; the backend has to be started before.

    Raises
    ------
    ConfigError
        As of ``build_view``; no pixel sees a surface, or a beam of the laser meets none.
    """
    view = build_view(scene_config, capture_config)
    pixels = pixel_points(view, capture_config)
    found = _rectangle(view, scene_config, pixels)
    if isinstance(found, _Rectangle):
        items = hidden_surfaces(scene_config.hidden_geometry, found.wall.pose)
        others = [item for item in items if item.key != found.key]
        return replace(build_scene(found.wall, found.bsdf, others), pixels=pixels)
    boxes = [shape_bounds(shape, view.metres_per_engine_unit) for shape in view.hidden_shapes]
    box = joined_bounds(boxes)
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
        reason=found,
    )
    built.set_up()
    return built


@dataclass(frozen=True, eq=False)
class _Rectangle:
    """The relay wall that a configuration has, without saying so."""

    key: str
    wall: RectangleWall
    bsdf: Mapping[str, object]


def _rectangle(view: BuiltView, scene_config: SceneConfig, pixels: PixelPoints) -> _Rectangle | str:
    """Return the rectangle that laser and sensor points lie on, or why they lie on none."""
    both = pixels.sensors, pixels.lasers
    numbers = {int(number) for hits in both for number in np.unique(hits.shapes[~hits.is_empty])}
    if len(numbers) > 1:
        return f"laser and sensor points lie on {len(numbers)} surfaces"
    shape = view.scene.shapes()[numbers.pop()]
    configured = zip(view.surfaces, view.hidden_shapes[: len(view.surfaces)], strict=True)
    surface = next((item for item, own in configured if pointer_index(own) == pointer_index(shape)), None)
    if surface is None:
        return "laser and sensor points lie on a surface of scene.mitsuba"
    item: RelayWallConfig | HiddenItemConfig | None = scene_config.relay_wall
    if item is None:
        item = scene_config.hidden_geometry[int(surface.key.rsplit(".", 1)[1])]
    elif surface.name != WALL_ID:
        return f"laser and sensor points lie on {surface.key}, not on scene.relay_wall"
    if item.type != "rectangle" or has_picture(item.bsdf):
        return f"laser and sensor points lie on {surface.key}, which is no plain rectangle"
    if bool(shape.bsdf().flags() & TWO_SIDED):
        return f"{surface.key}, which laser and sensor points lie on, reflects on its back, too"
    if not all(hits.is_front[hits.is_reached].all() for hits in both):
        return f"{surface.key} is seen or lit from behind"
    wall = RectangleWall(Pose.from_normal_up(item.center, item.normal, item.up), float(item.width), float(item.height))
    boxes = [shape_bounds(other, view.metres_per_engine_unit) for other in view.scene.shapes()]
    heights = [wall.pose.to_local(view.frame.to_scene(box_corners(box)))[:, 2].min() for box in boxes if box]
    if isinstance(item, RectangleConfig) and min(heights) < -IN_FRONT * max(wall.width, wall.height):
        return f"{surface.key}, which laser and sensor points lie on, has surfaces behind it"
    return _Rectangle(surface.key, wall, item.bsdf)
