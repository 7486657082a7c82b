"""Hidden geometry: configuration -> surfaces in the relay wall's local frame, in float64.

Flat shapes become triangle meshes here. Spheres, cylinders and any other Mitsuba shape stay descriptions, and mesh
files stay files with the matrix that brings them to the local frame; the scene builder turns these into shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import Bounds, bounds_of, box_corners
from nlosrender.scene.meshes.letters import letters_mesh
from nlosrender.scene.meshes.mesh_normals import Normals
from nlosrender.scene.meshes.primitives import box_mesh, rectangle_mesh, room_mesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import has_picture, readable, round_plugin, upright_bsdf
from nlosrender.scene.pose import Float64, Pose, cylinder_pose, euler_xyz, unit_direction
from nlosrender.scene.transforms import mesh_matrix, transform_matrix

if TYPE_CHECKING:
    from nlosrender.config.hidden_geometry import CylinderConfig, HiddenItemConfig, SphereConfig
    from nlosrender.config.scene import SceneConfig

MESH_PLUGINS = ("ply", "obj")
_TO_WALL, _UP = (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)  # default front and up of hidden items, in the scene
Radiance = float | tuple[float, float, float]  # grey or [r, g, b], W m^-2 sr^-1


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh file and the (4, 4) matrix from its coordinates to the local frame [m]."""

    filename: str
    to_local: Float64
    kind: str = "ply"  # the suffix
    flip_normals: bool = False  # seen from the other side
    flip_v: bool = False  # turn the vertical texture coordinate round
    normals: Normals = "auto"
    fit: tuple[float, Float64] | None = None  # largest edge [m] of the box of what (3,) scales along the file's axes

    def placed(self, box: Bounds) -> Float64:
        """Return the (4, 4) matrix to the local frame of a file whose points have this box: ``fit`` needs it."""
        if self.fit is None:
            return self.to_local
        largest, scale = self.fit
        low, high = box
        fitted = np.eye(4) * (largest / float((np.abs(scale) * (high - low)).max()))
        fitted[:3, 3] = -fitted[0, 0] * (low + high) / 2
        fitted[3, 3] = 1.0
        return self.to_local @ fitted


@dataclass(frozen=True, eq=False)
class ShapeDescription:
    """A Mitsuba shape dict in the local frame, without bsdf; ``to_world``, if any, is a (4, 4) array."""

    description: Mapping[str, object]

    def bounds(self) -> Bounds | None:
        """Return a box around the shape in the local frame [m], or None for a type whose extent is not known here.

        The box of a transformed shape is that of its transformed box: it may be larger than the shape.
        """
        box = _object_bounds(self.description)
        return None if box is None else bounds_of(box_corners(box) @ self._to_world[:3, :3].T + self._to_world[:3, 3])

    def transformed(self, matrix: Float64) -> ShapeDescription:
        """Return the shape under an affine map, a (4, 4) matrix."""
        return ShapeDescription({**self.description, "to_world": matrix @ self._to_world})

    @property
    def _to_world(self) -> Float64:
        return np.asarray(self.description.get("to_world", np.eye(4)), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Surface:
    """One item of the hidden geometry, placed in the local frame."""

    name: str
    key: str  # where it is configured, "scene.hidden_geometry.2": for error messages
    shape: TriangleMesh | MeshFile | ShapeDescription
    bsdf: Mapping[str, object]  # Mitsuba dict
    radiance: Radiance | None = None  # that its front side emits; None: it emits nothing
    pose: Float64 | None = None  # (4, 4) from the item's own coordinates to the local frame; of a mesh file its shape's

    def bounds(self) -> Bounds | None:
        """Return a box around the surface in the local frame [m], or None when a file or plugin must be asked."""
        return None if isinstance(self.shape, MeshFile) else self.shape.bounds()


def hidden_surfaces(hidden_geometry_configs: Sequence[HiddenItemConfig], frame: Pose) -> tuple[Surface, ...]:
    """Place every item of ``scene.hidden_geometry`` in the local frame, which is the relay wall's or a camera's.

    Raises
    ------
    ConfigError
        A type is unknown, a size is out of range or a pose is degenerate.
    """
    items = enumerate(hidden_geometry_configs)
    return tuple(_surface(item, frame, f"scene.hidden_geometry.{index}", index) for index, item in items)


def all_surfaces(scene_config: SceneConfig, frame: Pose) -> tuple[Surface, ...]:
    """Place hidden geometry and area emitters in the local frame; errors as of ``hidden_surfaces``."""
    shining = (_surface(item, frame, f"scene.emitters.{index}", 0) for index, item in scene_config.shining_surfaces)
    return (*hidden_surfaces(scene_config.hidden_geometry, frame), *shining)


def _surface(item: HiddenItemConfig, frame: Pose, key: str, index: int) -> Surface:
    bsdf: Mapping[str, object] = item.bsdf
    try:
        shape = _shape(item, frame)
        if item.type != "mitsuba" and has_picture(bsdf):  # those keep Mitsuba's own convention
            if isinstance(shape, TriangleMesh):
                shape = readable(shape, from_within=item.type == "room")
            elif isinstance(shape, ShapeDescription):
                bsdf = upright_bsdf(shape.description, bsdf)
    except ValueError as error:
        raise ConfigError.at(key, f"{error}.") from error
    name, pose = item.name or f"{item.type}-{index}", item_pose(item, frame)
    return Surface(name, key, shape, bsdf, getattr(item, "radiance", None), None if pose is None else pose.matrix())


def item_pose(item: HiddenItemConfig, frame: Pose) -> Pose | None:
    """Return the pose of an item's own coordinates in the local frame; None: it has a matrix that may scale."""
    match item.type:
        case "rectangle" | "letters":
            return Pose.from_normal_up(item.center, item.normal, item.up).seen_from(frame)
        case "box":
            return Pose(euler_xyz(item.rotate_deg), np.asarray(item.center, dtype=np.float64)).seen_from(frame)
        case "sphere":
            return Pose(np.eye(3), np.asarray(item.center, dtype=np.float64)).seen_from(frame)
        case "cylinder":
            return cylinder_pose(item.center, item.axis).seen_from(frame)
        case "room":
            return Pose.identity()  # defined in the wall's local frame
    return None


def _shape(item: HiddenItemConfig, frame: Pose) -> TriangleMesh | MeshFile | ShapeDescription:
    match item.type:
        case "rectangle":
            return rectangle_mesh(item.width, item.height, item_pose(item, frame))
        case "letters":
            strokes = item.thickness, item.stroke_width, item.spacing
            return letters_mesh(item.text, item.height, *strokes, item_pose(item, frame))
        case "box":
            return box_mesh(item.size, item_pose(item, frame))
        case "room":
            return room_mesh(item.size)
        case "mesh":
            kind = Path(item.filename).suffix.lower().lstrip(".")
            to_local = frame.inverse_matrix() @ mesh_matrix(item)
            fit = None if item.fit is None else (float(item.fit.largest), np.broadcast_to(item.scale, 3))
            return MeshFile(str(item.filename), to_local, kind, normals=item.shading_normals, fit=fit)
        case "sphere" | "cylinder":
            return _pictured(item, frame) if has_picture(item.bsdf) else _plain_round(item, frame)
        case "mitsuba":
            to_world = frame.inverse_matrix() @ transform_matrix(item.shape.get("to_world"))
            if item.shape["type"] in MESH_PLUGINS:
                return _mesh_file(item.shape, to_world)
            if item.shape["type"] == "rectangle":  # two triangles, which every engine can cut
                rectangle = rectangle_mesh(2.0, 2.0).transformed(to_world)
                return rectangle.turned_round() if item.shape.get("flip_normals", False) else rectangle
            return ShapeDescription({**item.shape, "to_world": to_world})
    raise ValueError(f"type {item.type!r}: need rectangle, letters, box, room, mesh, sphere, cylinder or mitsuba")


def _mesh_file(plugin: Mapping[str, object], to_world: Float64) -> MeshFile:
    """Return a mesh plugin as a file of ours: Mitsuba's own readers end the process on a wrong index."""
    unknown = set(plugin) - {"type", "filename", "to_world", "face_normals", "flip_normals", "flip_tex_coords"}
    if unknown or "filename" not in plugin:
        wrong = f"unknown parameter {min(unknown)}" if unknown else "no filename"
        raise ValueError(f"shape: {wrong}, need filename, to_world, face_normals, flip_normals or flip_tex_coords")
    turned_round = plugin["type"] == "obj"  # Mitsuba's default, and what reading an .obj does
    flip_v = bool(plugin.get("flip_tex_coords", turned_round)) != turned_round
    normals: Normals = "flat" if plugin.get("face_normals") else "mitsuba"
    flip_normals = bool(plugin.get("flip_normals", False))
    return MeshFile(str(plugin["filename"]), to_world, str(plugin["type"]), flip_normals, flip_v, normals)


def _plain_round(item: SphereConfig | CylinderConfig, frame: Pose) -> ShapeDescription:
    center = frame.to_local(item.center)
    if item.type == "sphere":
        where: dict[str, object] = {"type": "sphere", "center": center.tolist()}
    else:
        half = unit_direction(frame.direction_to_local(item.axis), "axis") * (item.height / 2)
        where = {"type": "cylinder", "p0": (center - half).tolist(), "p1": (center + half).tolist()}
    return ShapeDescription({**where, "radius": float(item.radius), "flip_normals": bool(item.inside)})


def _pictured(item: SphereConfig | CylinderConfig, frame: Pose) -> ShapeDescription:
    """Return a round shape whose picture has its middle towards the wall and its up along y, or the axis."""
    towards, up, height = np.asarray(_TO_WALL), np.asarray(_UP), None
    if item.type == "cylinder":
        axes, height = cylinder_pose(item.center, item.axis).rotation, item.height
        towards, up = -axes[:, 2], axes[:, 1]
    pose = Pose.from_normal_up(item.center, towards, up).seen_from(frame)
    plugin = round_plugin(item.radius, height, inside=item.inside, turned=item.inside)
    return ShapeDescription(plugin).transformed(pose.matrix())


def _object_bounds(description: Mapping[str, object]) -> Bounds | None:
    """Return the box of a Mitsuba shape before its ``to_world``; None for types this module does not know."""
    kind = description.get("type")
    if kind in ("rectangle", "disk"):
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 0.0])
    if kind == "cube":
        return -np.ones(3), np.ones(3)
    if kind not in ("sphere", "cylinder"):
        return None
    radius = float(np.asarray(description.get("radius", 1.0), dtype=np.float64))
    if kind == "sphere":
        center = np.asarray(description.get("center", [0.0, 0.0, 0.0]), dtype=np.float64)
        return center - radius, center + radius
    ends = np.array([description.get("p0", [0.0, 0.0, 0.0]), description.get("p1", [0.0, 0.0, 1.0])], dtype=np.float64)
    axis = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-300)
    # A disk of radius r with unit normal a reaches r * sqrt(1 - a_i^2) along axis i.
    reach = radius * np.sqrt(np.clip(1.0 - axis**2, 0.0, 1.0))
    return ends.min(axis=0) - reach, ends.max(axis=0) + reach
