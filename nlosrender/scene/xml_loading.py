"""A whole Mitsuba scene from XML: its shapes are measured here first, and what Mitsuba says is told by line."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache, reduce
from pathlib import Path
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np

from nlosrender.config.fields import LONGEST, SHORTEST
from nlosrender.config.mitsuba_xml import image_files, read_mitsuba_xml
from nlosrender.config.xml_shapes import named, placement, shape_parameters
from nlosrender.config.xml_tree import numbered_text, place_of
from nlosrender.scene.build import load_flat_serialized, shape_bounds
from nlosrender.scene.hidden_geometry import MESH_PLUGINS, ShapeDescription, box_corners
from nlosrender.scene.images import check_image
from nlosrender.scene.materials import first_line, rejected
from nlosrender.scene.mesh_file import read_mesh
from nlosrender.scene.pose import Float64
from nlosrender.scene.primitives import box_mesh, rectangle_mesh
from nlosrender.scene.transforms import transform_matrix
from nlosrender.scene.triangle_mesh import TriangleMesh
from nlosrender.scene.xml_textures import check_attributes, picture_warnings

WHERE = "scene.mitsuba"
SAME_AREA = 0.01  # float32, and bent quadrangles cut along the other diagonal
_AS_ITEM = "Write it as triangles, or take it as an item of scene.hidden_geometry."
_ADVICE = "Check its size and its transformation."
_UNKNOWN = re.compile(r"string \(line (\d+), col \d+\): Found \d+ unreferenced propert")
_PARAMETER = re.compile(r'^\s*- \w+ "([^"]+)"', re.MULTILINE)
_LINE = re.compile(r"(?:[Ee]rror while loading |[Ww]hile loading |[Aa]t |at )?string \(line (\d+), col \d+\)")


def load_xml_scene(path: Path) -> tuple[mi.Scene, tuple[str, ...]]:
    """Load a Mitsuba scene; the backend has to be started before.

    Returns
    -------
    tuple
        The scene, and what was left out of it or is hardly meant, a sentence each.

    Raises
    ------
    ConfigError
        It is not allowed, a shape has no extent or no bounds in float32, a file it names cannot be used, or Mitsuba
        rejects it; the line is named where there is one.
    """
    told: list[str] = []
    try:
        root, _ = read_mitsuba_xml(path)
        with_id = {part.get("id", ""): part for part in root.iter() if part.tag in ("bsdf", "texture")}
        for shape in root.iter("shape"):
            mesh = _check_shape(shape)
            check_attributes(shape, with_id)
            told += picture_warnings(shape, with_id, mesh)
        for image in image_files(root):
            check_image(image)
    except ValueError as error:
        raise rejected(WHERE, f"{path}: {error}.") from error
    scene, warnings = _loaded(root, path)
    for shape in scene.shapes():
        _check_bounds(shape, path)
    return scene, (*told, *warnings)


def _loaded(root: Element, path: Path) -> tuple[mi.Scene, tuple[str, ...]]:
    """Return the scene, and a sentence for each plugin with parameters that it does not have, which are left out."""
    warnings: list[str] = []
    while True:
        text, elements = numbered_text(root)
        try:
            return mi.load_string(text), tuple(warnings)
        except (RuntimeError, TypeError, ValueError) as error:
            unknown = _UNKNOWN.search(str(error))
            names = _PARAMETER.findall(str(error))
            plugin = elements[int(unknown[1]) - 1] if unknown else None
            if plugin is None or not any(child.get("name") in names for child in plugin):
                told = _LINE.sub(lambda found: place_of(elements[int(found[1]) - 1]), first_line(error))  # noqa: B023
                raise rejected(WHERE, f"{path}: Mitsuba rejects this scene: {told}.") from error
            warnings.append(_without_parameters(plugin, names))


def _without_parameters(plugin: Element, names: Sequence[str]) -> str:
    """Take parameters out of a plugin, and say so."""
    for child in [child for child in plugin if child.get("name") in names]:
        plugin.remove(child)
    listed = ", ".join(names)
    return f"{WHERE}: {place_of(plugin)}: {named(plugin)} has no parameter {listed}, which is left out."


def _check_shape(shape: Element) -> TriangleMesh | None:
    """Refuse a shape that float32 rounds to nothing; return its mesh, if it is one, which is read before Mitsuba does.

    Mitsuba's own readers end the process on a wrong index.
    """
    parameters = shape_parameters(shape)
    to_world = reduce(lambda matrix, step: transform_matrix(step) @ matrix, placement(shape), np.eye(4))
    try:
        mesh = _mesh_of(parameters)
        box = ShapeDescription(parameters).bounds() if mesh is None else mesh.bounds()
        if box is None:
            return None  # only Mitsuba knows its extent
        corners = box_corners(box) @ to_world[:3, :3].T + to_world[:3, 3]
        extent, reach = float(np.ptp(corners, axis=0).max()), float(np.abs(corners).max())
        if not extent >= SHORTEST:
            raise ValueError(f"it is {extent:.3g} m large, need at least {SHORTEST:g} m. {_ADVICE}")
        if not reach <= LONGEST:
            raise ValueError(f"it reaches {reach:.4g} m from the origin, need at most {LONGEST:g} m. {_ADVICE}")
        if _rounded_to_nothing(mesh, corners, to_world):
            raise ValueError(f"float32 rounds it to nothing where it is. {_ADVICE}")
        return mesh
    except ValueError as error:
        raise ValueError(f"{place_of(shape)}: {named(shape)}: {error}".removesuffix(".")) from error


def _mesh_of(parameters: Mapping[str, object]) -> TriangleMesh | None:
    """Return the triangles of a shape that has some, in its own coordinates; None for another."""
    kind = str(parameters["type"])
    if kind in ("cube", "disk", "rectangle"):
        return _unit_mesh(is_flat=kind != "cube")
    if kind not in (*MESH_PLUGINS, "serialized"):
        return None
    filename = str(parameters["filename"])
    try:
        if kind == "serialized":
            return _serialized(parameters)
        mesh = read_mesh(filename, kind, "flat")
        _check_reading(filename, kind, mesh)
        return mesh
    except ValueError as error:
        raise ValueError(f"{filename} cannot be used as a mesh: {error}") from error


def _serialized(parameters: Mapping[str, object]) -> TriangleMesh:
    """Return the triangles of a mesh in Mitsuba's own format."""
    try:
        mesh = load_flat_serialized(parameters)
    except RuntimeError as error:
        raise ValueError(first_line(error)) from error
    arrays = mi.traverse(mesh)
    return TriangleMesh(
        np.reshape(arrays["vertex_positions"], (-1, 3)), np.reshape(arrays["faces"], (-1, 3)).astype(np.uint32)
    )


def _check_reading(filename: str, kind: str, mesh: TriangleMesh) -> None:
    """Refuse a file of which Mitsuba, whose reader a scene file goes through, makes another surface than ours."""
    try:
        theirs = mi.load_dict({"type": kind, "filename": filename, "face_normals": True})
        area = float(np.ravel(theirs.surface_area())[0])
    except RuntimeError as error:
        raise ValueError(f"Mitsuba cannot read it: {first_line(error)}. {_AS_ITEM}") from error
    if abs(area - mesh.area) > SAME_AREA * mesh.area:
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
    if box is None or not float(np.abs(box).max()) <= LONGEST:
        extent = "has no extent" if box is None else f"reaches {float(np.abs(box).max()):.4g} m from the origin"
        identity = f" {shape.id()!r}" if shape.id() else ""
        raise rejected(WHERE, f"{path}: its {shape.class_name()}{identity} {extent}. {_ADVICE}")
