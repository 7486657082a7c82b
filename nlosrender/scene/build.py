"""Geometry -> Mitsuba scene, in engine units: the relay wall's local frame, scaled to a size near 1.

Ray offsets and intersection tolerances are absolute lengths in a ray tracer. A power of two brings every
scene, of millimetres or kilometres, to the same size without rounding anything; results are scaled back exactly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import ConfigError, Problem
from nlosrender.scene.double_faces import without_double_faces
from nlosrender.scene.hidden_geometry import Bounds, MeshFile, ShapeDescription, Surface, box_corners, joined_bounds
from nlosrender.scene.mesh_file import read_mesh
from nlosrender.scene.pose import Float64
from nlosrender.scene.relay_wall import RelayWall
from nlosrender.scene.transforms import transform_matrix
from nlosrender.scene.triangle_mesh import TriangleMesh

WALL_ID = "relay_wall"
MOST_REACH = 1e5  # hidden geometry over the wall's size: float32 then tells points 1 % of the wall apart
LEAST_EXTENT = 1e-12  # hidden geometry over the wall's size: the squares of areas stay numbers in float32
TEXEL_ROUNDING = 1e-3  # half-precision images and their filters may pass 1 a little
TRANSFORMS = ("to_world", "to_uv")  # keys of a plugin that hold a matrix or a list of steps


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """A scene ready to be traced."""

    scene: mi.Scene
    wall: RelayWall
    wall_shape: mi.Shape
    surfaces: tuple[Surface, ...]
    hidden_shapes: tuple[mi.Shape, ...]  # one per surface
    hidden_bounds: Bounds | None  # box around the hidden geometry [m, local frame]; None when there is none
    unit: float  # metres per engine unit of length, a power of two
    n_triangles: int  # of the hidden geometry; analytic shapes count as none

    @property
    def all_flat(self) -> bool:
        """Whether the wall is a plane and every hidden surface made of triangles."""
        return self.wall.is_planar and all(shape.is_mesh() for shape in self.hidden_shapes)

    @property
    def wall_bsdf(self) -> mi.BSDF:
        """BSDF of the relay wall."""
        return self.wall_shape.bsdf()


def build_scene(wall: RelayWall, wall_bsdf: Mapping[str, object], surfaces: Sequence[Surface]) -> BuiltScene:
    """Build the Mitsuba scene; the backend has to be started before.

    Parameters
    ----------
    wall
        The relay wall; it blocks and reflects light like any surface.
    wall_bsdf
        Mitsuba BSDF dict of the relay wall.
    surfaces
        Hidden geometry in the local frame [m].

    Raises
    ------
    ConfigError
        Mitsuba rejects a shape or a BSDF, or a mesh file cannot be read; the key of the item is named.
    """
    loaded = [_read_mesh(surface) for surface in surfaces]
    boxes = [shape.bounds() for shape in loaded]
    for surface, box in zip(surfaces, boxes, strict=True):
        _check_reach(surface, box, wall)
    unit = _unit_length(wall, joined_bounds(boxes))
    wall_shape = _load_shape(wall.shape_description(), wall_bsdf, "scene.relay_wall", WALL_ID, unit)
    hidden_shapes = []
    for surface, shape in zip(surfaces, loaded, strict=True):
        if isinstance(shape, TriangleMesh):
            hidden_shapes.append(_load_mesh(shape, surface, unit))
        else:
            hidden_shapes.append(_load_shape(shape.description, surface.bsdf, surface.key, surface.name, unit))
    contents: dict[str, object] = {"type": "scene", WALL_ID: wall_shape}
    contents |= {f"hidden_{index}": shape for index, shape in enumerate(hidden_shapes)}
    hidden_boxes = [_shape_bounds(shape, unit) for shape in hidden_shapes]
    for surface, box in zip(surfaces, hidden_boxes, strict=True):
        _check_reach(surface, box, wall)
    scene = mi.load_dict(contents)
    hidden_bounds = joined_bounds(hidden_boxes)
    n_triangles = sum(int(shape.face_count()) for shape in hidden_shapes if shape.is_mesh())
    return BuiltScene(scene, wall, wall_shape, tuple(surfaces), tuple(hidden_shapes), hidden_bounds, unit, n_triangles)


def mitsuba_value(value: object) -> object:
    """Turn a value of a configuration's BSDF or shape dict into what Mitsuba loads.

    Mappings stay plugins, three numbers become an ``rgb`` colour, other numbers become floats.
    """
    if isinstance(value, Mapping):
        if value.get("type") == "rgb":
            return {"type": "rgb", "value": [float(channel) for channel in value["value"]]}
        return {
            key: mi.ScalarTransform4f(transform_matrix(item)) if key in TRANSFORMS else mitsuba_value(item)
            for key, item in value.items()
        }
    if isinstance(value, (tuple, list)):
        if len(value) == 3 and all(isinstance(item, (int, float)) for item in value):
            return {"type": "rgb", "value": [float(item) for item in value]}
        raise ValueError(f"got {list(value)}, need one number, three numbers [r, g, b], or a plugin with a type")
    return value


def _read_mesh(surface: Surface) -> TriangleMesh | ShapeDescription:
    """Read a mesh file in its own coordinates, then move it in float64; other shapes pass."""
    shape = surface.shape
    if not isinstance(shape, MeshFile):
        return shape
    try:
        mesh = read_mesh(shape.filename, shape.kind, face_normals=surface.face_normals).transformed(shape.to_local)
        if shape.flip_v and mesh.uvs is not None:
            mesh = replace(mesh, uvs=mesh.uvs * [1.0, -1.0] + [0.0, 1.0])
        return mesh.turned_round() if shape.flip_normals else mesh
    except ValueError as error:
        raise _rejected(f"{surface.key}.filename", f"{shape.filename} cannot be used as a mesh: {error}.") from error


def _load_mesh(mesh: TriangleMesh, surface: Surface, unit: float) -> mi.Mesh:
    # A triangle that float32 rounds to nothing has no normal, and NaN would come of it.
    mesh = replace(mesh, vertices=(mesh.vertices / unit).astype(np.float32)).with_area_only()
    if not len(mesh.faces):
        raise _rejected(surface.key, f"too small in a scene of {unit:g} m: float32 rounds its triangles to nothing.")
    bsdf = _load_bsdf(surface.bsdf, f"{surface.key}.bsdf")
    mesh = without_double_faces(mesh, both_sides=bool(bsdf.flags() & mi.BSDFFlags.BackSide))
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    properties["face_normals"] = surface.face_normals
    shape = mi.Mesh(
        surface.name,
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uvs is not None,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    if mesh.normals is not None:
        parameters["vertex_normals"] = np.ravel(mesh.normals).astype(np.float32)
    if mesh.uvs is not None:
        parameters["vertex_texcoords"] = np.ravel(mesh.uvs).astype(np.float32)
    parameters.update()
    return shape


def _load_shape(
    description: Mapping[str, object], bsdf: Mapping[str, object], key: str, name: str, unit: float
) -> mi.Shape:
    """Load an analytic shape or any Mitsuba plugin, scaled to engine units."""
    plugin = _scaled(description, unit)
    plugin["bsdf"] = _load_bsdf(bsdf, f"{key}.bsdf")
    plugin["id"] = name
    try:
        if plugin["type"] == "serialized":
            _check_faces(mi.load_dict({**plugin, "face_normals": True}))
        return mi.load_dict(plugin)
    except (RuntimeError, TypeError, ValueError) as error:
        raise _rejected(key, f"Mitsuba rejects this shape: {_first_line(error)}") from error


def _check_faces(mesh: mi.Mesh) -> None:
    """Look at a mesh without vertex normals, before Mitsuba computes them and reads where a wrong index leads."""
    faces = np.asarray(mi.traverse(mesh)["faces"])
    if not len(faces) or int(faces.max()) >= mesh.vertex_count():
        raise ValueError(f"a face refers to vertex {faces.max(initial=0)}, the file has {mesh.vertex_count()}")


def _scaled(description: Mapping[str, object], unit: float) -> dict[str, object]:
    plugin = dict(description)
    if "to_world" in plugin:
        matrix = np.asarray(plugin["to_world"], dtype=np.float64).copy()
        matrix[:3] /= unit
        plugin["to_world"] = mi.ScalarTransform4f(matrix)
        return plugin
    for length in ("center", "radius", "p0", "p1"):
        if length in plugin:
            scaled = np.asarray(plugin[length], dtype=np.float64) / unit
            plugin[length] = scaled.tolist()
    return plugin


def _load_bsdf(bsdf: Mapping[str, object], key: str) -> mi.BSDF:
    try:
        loaded = mi.load_dict(mitsuba_value(bsdf))
    except (RuntimeError, TypeError, ValueError) as error:
        raise _rejected(key, f"Mitsuba rejects this BSDF: {_first_line(error)}") from error
    for name, values in mi.traverse(loaded).items():
        if name.endswith(".data"):
            _check_texels(np.asarray(values), name.removesuffix(".data"), f"{key}.{name.split('.')[0]}")
    return loaded


def _check_texels(values: NDArray, name: str, key: str) -> None:
    """Refuse images with values no reflectance has; numbers in the configuration have been checked before."""
    if values.dtype.kind == "u":
        return  # 8-bit images stand for 0 to 1
    most = 1.0 if "reflectance" in name or "color" in name else float("inf")
    wrong = ~((values >= 0) & (values <= most * (1 + TEXEL_ROUNDING)) & np.isfinite(values))
    if wrong.any():
        found, need = float(values[wrong][0]), "from 0 to 1" if most == 1 else "finite and not negative"
        raise _rejected(
            key, f"{int(wrong.sum())} of {values.size} values of the image, such as {found:g}, are not {need}."
        )


def _shape_bounds(shape: mi.Shape, unit: float) -> Bounds | None:
    box = shape.bbox()
    if not box.valid():
        return None
    return np.ravel(np.asarray(box.min, dtype=np.float64)) * unit, np.ravel(
        np.asarray(box.max, dtype=np.float64)
    ) * unit


def _check_reach(surface: Surface, box: Bounds | None, wall: RelayWall) -> None:
    """Refuse what is so far away or so large that the wall's own points fall together in float32, or has no extent."""
    if box is None:
        return
    size, reach = max(wall.width, wall.height), float(np.abs(box).max())
    if not float((box[1] - box[0]).max()) >= LEAST_EXTENT * size:
        raise _rejected(surface.key, f"it has no extent beside a relay wall of {size:.4g} m. Check units and scale.")
    if not reach <= MOST_REACH * size:
        raise _rejected(
            surface.key,
            f"it reaches {reach:.4g} m from the relay wall's centre, need at most {MOST_REACH:g} times the wall's size "
            f"of {size:.4g} m. Check units, scale and position.",
        )


def _unit_length(wall: RelayWall, hidden: Bounds | None) -> float:
    """Return the power of two [m] nearest to the scene's size."""
    size = max(wall.width, wall.height)
    if hidden is not None:
        size = max(size, float(np.abs(box_corners(hidden)).max()))
    return 2.0 ** round(math.log2(size))


def _rejected(key: str, message: str) -> ConfigError:
    return ConfigError(Problem("", key, message))


def _first_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:400]


def wall_box(wall: RelayWall, n: int = 33) -> Float64:
    """Return the corners (8, 3) of a box around the wall [m, local frame], from a grid of n x n of its points."""
    x = np.linspace(-wall.width / 2, wall.width / 2, n)
    y = np.linspace(-wall.height / 2, wall.height / 2, n)
    points = wall.positions(np.stack(np.meshgrid(x, y), axis=-1)).reshape(-1, 3)
    return box_corners((points.min(axis=0), points.max(axis=0)))
