"""Textures in a Mitsuba scene that ask more of a shape than it has: attributes of its mesh, texture coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from xml.etree.ElementTree import Element

import mitsuba as mi
import numpy as np

from nlosrender.config.bsdf_table import TRANSMITTING
from nlosrender.config.xml_shapes import named, shape_parameters
from nlosrender.config.xml_tree import place_of
from nlosrender.scene.loading.mesh_attributes import AttributeUse
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.picture_orientation import TEXTURES_WITH_A_PLACE
from nlosrender.scene.pose import Float64
from nlosrender.scene.surfaces import MESH_PLUGINS

OWN_BUFFERS = ("vertex_positions", "vertex_normals", "vertex_texcoords", "vertex_count", "face_count")


def check_attributes(shape: Element, with_id: Mapping[str, Element]) -> None:
    """Raise ValueError for a texture that reads what a shape does not have, or reflectances above 1.

    Mitsuba accepts both: the first are black, and 8-bit colours 0 to 255.

    Parameters
    ----------
    shape
        A ``<shape>`` whose file, if it has one, has been read and checked.
    with_id
        The BSDFs and textures of the scene that a shape may refer to, by their ids.
    """
    textures = [each for each in _textures(shape, with_id) if each[1].get("type") == "mesh_attribute"]
    if not textures:
        return
    attributes: dict[str, Float64] = {}
    if shape.get("type") in MESH_PLUGINS:
        filename = str(shape_parameters(shape)["filename"])
        parameters = mi.traverse(mi.load_dict({"type": shape.get("type"), "filename": filename}))
        names = [name for name in parameters.keys() if name.split("_")[0] in ("vertex", "face")]  # noqa: SIM118
        attributes = {name: np.asarray(parameters[name]) for name in names if name not in OWN_BUFFERS}
    for parameter, texture in textures:
        values = shape_parameters(texture)
        try:
            AttributeUse(parameter, str(values.get("name")), float(values.get("scale", 1.0))).check(attributes)
        except ValueError as error:
            raise ValueError(f"{place_of(shape)}: {named(shape)}: {error}") from error


def picture_warnings(shape: Element, with_id: Mapping[str, Element], mesh: TriangleMesh) -> Iterator[str]:
    """Yield a sentence for a mesh file without texture coordinates that has a picture: it lies on every triangle."""
    has_picture = any(texture.get("type") in TEXTURES_WITH_A_PLACE for _, texture in _textures(shape, with_id))
    if has_picture and mesh.uvs is None:
        yield (
            f"scene.mitsuba: {place_of(shape)}: {named(shape)} has a picture, but its file no texture coordinates at "
            "every corner: Mitsuba puts the picture on each triangle. Give the file some, or take a plain reflectance."
        )


def has_two_sides(shape: Element, with_id: Mapping[str, Element]) -> bool:
    """Return whether a ``<shape>`` has a BSDF that does something at its back, too."""
    named_ones = [with_id[ref.get("id", "")] for ref in shape.findall("ref") if ref.get("id", "") in with_id]
    return any(bsdf.get("type") in TRANSMITTING for bsdf in (*shape.findall("bsdf"), *named_ones))


def _textures(
    element: Element, with_id: Mapping[str, Element], parameter: str = "", within: tuple[str, ...] = ()
) -> Iterator[tuple[str, Element]]:
    """Yield the textures in an element, and in what it refers to as ``parameter``, with what each is used as."""
    for texture in element.iter("texture"):
        yield texture.get("name") or parameter or "texture", texture
    for reference in element.iter("ref"):
        name = reference.get("id", "")
        if name in with_id and name not in within:
            yield from _textures(with_id[name], with_id, reference.get("name", ""), (*within, name))
