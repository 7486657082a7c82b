"""Reads .ply meshes: ASCII and binary, triangles, polygons and triangle strips, in float64.

Every count and index is checked against the size of the file before anything of its size is allocated: a wrong number
in a file is a message, never a crash.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.file_mesh import BYTE_ORDER_MARK, NO_UVS, FileMesh
from nlosrender.scene.meshes.ply_body import Lists, PlyRecords, PlyRows, read_records
from nlosrender.scene.meshes.ply_faces import TriangleCorners, polygon_corners, strip_corners, with_corner_uvs
from nlosrender.scene.meshes.ply_header import PlyHeader, read_header
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64

POSITION = ("x", "y", "z")
NORMALS = (("nx", "ny", "nz"),)
TEXTURE_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
COLORS = (("red", "green", "blue"), ("r", "g", "b"))
FACE_LISTS = ("vertex_indices", "vertex_index")
MATERIALS = ("texnumber", "material_index")  # of a face
FACES, STRIPS = "face", "tristrips"


def read_ply(content: bytes) -> FileMesh:
    """Return the mesh of a .ply file from its bytes, in the file's coordinates.

    Polygons are cut into triangles, strips taken apart. Texture coordinates are those of the faces' corners
    (``texcoord``) where every face has them, else those of the vertices.

    Raises
    ------
    ValueError
        The file is cut short or goes on after what its header promises, its header is damaged, a count, an index or a
        number cannot be, or a polygon crosses itself.
    """
    content = content.removeprefix(BYTE_ORDER_MARK)
    header = read_header(content)
    text = PlyRows.of(content, header) if header.is_ascii else None
    elements = read_records(content, header, text)
    if "vertex" not in elements or not set(POSITION) <= set(elements["vertex"].columns):
        raise ValueError("there is no element vertex with x, y and z")
    vertices = elements["vertex"].columns
    positions = TriangleMesh(_columns(vertices, POSITION), np.zeros((0, 3), dtype=np.int64)).vertices  # finite
    parts: list[TriangleCorners] = []
    doubts: tuple[str, ...] = ()
    if FACES in elements:
        uv_lists = elements[FACES].lists.get("texcoord")
        corners, doubts = polygon_corners(_indices(FACES, elements), uv_lists, positions, text)
        parts.append(corners)
    if STRIPS in elements:
        parts.append(strip_corners(_indices(STRIPS, elements), len(positions)))
    if not parts:
        raise ValueError("there is no element face: a cloud of points has no surface")
    uvs, normals, colors = (_optional(vertices, names) for names in (TEXTURE_COORDINATES, NORMALS, COLORS))
    faces, corner_uvs = np.concatenate([part.faces for part in parts]), [part.uvs for part in parts]
    mesh = TriangleMesh(positions, faces, uvs, normals, None if colors is None else _scaled(colors, header))
    whole_uvs = [values for values in corner_uvs if values is not None]
    if len(whole_uvs) == len(parts):
        mesh = with_corner_uvs(mesh, np.concatenate(whole_uvs))
    columns = elements[FACES].columns if FACES in elements else {}
    materials = (f"{name} {number:g}" for name in MATERIALS if name in columns for number in np.unique(columns[name]))
    lacking = [part.lacking_uvs for part in parts if part.lacking_uvs]
    dropped = (*_dropped(header), *["texture coordinates of some corners"] * len(lacking))
    no_uvs = "" if mesh.uvs is not None else (*lacking, NO_UVS)[0]
    return FileMesh(mesh, tuple(materials), dropped, doubts, no_uvs)


def _indices(element: str, elements: Mapping[str, PlyRecords]) -> Lists:
    for name in FACE_LISTS:
        if name in elements[element].lists:
            return elements[element].lists[name]
    raise ValueError(f"element {element} has no list {' or '.join(FACE_LISTS)}")


def _present(choices: Sequence[tuple[str, ...]], names: Container[str]) -> tuple[str, ...]:
    """Return the first group of names that are all there; none: ()."""
    return next((group for group in choices if all(name in names for name in group)), ())


def _columns(columns: Mapping[str, NDArray[Any]], names: Sequence[str]) -> Float64:
    return np.column_stack([columns[name].astype(np.float64) for name in names])


def _optional(columns: Mapping[str, NDArray[Any]], choices: Sequence[tuple[str, ...]]) -> Float64 | None:
    names = _present(choices, columns)
    return _columns(columns, names) if names else None


def _scaled(colors: Float64, header: PlyHeader) -> Float64:
    """Return colours (n, 3) of which whole numbers stand for 0 to 1, with -1 for what is no number."""
    kinds = header.kinds("vertex")
    types = [np.dtype(kinds[name]) for name in _present(COLORS, kinds)]
    scaled = colors / [np.iinfo(dtype).max if dtype.kind in "iu" else 1 for dtype in types]
    return np.where(np.isfinite(scaled), scaled, -1.0)


def _dropped(header: PlyHeader) -> tuple[str, ...]:
    """Return what the file has beside its surface, in a few words each."""
    names = header.kinds("vertex")
    color = _present(COLORS, names)
    of_vertex = {*POSITION, *_present(NORMALS, names), *_present(TEXTURE_COORDINATES, names), *color}
    read = {"vertex": of_vertex, FACES: {*FACE_LISTS, "texcoord", *MATERIALS}, STRIPS: {*FACE_LISTS}}
    found = [f"{', '.join(color)} of element vertex unless a mesh_attribute reads them"] if color else []
    for element in header.elements:
        if element.name not in read:
            found += [f"{element.count} of element {element.name}"] * bool(element.count)
            continue
        others = [prop.name for prop in element.properties if prop.name not in read[element.name]]
        found += [f"{', '.join(others)} of element {element.name}"] * bool(others and element.count)
    return tuple(found)
