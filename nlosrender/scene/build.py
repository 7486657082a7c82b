"""Geometry -> Mitsuba scene, in engine units: the relay wall's local frame, scaled to a size near 1.

Ray offsets and intersection tolerances are absolute lengths in a ray tracer. A power of two brings every
scene, of millimetres or kilometres, to the same size without rounding anything; results are scaled back exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.scene.bounding_box import Bounds, box_corners, joined_bounds
from nlosrender.scene.coincident import PASSES, Overlap, coincident_disks, moved_apart, overlaps
from nlosrender.scene.materials import area_emitter, check_surface, first_line, load_bsdf, medium_warnings, rejected
from nlosrender.scene.meshes.double_faces import without_double_faces
from nlosrender.scene.meshes.mesh_attributes import VERTEX_COLOR, attribute_uses
from nlosrender.scene.meshes.mesh_report import MeshReport
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import upright_bsdf
from nlosrender.scene.pose import Float64
from nlosrender.scene.read_surfaces import read_surfaces
from nlosrender.scene.round_surfaces import ROUND_PLUGINS, Nested, curvature, nested_surfaces
from nlosrender.scene.surfaces import ShapeDescription, Surface
from nlosrender.scene.walls.wall import RelayWall

WALL_ID = "relay_wall"
MOST_REACH = 1e5  # hidden geometry over the wall's size: float32 then tells points 1 % of the wall apart
EXACT_PLUGINS = ("Rectangle", "Disk", *ROUND_PLUGINS)  # intersections in closed form, as those of meshes
OVERLAP_TOLD = 1e-3  # of an item's area that coincides with other surfaces
LEAST_EXTENT = 1e-12  # hidden geometry over the wall's size: the squares of areas stay numbers in float32


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
    warnings: tuple[str, ...] = ()  # about what was left out, or hardly meant
    meshes: tuple[MeshReport, ...] = ()  # what was read of mesh files

    @property
    def all_flat(self) -> bool:
        """Whether the wall is a plane and every hidden surface made of triangles."""
        return self.wall.is_planar and all(shape.is_mesh() for shape in self.hidden_shapes)

    @cached_property
    def has_exact_hits(self) -> bool:
        """Whether rays meet every hidden surface where float32 has it; curves and distance grids are searched for."""
        return all(shape.is_mesh() or shape.class_name() in EXACT_PLUGINS for shape in self.hidden_shapes)

    @cached_property
    def curvature_of_shapes(self) -> Float64:
        """1 / radius (n,) [1 / engine unit] of spheres and cylinders, 0 for other shapes; in the scene's order."""
        return np.array([curvature(shape) for shape in self.scene.shapes()])

    @cached_property
    def curvatures(self) -> mi.Float:
        """``curvature_of_shapes`` on the device; index = registry of shapes."""
        registry = np.array(dr.reinterpret_array(mi.UInt32, self.scene.shapes_dr()))
        values = np.zeros(int(registry.max(initial=0)) + 1, np.float32)
        values[registry] = self.curvature_of_shapes
        table = mi.Float(values)
        dr.eval(table)
        return table

    @property
    def is_curved(self) -> bool:
        """Whether any shape is a sphere or a cylinder."""
        return bool(self.curvature_of_shapes.any())

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
    read = read_surfaces(surfaces, wall)
    loaded = list(read.shapes)
    boxes = [shape.bounds() for shape in loaded]
    for surface, box in zip(surfaces, boxes, strict=True):
        _check_reach(surface, box, wall)
    unit = _unit_length(wall, joined_bounds(boxes))
    description = wall.shape_description()
    wall_item = description if isinstance(description, TriangleMesh) else ShapeDescription(description)
    wall_surface = Surface(WALL_ID, "scene.relay_wall", wall_item, upright_bsdf(description, wall_bsdf))
    wall_shape = load_surface(wall_surface, wall_item, unit)
    scene, hidden_shapes, warnings = _load_apart(surfaces, loaded, wall_shape, unit)
    hidden_boxes = [shape_bounds(shape, unit) for shape in hidden_shapes]
    for surface, box in zip(surfaces, hidden_boxes, strict=True):
        _check_reach(surface, box, wall)
    hidden_bounds = joined_bounds(hidden_boxes)
    n_triangles = sum(int(shape.face_count()) for shape in hidden_shapes if shape.is_mesh())
    shapes = tuple(hidden_shapes)
    warnings += medium_warnings((f"{surface.key}.bsdf", shape) for surface, shape in zip(surfaces, shapes, strict=True))
    warnings = read.warnings + warnings
    built = BuiltScene(
        scene, wall, wall_shape, tuple(surfaces), shapes, hidden_bounds, unit, n_triangles, warnings, read.meshes
    )
    _ = built.curvatures  # now, not while a kernel is recorded
    return built


def _load_apart(
    surfaces: Sequence[Surface], loaded: Sequence[TriangleMesh | ShapeDescription], wall_shape: mi.Shape, unit: float
) -> tuple[mi.Scene, list[mi.Shape], tuple[str, ...]]:
    """Load the surfaces and the scene of them and the wall; coincident triangles are moved apart.

    Returns
    -------
    tuple
        Scene; shapes of the surfaces; a sentence for each item of which more than a little was moved.
    """
    bsdfs = [_load_bsdf_of(surface, shape) for surface, shape in zip(surfaces, loaded, strict=True)]
    meshes: dict[int, TriangleMesh] = {}
    shapes: list[mi.Shape] = []
    for index, (surface, shape, bsdf) in enumerate(zip(surfaces, loaded, bsdfs, strict=True)):
        if isinstance(shape, TriangleMesh):
            meshes[index] = _in_engine_units(shape, surface, bsdf, unit)
            shapes.append(_load_mesh(meshes[index], surface, bsdf))
        else:
            shapes.append(_load_shape(shape.description, surface, bsdf, unit))
            if shapes[-1].is_mesh():  # a plugin's own
                meshes[index] = _mesh_of(shapes[-1])
    nested = nested_surfaces(shapes, wall_shape)
    for one in nested:
        shape = loaded[one.moved]
        if isinstance(shape, ShapeDescription):  # as all round ones are
            description = _resized(shape.description, one.factor)
            shapes[one.moved] = _load_shape(description, surfaces[one.moved], bsdfs[one.moved], unit)
    told: dict[int, Overlap] = {}
    for seed in range(PASSES):
        contents: dict[str, object] = {"type": "scene", WALL_ID: wall_shape}
        scene = mi.load_dict(contents | {f"hidden_{index}": shape for index, shape in enumerate(shapes)})
        found = overlaps(scene, shapes, meshes, seed)
        for overlap in found:
            index = overlap.mesh
            told.setdefault(index, overlap)
            meshes[index] = moved_apart(meshes[index], overlap.faces, both_sides=_has_two_sides(bsdfs[index]))
            shapes[index] = _load_mesh(meshes[index], surfaces[index], bsdfs[index])
        if not found:
            break
    disks = coincident_disks(shapes)
    warnings = *_overlap_warnings(surfaces, told), *_nested_warnings(surfaces, nested), *_disk_warnings(surfaces, disks)
    return scene, shapes, warnings


def _resized(description: Mapping[str, object], factor: float) -> dict[str, object]:
    """Return the description of a sphere or cylinder with another radius."""
    resized = dict(description)
    if "radius" in resized:
        return resized | {"radius": float(factor * np.asarray(resized["radius"], dtype=np.float64))}
    to_world = np.array(resized["to_world"], dtype=np.float64)
    to_world[:3, : 2 if resized["type"] == "cylinder" else 3] *= factor
    return resized | {"to_world": to_world}


def _nested_warnings(surfaces: Sequence[Surface], nested: Sequence[Nested]) -> Iterator[str]:
    for one in nested:
        if one.is_hidden:
            hidden, other = surfaces[one.moved].key, surfaces[one.other].key
            yield (
                f"{hidden} lies where {other} is, or closer than rays tell apart. It is taken to lie behind it. Leave "
                "it out, or move one of them if it should be seen."
            )


def _disk_warnings(surfaces: Sequence[Surface], pairs: Sequence[tuple[int, int]]) -> Iterator[str]:
    for disk, other in pairs:
        yield (
            f"{surfaces[disk].key}: a disk in one place with {surfaces[other].key}, or closer than rays tell apart: "
            "either may be met there, light may count twice, and the stated error does not know. Move one of them."
        )


def _overlap_warnings(surfaces: Sequence[Surface], found: Mapping[int, Overlap]) -> Iterator[str]:
    for index, overlap in found.items():
        if overlap.share > OVERLAP_TOLD:
            other = "itself" if overlap.other == index else surfaces[overlap.other].key
            yield (
                f"{surfaces[index].key}: {100 * overlap.share:.3g} % of its area lies where {other} is, or closer than "
                "rays tell apart. It is taken to lie in front there. Move one of them if it should not."
            )


def load_surface(surface: Surface, shape: TriangleMesh | ShapeDescription, unit: float) -> mi.Shape:
    """Load a surface whose mesh file, if it has one, has been read (``read_surfaces``).

    Raises
    ------
    ConfigError
        Mitsuba rejects the shape or its BSDF, or float32 rounds it to nothing.
    """
    bsdf = _load_bsdf_of(surface, shape)
    if isinstance(shape, TriangleMesh):
        return _load_mesh(_in_engine_units(shape, surface, bsdf, unit), surface, bsdf)
    return _load_shape(shape.description, surface, bsdf, unit)


def _load_bsdf_of(surface: Surface, shape: TriangleMesh | ShapeDescription) -> mi.BSDF:
    """Load a BSDF; refuse textures that read what the surface does not have: Mitsuba takes it for black."""
    colors = shape.colors if isinstance(shape, TriangleMesh) else None
    attributes = {} if colors is None else {VERTEX_COLOR: colors}
    for use in attribute_uses(surface.bsdf):
        try:
            if surface.name == WALL_ID:
                raise ValueError(f"{use.parameter}: a relay wall's points have no attribute {use.name}; use a bitmap")
            use.check(attributes)
        except ValueError as error:
            raise rejected(f"{surface.key}.bsdf", f"{error}.") from error
    return load_bsdf(surface.bsdf, f"{surface.key}.bsdf")


def _in_engine_units(mesh: TriangleMesh, surface: Surface, bsdf: mi.BSDF, unit: float) -> TriangleMesh:
    """Return a mesh as float32 has it, without triangles that float32 rounds to nothing and double ones.

    The former have no normal, and NaN would come of it.
    """
    mesh = replace(mesh, vertices=(mesh.vertices / unit).astype(np.float32)).with_area_only()
    if not len(mesh.faces):
        raise rejected(surface.key, f"too small in a scene of {unit:g} m: float32 rounds its triangles to nothing.")
    return without_double_faces(mesh, both_sides=_has_two_sides(bsdf))


def _mesh_of(shape: mi.Mesh) -> TriangleMesh:
    """Return the triangles of a mesh that Mitsuba has loaded [engine units]."""
    parameters = mi.traverse(shape)

    def rows(name: str, width: int, is_there: bool) -> Float64 | None:
        return np.asarray(parameters[name], dtype=np.float64).reshape(-1, width) if is_there else None

    uvs = rows("vertex_texcoords", 2, shape.has_vertex_texcoords())
    normals = rows("vertex_normals", 3, shape.has_vertex_normals())
    faces = np.asarray(parameters["faces"]).reshape(-1, 3)
    return TriangleMesh(np.asarray(parameters["vertex_positions"]).reshape(-1, 3), faces, uvs, normals)


def _has_two_sides(bsdf: mi.BSDF) -> bool:
    return bool(bsdf.flags() & mi.BSDFFlags.BackSide)


def _load_mesh(mesh: TriangleMesh, surface: Surface, bsdf: mi.BSDF) -> mi.Mesh:
    """Load a mesh in engine units."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    if surface.radiance is not None:
        properties["mesh_emitter"] = mi.load_dict(area_emitter(surface.radiance))
    properties["face_normals"] = mesh.normals is None
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
    if mesh.colors is not None and any(attribute_uses(surface.bsdf)):
        shape.add_attribute(VERTEX_COLOR, 3, np.ravel(mesh.colors).astype(np.float32))
    check_surface(shape, f"{surface.key}.bsdf")
    return shape


def _load_shape(description: Mapping[str, object], surface: Surface, bsdf: mi.BSDF, unit: float) -> mi.Shape:
    """Load an analytic shape or any Mitsuba plugin, scaled to engine units."""
    plugin = _scaled(description, unit)
    plugin["bsdf"], plugin["id"] = bsdf, surface.name
    if surface.radiance is not None:
        plugin["emitter"] = area_emitter(surface.radiance)
    try:
        if plugin["type"] == "serialized":
            load_flat_serialized(plugin)
        shape = mi.load_dict(plugin)
    except (RuntimeError, TypeError, ValueError) as error:
        raise rejected(surface.key, f"Mitsuba rejects this shape: {first_line(error)}") from error
    check_surface(shape, f"{surface.key}.bsdf")
    return shape


def load_flat_serialized(plugin: Mapping[str, object]) -> mi.Mesh:
    """Load a mesh without vertex normals, before Mitsuba computes them and reads where a wrong index leads.

    Raises
    ------
    ValueError
        A face refers to a vertex that is not there.
    RuntimeError
        Mitsuba cannot read the file.
    """
    mesh = mi.load_dict({**plugin, "face_normals": True})
    faces = np.asarray(mi.traverse(mesh)["faces"])
    if not len(faces) or int(faces.max()) >= mesh.vertex_count():
        raise ValueError(f"a face refers to vertex {faces.max(initial=0)}, the file has {mesh.vertex_count()}")
    return mesh


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


def shape_bounds(shape: mi.Shape, unit: float) -> Bounds | None:
    """Return the box around a loaded shape [m, engine's frame]; None for one without extent."""
    box = shape.bbox()
    if box.valid():
        low, high = (np.ravel(np.asarray(corner, dtype=np.float64)) * unit for corner in (box.min, box.max))
        return low, high
    if not (shape.is_mesh() and shape.vertex_count()):
        return None
    # Mitsuba joins meshes of a scene file into one, and leaves the box of that one empty
    index = dr.arange(mi.UInt32, shape.vertex_count())
    vertices = np.asarray(shape.vertex_position(index), dtype=np.float64) * unit
    return vertices.min(axis=1), vertices.max(axis=1)


def _check_reach(surface: Surface, box: Bounds | None, wall: RelayWall) -> None:
    """Refuse what is so far away or so large that the wall's own points fall together in float32, or has no extent."""
    if box is None:
        return
    size, reach = _wall_size(wall), float(np.abs(box).max())
    if not float((box[1] - box[0]).max()) >= LEAST_EXTENT * size:
        raise rejected(surface.key, f"it has no extent beside a relay wall of {size:.4g} m. Check units and scale.")
    if not reach <= MOST_REACH * size:
        raise rejected(
            surface.key,
            f"it reaches {reach:.4g} m from the relay wall's centre, need at most {MOST_REACH:g} times the wall's size "
            f"of {size:.4g} m. Check units, scale and position.",
        )


def _unit_length(wall: RelayWall, hidden: Bounds | None) -> float:
    """Return the power of two [m] nearest to the scene's size."""
    size = _wall_size(wall)
    if hidden is not None:
        size = max(size, float(np.abs(box_corners(hidden)).max()))
    return 2.0 ** round(math.log2(size))


def _wall_size(wall: RelayWall) -> float:
    """Return the longest extent of the wall [m]: what its coordinates say, but of a mesh the true one."""
    if isinstance(wall.shape_description(), TriangleMesh):
        return float(np.ptp(wall.bounds(), axis=0).max())
    return max(wall.width, wall.height)


def wall_box(wall: RelayWall) -> Float64:
    """Return the corners (8, 3) of a box around the wall [m, local frame]."""
    return box_corners(wall.bounds())
