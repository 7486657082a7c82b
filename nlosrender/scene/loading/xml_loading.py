"""Loads a whole Mitsuba scene from XML: shapes are measured first, and Mitsuba's errors are given by line."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache, reduce
from pathlib import Path
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np

from nlosrender.config.fields import MAX_LENGTH, MIN_LENGTH
from nlosrender.config.mitsuba_xml import image_files, read_mitsuba_xml
from nlosrender.config.xml_shapes import named, placement, shape_parameters
from nlosrender.config.xml_tree import numbered_text, place_of
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import box_corners
from nlosrender.scene.loading import exact_blend
from nlosrender.scene.loading.image_size import check_image
from nlosrender.scene.loading.materials import first_line
from nlosrender.scene.loading.mitsuba_shapes import load_flat_serialized, shape_bounds, triangles_of
from nlosrender.scene.loading.xml_textures import check_attributes, has_two_sides, picture_warnings
from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_file import read_mesh_file
from nlosrender.scene.meshes.mesh_normals import with_normals
from nlosrender.scene.meshes.mesh_report import MeshReport, mesh_report
from nlosrender.scene.meshes.primitives import box_mesh, rectangle_mesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64
from nlosrender.scene.surfaces import MESH_PLUGINS, ShapeDescription
from nlosrender.scene.transforms import transform_matrix

WHERE = "scene.mitsuba"
MAX_AREA_DIFFERENCE = 0.01  # of float32, and of bent quadrangles cut along the other diagonal; misread files lose more
_AS_ITEM = "Write it as triangles, or take it as an item of scene.hidden_geometry."
_ADVICE = "Check its size and its transformation."
_UNKNOWN = re.compile(r"string \(line (\d+), col \d+\): Found \d+ unreferenced propert")
_PARAMETER = re.compile(r'^\s*- \w+ "([^"]+)"', re.MULTILINE)
_LINE = re.compile(r"(?:[Ee]rror while loading |[Ww]hile loading |[Aa]t |at )?string \(line (\d+), col \d+\)")


def load_xml_scene(
    path: Path, *, joins_meshes: bool = True
) -> tuple[mi.Scene, tuple[MeshReport, ...], tuple[str, ...]]:
    """Load a Mitsuba scene; the backend has to be started before.

    ``joins_meshes``: meshes of one BSDF become one shape.

    Returns
    -------
    tuple
        The scene; reports of its mesh files; and a sentence for everything left out of it or likely a mistake.

    Raises
    ------
    ConfigError
        It is not allowed, a shape has no extent or no bounds in float32, a file it names cannot be used, or Mitsuba
        rejects it; the line is named where there is one.
    """
    warnings: list[str] = []
    meshes: list[MeshReport] = []
    try:
        root, _ = read_mitsuba_xml(path)
        with_id = {part.get("id", ""): part for part in root.iter() if part.tag in ("bsdf", "texture")}
        for shape in root.iter("shape"):
            read = _check_shape(shape)
            check_attributes(shape, with_id)
            if read is not None:
                meshes.append(_report(shape, read))
                warnings += meshes[-1].warnings(read, has_two_sides=has_two_sides(shape, with_id))
                warnings += picture_warnings(shape, with_id, read.mesh)
        for image in image_files(root):
            check_image(image)
    except ValueError as error:
        raise ConfigError.at(WHERE, f"{path}: {error}.") from error
    scene, left_out = _loaded(root, path, joins_meshes)
    for shape in scene.shapes():
        _check_bounds(shape, path)
    return scene, tuple(meshes), (*warnings, *left_out)


def _loaded(root: Element, path: Path, joins_meshes: bool) -> tuple[mi.Scene, tuple[str, ...]]:
    """Return the scene, and a sentence for each plugin with parameters that it does not have, which are left out."""
    warnings: list[str] = []
    for element in root.iter("bsdf"):
        if element.get("type") == exact_blend.MITSUBA_NAME:
            element.set("type", exact_blend.NAME)
    while True:
        text, elements = numbered_text(root)
        try:
            return mi.load_string(text, optimize=joins_meshes), tuple(warnings)
        except (RuntimeError, TypeError, ValueError) as error:
            unknown = _UNKNOWN.search(str(error))
            names = _PARAMETER.findall(str(error))
            plugin = elements[int(unknown[1]) - 1] if unknown else None
            if plugin is None or not any(child.get("name") in names for child in plugin):
                message = _LINE.sub(lambda found: place_of(elements[int(found[1]) - 1]), first_line(error))  # noqa: B023
                raise ConfigError.at(WHERE, f"{path}: Mitsuba rejects this scene: {message}.") from error
            warnings.append(_without_parameters(plugin, names))


def _without_parameters(plugin: Element, names: Sequence[str]) -> str:
    """Take parameters out of a plugin, and say so."""
    for child in [child for child in plugin if child.get("name") in names]:
        plugin.remove(child)
    listed = ", ".join(names)
    return f"{WHERE}: {place_of(plugin)}: {named(plugin)} has no parameter {listed}, which is left out."


def _check_shape(shape: Element) -> FileMesh | None:
    """Refuse a shape that float32 rounds to nothing; return what its file holds, if it has one.

    That is read before Mitsuba does: its own readers end the process on a wrong index.
    """
    parameters, to_world = shape_parameters(shape), _to_world(shape)
    try:
        read, mesh = _mesh_of(parameters)
        box = ShapeDescription(parameters).bounds() if mesh is None else mesh.bounds()
        if box is None:
            return None  # only Mitsuba knows its extent
        corners = box_corners(box) @ to_world[:3, :3].T + to_world[:3, 3]
        extent, reach = float(np.ptp(corners, axis=0).max()), float(np.abs(corners).max())
        if not extent >= MIN_LENGTH:
            raise ValueError(f"it is {extent:.3g} m large, need at least {MIN_LENGTH:g} m. {_ADVICE}")
        if not reach <= MAX_LENGTH:
            raise ValueError(f"it reaches {reach:.4g} m from the origin, need at most {MAX_LENGTH:g} m. {_ADVICE}")
        if _rounded_to_nothing(mesh, corners, to_world):
            raise ValueError(f"float32 rounds it to nothing where it is. {_ADVICE}")
        return read
    except ValueError as error:
        raise ValueError(f"{place_of(shape)}: {named(shape)}: {error}".removesuffix(".")) from error


def _to_world(shape: Element) -> Float64:
    return reduce(lambda matrix, step: transform_matrix(step) @ matrix, placement(shape), np.eye(4))


def _report(shape: Element, read: FileMesh) -> MeshReport:
    """Return the report of a mesh, with the normals that Mitsuba gives it."""
    parameters = shape_parameters(shape)
    mesh, normals = with_normals(read.mesh, "flat" if parameters.get("face_normals") is True else "mitsuba")
    mesh = mesh.transformed(_to_world(shape))
    mesh = mesh.turned_round() if parameters.get("flip_normals") is True else mesh
    name = shape.get("id") or f"shape at {place_of(shape)}"
    return mesh_report(WHERE, name, Path(str(parameters["filename"])).name, read, mesh, normals, None)


def _mesh_of(parameters: Mapping[str, object]) -> tuple[FileMesh | None, TriangleMesh | None]:
    """Return what the .obj or .ply file of a shape holds, and the shape's triangles in its own coordinates.

    None for a shape without.
    """
    kind, filename = str(parameters["type"]), str(parameters.get("filename"))
    if kind in ("cube", "disk", "rectangle"):
        return None, _unit_mesh(is_flat=kind != "cube")
    try:
        if kind in MESH_PLUGINS:
            read = read_mesh_file(filename, kind)
            _check_reading(filename, kind, read.mesh)
            return read, read.mesh
        return None, triangles_of(load_flat_serialized(parameters)) if kind == "serialized" else None
    except (RuntimeError, ValueError) as error:
        reason = first_line(error) if isinstance(error, RuntimeError) else error
        raise ValueError(f"{filename} cannot be used as a mesh: {reason}") from error


def _check_reading(filename: str, kind: str, mesh: TriangleMesh) -> None:
    """Refuse a file of which Mitsuba, whose reader a scene file goes through, makes another surface than ours."""
    try:
        theirs = mi.load_dict({"type": kind, "filename": filename, "face_normals": True})
        area = float(np.ravel(theirs.surface_area())[0])
    except RuntimeError as error:
        raise ValueError(f"Mitsuba cannot read it: {first_line(error)}. {_AS_ITEM}") from error
    if abs(area - mesh.area) > MAX_AREA_DIFFERENCE * mesh.area:
        raise ValueError(f"Mitsuba reads {area:.4g} of its {mesh.area:.4g} square units. {_AS_ITEM}")


@cache  # scenes may have thousands
def _unit_mesh(is_flat: bool) -> TriangleMesh:
    return rectangle_mesh(2.0, 2.0) if is_flat else box_mesh((2.0, 2.0, 2.0))


def _rounded_to_nothing(mesh: TriangleMesh | None, corners: Float64, to_world: Float64) -> bool:
    """Return whether no triangle of a placed mesh, or no width of a round shape's box, is left in float32."""
    if mesh is None:
        return not np.ptp(corners.astype(np.float32), axis=0).all()
    placed = mesh.transformed(to_world)
    return not len(TriangleMesh(placed.vertices.astype(np.float32), placed.faces).with_area_only().faces)


def _check_bounds(shape: mi.Shape, path: Path) -> None:
    """Refuse what transformations have made of a shape's numbers: nothing, or more than float32 can square."""
    box = shape_bounds(shape, 1.0)
    if box is None or not float(np.abs(box).max()) <= MAX_LENGTH:
        extent = "has no extent" if box is None else f"reaches {float(np.abs(box).max()):.4g} m from the origin"
        identity = f" {shape.id()!r}" if shape.id() else ""
        raise ConfigError.at(WHERE, f"{path}: its {shape.class_name()}{identity} {extent}. {_ADVICE}")
