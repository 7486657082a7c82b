"""A whole Mitsuba scene from XML: its shapes are measured here first, and what Mitsuba says is told by line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache, reduce
from pathlib import Path
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np

from nlosrender.config.fields import LONGEST, SHORTEST
from nlosrender.config.mitsuba_xml import image_files, read_mitsuba_xml
from nlosrender.config.xml_shapes import at_line, named, placement, shape_parameters
from nlosrender.config.xml_tree import numbered_text
from nlosrender.scene.build import shape_bounds
from nlosrender.scene.hidden_geometry import MESH_PLUGINS, ShapeDescription, box_corners
from nlosrender.scene.images import check_image
from nlosrender.scene.materials import first_line, rejected
from nlosrender.scene.mesh_file import read_mesh
from nlosrender.scene.pose import Float64
from nlosrender.scene.primitives import box_mesh, rectangle_mesh
from nlosrender.scene.transforms import transform_matrix
from nlosrender.scene.triangle_mesh import TriangleMesh

WHERE = "scene.mitsuba"
_ADVICE = "Check its size and its transformation."
_LINE = re.compile(r"(?:[Ee]rror while loading |[Ww]hile loading |[Aa]t |at )?string \(line (\d+), col \d+\)")


def load_xml_scene(path: Path) -> mi.Scene:
    """Load a Mitsuba scene; the backend has to be started before.

    Raises
    ------
    ConfigError
        It is not allowed, a shape has no extent or no bounds in float32, a file it names cannot be used, or Mitsuba
        rejects it; the line is named where there is one.
    """
    try:
        root, _ = read_mitsuba_xml(path)
        for shape in root.iter("shape"):
            _check_shape(shape)
        for image in image_files(root):
            check_image(image)
    except ValueError as error:
        raise rejected(WHERE, f"{path}: {error}.") from error
    scene = _loaded(root, path)
    for shape in scene.shapes():
        _check_bounds(shape, path)
    return scene


def _loaded(root: Element, path: Path) -> mi.Scene:
    text, lines = numbered_text(root)
    try:
        return mi.load_string(text)
    except (RuntimeError, TypeError, ValueError) as error:
        told = _LINE.sub(lambda found: f"line {lines[min(int(found[1]), len(lines)) - 1]}", first_line(error))
        raise rejected(WHERE, f"{path}: Mitsuba rejects this scene: {told}.") from error


def _check_shape(shape: Element) -> None:
    """Refuse a shape that float32 rounds to nothing, and read its mesh before Mitsuba does.

    Mitsuba's own readers end the process on a wrong index.
    """
    parameters = shape_parameters(shape)
    to_world = reduce(lambda matrix, step: transform_matrix(step) @ matrix, placement(shape), np.eye(4))
    try:
        mesh = _mesh_of(parameters)
        box = ShapeDescription(parameters).bounds() if mesh is None else mesh.bounds()
        if box is None:
            return  # only Mitsuba knows its extent
        corners = box_corners(box) @ to_world[:3, :3].T + to_world[:3, 3]
        extent, reach = float(np.ptp(corners, axis=0).max()), float(np.abs(corners).max())
        if not extent >= SHORTEST:
            raise ValueError(f"it is {extent:.3g} m large, need at least {SHORTEST:g} m. {_ADVICE}")
        if not reach <= LONGEST:
            raise ValueError(f"it reaches {reach:.4g} m from the origin, need at most {LONGEST:g} m. {_ADVICE}")
        if _rounded_to_nothing(mesh, corners, to_world):
            raise ValueError(f"float32 rounds it to nothing where it is. {_ADVICE}")
    except ValueError as error:
        raise ValueError(at_line(shape, f"{named(shape)}: {error}".removesuffix("."))) from error


def _mesh_of(parameters: Mapping[str, object]) -> TriangleMesh | None:
    """Return the triangles of a shape that has some, in its own coordinates; None for another."""
    kind = str(parameters["type"])
    if kind in ("cube", "disk", "rectangle"):
        return _unit_mesh(is_flat=kind != "cube")
    if kind not in MESH_PLUGINS:
        return None
    filename = str(parameters["filename"])
    try:
        return read_mesh(filename, kind, "flat")
    except ValueError as error:
        raise ValueError(f"{filename} cannot be used as a mesh: {error}") from error


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
