"""Scene of a line-of-sight capture -> Mitsuba: surfaces, lamps and a whole Mitsuba scene, in engine units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from nlosrender.config.emitters import PointLamp, SpotLamp
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import Bounds, bounds_of, box_corners, joined_bounds
from nlosrender.scene.build import EngineScene, count_triangles
from nlosrender.scene.loading.loaded_surfaces import with_vertices
from nlosrender.scene.loading.materials import check_surface, medium_warnings, mitsuba_spectrum
from nlosrender.scene.loading.mitsuba_shapes import load_surface, shape_bounds
from nlosrender.scene.loading.separation import load_separated
from nlosrender.scene.loading.xml_loading import WHERE, load_xml_scene
from nlosrender.scene.meshes.mesh_report import MeshReport
from nlosrender.scene.meshes.primitives import rectangle_mesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import has_picture, readable, upright_bsdf
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.read_surfaces import read_surfaces
from nlosrender.scene.surfaces import ShapeDescription, Surface, all_surfaces
from nlosrender.scene.walls.image_plane import ImagePlane, image_plane
from nlosrender.scene.walls.wall import RectangleWall, RelayWall
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig
    from nlosrender.config.scene import SceneConfig


@dataclass(frozen=True, eq=False, kw_only=True)
class BuiltView(EngineScene):
    """A scene seen by a camera. The local frame is that of the image plane."""

    wall: ImagePlane
    frame: Pose  # of the engine, in the scene

    def to_engine(self, positions: ArrayLike) -> Float64:
        """Take positions (..., 3) [m] of the local frame to the engine's [engine units]."""
        return self.frame.to_local(self.wall.pose.to_scene(positions)) / self.metres_per_engine_unit

    def direction_to_engine(self, directions: ArrayLike) -> Float64:
        """Take directions (..., 3) of the local frame to the engine's; their lengths stay."""
        return self.frame.direction_to_local(self.wall.pose.direction_to_scene(directions))


def build_view(scene_config: SceneConfig, capture_config: CaptureConfig) -> BuiltView:
    """Build the Mitsuba scene of a line-of-sight capture; the backend has to be started before.

    Parameters
    ----------
    scene_config, capture_config
        ``scene`` and ``capture``.

    Raises
    ------
    ConfigError
        Mitsuba rejects a shape, a BSDF or the scene's file, a mesh cannot be read, or a pose is degenerate; the item is
        named.
    """
    whole: mi.Scene | None = None
    of_whole: tuple[MeshReport, ...] = ()
    left_out: tuple[str, ...] = ()
    if scene_config.mitsuba is not None:
        # the shapes of a scan are told apart: those with points on them, and those to be sampled
        joins_meshes = capture_config.is_line_of_sight
        whole, of_whole, left_out = load_xml_scene(scene_config.mitsuba, joins_meshes=joins_meshes)
    try:
        plane = _image_plane(capture_config, whole)
    except ValueError as error:
        raise ConfigError.at("capture.camera", f"{error}.") from error
    wall = None if scene_config.relay_wall is None else relay_wall_from_config(scene_config.relay_wall)
    frame = _engine_frame(scene_config, wall, plane)
    surfaces = all_surfaces(scene_config, frame)
    if wall is not None:
        as_mesh = isinstance(wall, RectangleWall) and not capture_config.is_line_of_sight
        surfaces = (_wall_surface(wall, scene_config.wall.bsdf, frame, as_mesh=as_mesh), *surfaces)
    read = read_surfaces(surfaces)
    lamps = [item for item in scene_config.emitters if isinstance(item, (PointLamp, SpotLamp))]
    points = [frame.to_local(lamp.position) for lamp in lamps]
    camera = frame.to_local(plane.pose.to_scene(plane.default_device_position))
    unit = 1.0 if whole is not None else _unit_length([shape.bounds() for shape in read.shapes], [*points, camera])
    if capture_config.is_line_of_sight:
        shapes = [load_surface(surface, shape, unit) for surface, shape in zip(surfaces, read.shapes, strict=True)]
        coincident: tuple[str, ...] = ()
    else:
        _, shapes, coincident = load_separated(surfaces, read.shapes, None, unit)
    contents: dict[str, object] = {f"lamp_{index}": _lamp(lamp, frame, unit) for index, lamp in enumerate(lamps)}
    if whole is not None:
        is_view = capture_config.is_line_of_sight
        shapes += [shape if is_view else with_vertices(shape, index) for index, shape in enumerate(whole.shapes())]
        for shape in whole.shapes():
            check_surface(shape, WHERE)
        far = [emitter for emitter in whole.emitters() if not emitter.flags() & mi.EmitterFlags.Surface]
        contents |= {f"emitter_{index}": emitter for index, emitter in enumerate(far)}
    contents |= {f"shape_{index}": shape for index, shape in enumerate(shapes)}
    keys = [f"{surface.key}.bsdf" for surface in surfaces]
    keys += [f"{WHERE} ({shape.class_name()} {shape.id()!r})" for shape in shapes[len(surfaces) :]]
    boxes = [shape_bounds(shape, unit) for shape in shapes] + [(point, point) for point in points]
    return BuiltView(
        scene=mi.load_dict({"type": "scene", **contents}),
        wall=plane,
        surfaces=surfaces,
        hidden_shapes=tuple(shapes),
        hidden_bounds=_in_frame_of(plane, frame, joined_bounds(boxes)),
        frame=frame,
        metres_per_engine_unit=unit,
        n_triangles=count_triangles(shapes),
        warnings=left_out + read.warnings + coincident + medium_warnings(zip(keys, shapes, strict=True)),
        meshes=read.meshes + of_whole,
    )


def _wall_surface(wall: RelayWall, bsdf: Mapping[str, object], frame: Pose, *, as_mesh: bool) -> Surface:
    """Return a relay wall as any other surface, in the engine's frame; ``as_mesh``: of a rectangle, with vertices."""
    to_frame = frame.inverse_matrix() @ wall.pose.matrix()
    if as_mesh:
        mesh = rectangle_mesh(wall.width, wall.height, None).transformed(to_frame)
        return Surface("relay_wall", "scene.relay_wall", readable(mesh) if has_picture(bsdf) else mesh, bsdf)
    description = wall.shape_description()
    item = description if isinstance(description, TriangleMesh) else ShapeDescription(description)
    shape = item.transformed(to_frame)
    return Surface("relay_wall", "scene.relay_wall", shape, upright_bsdf(description, bsdf))


def _engine_frame(scene_config: SceneConfig, wall: RelayWall | None, plane: ImagePlane) -> Pose:
    """Return where the engine's origin lies: a Mitsuba scene stays where it is, all else comes near the origin."""
    if scene_config.mitsuba is not None:
        return Pose.identity()
    if wall is not None:
        return wall.pose  # a room is built around it
    return Pose(np.eye(3), plane.pose.origin)


def _image_plane(capture_config: CaptureConfig, whole: mi.Scene | None) -> ImagePlane:
    camera, film = capture_config.camera, capture_config.sensor_grid
    pixels = (1, 1) if film is None else (film.nx, film.ny)
    if camera is not None:
        return image_plane(camera.position, camera.look_at, camera.up, camera.fov_deg, pixels)
    if whole is None or not whole.sensors():
        raise ConfigError.at(
            "capture.camera", "missing, and there is no Mitsuba scene with a perspective sensor that has a whole film."
        )
    parameters = mi.traverse(whole.sensors()[0])
    to_world = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    offset = [float(np.ravel(parameters[f"principal_point_offset_{axis}"])[0]) for axis in "xy"]
    if not np.isfinite(to_world).all() or np.linalg.det(to_world[:3, :3]) <= 0 or any(offset):
        raise ConfigError.at(WHERE, "its sensor is mirrored or shifted, which is not supported; give capture.camera.")
    position, forward, up = to_world[:3, 3], to_world[:3, 2], to_world[:3, 1]
    fov = float(np.ravel(parameters["x_fov"])[0])
    return image_plane(position, position + forward / np.linalg.norm(forward), up, fov, pixels)


def _lamp(lamp: PointLamp | SpotLamp, frame: Pose, unit: float) -> mi.Emitter:
    position = (frame.to_local(lamp.position) / unit).tolist()
    # intensity is per steradian seen from a distance in m: radiance falls with the square of engine units
    scale = 1.0 / unit**2
    value = lamp.intensity
    scaled = tuple(channel * scale for channel in value) if isinstance(value, tuple) else value * scale
    intensity = mitsuba_spectrum(scaled)  # type: ignore[arg-type]
    if isinstance(lamp, PointLamp):
        return mi.load_dict({"type": "point", "position": position, "intensity": intensity})
    target = frame.to_local(lamp.look_at) / unit
    axis = target - position
    up = np.eye(3)[int(np.argmin(np.abs(axis)))]
    return mi.load_dict(
        {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(position, target.tolist(), up.tolist()),
            "intensity": intensity,
            "cutoff_angle": lamp.cutoff_deg,
            "beam_width": 0.75 * lamp.cutoff_deg if lamp.beam_deg is None else lamp.beam_deg,
        }
    )


def _unit_length(boxes: Sequence[Bounds | None], points: Sequence[Float64]) -> float:
    """Return the power of two [m] nearest to the scene's reach from the engine's origin."""
    reach = [float(np.abs(box).max()) for box in boxes if box is not None] + [float(np.abs(p).max()) for p in points]
    return 2.0 ** round(math.log2(max(max(reach), 1e-9)))


def _in_frame_of(plane: ImagePlane, frame: Pose, box: Bounds | None) -> Bounds | None:
    return None if box is None else bounds_of(plane.pose.to_local(frame.to_scene(box_corners(box))))
