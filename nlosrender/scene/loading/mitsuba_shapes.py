"""Loads surfaces as Mitsuba shapes in engine units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import Bounds
from nlosrender.scene.loading.double_faces import without_double_faces
from nlosrender.scene.loading.materials import area_emitter, check_surface, first_line, load_bsdf
from nlosrender.scene.loading.mesh_attributes import VERTEX_COLOR, attribute_uses
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64
from nlosrender.scene.surfaces import ShapeDescription, Surface

WALL_ID = "relay_wall"


def load_surface(surface: Surface, shape: TriangleMesh | ShapeDescription, unit: float) -> mi.Shape:
    """Load a surface whose mesh file, if it has one, has been read (``read_surfaces``).

    Raises
    ------
    ConfigError
        Mitsuba rejects the shape or its BSDF, or float32 rounds it to nothing.
    """
    bsdf = load_bsdf_of(surface, shape)
    if isinstance(shape, TriangleMesh):
        return load_mesh(in_engine_units(shape, surface, bsdf, unit), surface, bsdf)
    return load_plugin(shape.description, surface, bsdf, unit)


def load_bsdf_of(surface: Surface, shape: TriangleMesh | ShapeDescription) -> mi.BSDF:
    """Load a BSDF; refuse textures that read what the surface does not have: Mitsuba takes it for black."""
    colors = shape.colors if isinstance(shape, TriangleMesh) else None
    attributes = {} if colors is None else {VERTEX_COLOR: colors}
    for use in attribute_uses(surface.bsdf):
        try:
            if surface.name == WALL_ID:
                raise ValueError(f"{use.parameter}: a relay wall's points have no attribute {use.name}; use a bitmap")
            use.check(attributes)
        except ValueError as error:
            raise ConfigError.at(f"{surface.key}.bsdf", f"{error}.") from error
    return load_bsdf(surface.bsdf, f"{surface.key}.bsdf")


def in_engine_units(mesh: TriangleMesh, surface: Surface, bsdf: mi.BSDF, unit: float) -> TriangleMesh:
    """Return a mesh as float32 has it, without double triangles and those that float32 rounds to nothing.

    The latter have no normal, and NaN would come of it.
    """
    mesh = replace(mesh, vertices=(mesh.vertices / unit).astype(np.float32)).with_area_only()
    if not len(mesh.faces):
        message = f"too small in a scene of {unit:g} m: float32 rounds its triangles to nothing."
        raise ConfigError.at(surface.key, message)
    return without_double_faces(mesh, both_sides=has_two_sides(bsdf))


def has_two_sides(bsdf: mi.BSDF) -> bool:
    """Return whether a surface reflects or transmits on its back, too."""
    return bool(bsdf.flags() & mi.BSDFFlags.BackSide)


def load_mesh(mesh: TriangleMesh, surface: Surface, bsdf: mi.BSDF) -> mi.Mesh:
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
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    columns = {"positions": mesh.vertices, "normals": mesh.normals, "texcoords": mesh.uvs}
    for name, values in columns.items():
        if values is not None:
            parameters[f"vertex_{name}"] = np.ravel(values).astype(np.float32)
    parameters.update()
    if mesh.colors is not None and any(attribute_uses(surface.bsdf)):
        shape.add_attribute(VERTEX_COLOR, 3, np.ravel(mesh.colors).astype(np.float32))
    check_surface(shape, f"{surface.key}.bsdf")
    return shape


def load_plugin(description: Mapping[str, object], surface: Surface, bsdf: mi.BSDF, unit: float) -> mi.Shape:
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
        raise ConfigError.at(surface.key, f"Mitsuba rejects this shape: {first_line(error)}") from error
    if _loses_its_stretch(shape):
        message = f"is stretched or sheared by its to_world, but a {plugin['type']} of Mitsuba stays round."
        raise ConfigError.at(surface.key, f"{message} Scale it alike in all directions, or use a mesh.")
    check_surface(shape, f"{surface.key}.bsdf")
    return shape


def _loses_its_stretch(shape: mi.Shape) -> bool:
    """Return whether a sphere or cylinder has a ``to_world`` that no round shape fits: one radius is made of it."""
    if shape.class_name() not in ("Sphere", "Cylinder"):
        return False
    axes = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    products = axes.T @ axes
    expected = np.diag(products).copy()
    expected[1] = expected[0]
    if shape.class_name() == "Sphere":
        expected[2] = expected[0]
    lengths = np.sqrt(np.diag(products))
    return bool(np.abs((products - np.diag(expected)) / np.outer(lengths, lengths)).max() > 1e-4)  # float32: 1e-6


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


def triangles_of(shape: mi.Mesh) -> TriangleMesh:
    """Return the triangles of a mesh that Mitsuba has loaded [engine units]."""
    parameters = mi.traverse(shape)

    def rows(name: str, width: int) -> Float64:
        return np.asarray(parameters[name], dtype=np.float64).reshape(-1, width)

    return TriangleMesh(
        rows("vertex_positions", 3),
        np.asarray(parameters["faces"]).reshape(-1, 3),
        rows("vertex_texcoords", 2) if shape.has_vertex_texcoords() else None,
        rows("vertex_normals", 3) if shape.has_vertex_normals() else None,
    )


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


def _scaled(description: Mapping[str, object], unit: float) -> dict[str, object]:
    plugin = dict(description)
    if "to_world" in plugin:
        matrix = np.asarray(plugin["to_world"], dtype=np.float64).copy()
        matrix[:3] /= unit
        plugin["to_world"] = mi.ScalarTransform4f(matrix)
        return plugin
    for length in ("center", "radius", "p0", "p1"):
        if length in plugin:
            plugin[length] = (np.asarray(plugin[length], dtype=np.float64) / unit).tolist()
    return plugin
