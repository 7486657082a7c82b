"""Reads .ply meshes: ASCII and binary, triangles, polygons and triangle strips, in float64.

Every count and index is held against what the file has before anything of its size is made: a wrong number in a file
is a message, never a crash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.file_mesh import BYTE_ORDER_MARK, FileMesh
from nlosrender.scene.ply_faces import (
    CornerUvs,
    Lists,
    TriangleCorners,
    polygon_corners,
    strip_corners,
    with_corner_uvs,
)
from nlosrender.scene.ply_header import PlyElement, PlyHeader, read_header
from nlosrender.scene.ply_text import PlyRows
from nlosrender.scene.triangle_mesh import TriangleMesh

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
TEXTURE_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))
COLORS = (("red", "green", "blue"), ("r", "g", "b"))
FACE_LISTS = ("vertex_indices", "vertex_index")
MATERIALS = ("texnumber", "material_index")  # of a face
FACES, STRIPS = "face", "tristrips"

Columns = dict[str, NDArray]  # of an element's single values, by their names


def read_ply(content: bytes) -> FileMesh:
    """Return the mesh of a .ply file.

    Parameters
    ----------
    content
        The file's bytes.

    Returns
    -------
    FileMesh
        In the file's coordinates. Polygons are cut into triangles, strips taken apart. Texture coordinates are those
        of the faces' corners (``texcoord``) where every face has them, else those of the vertices.

    Raises
    ------
    ValueError
        The file is cut short or goes on after what its header promises, its header is damaged, a count, an index or a
        number cannot be, or a polygon crosses itself.
    """
    content = content.removeprefix(BYTE_ORDER_MARK)
    header = read_header(content)
    elements, text = _elements(content, header)
    if "vertex" not in elements or not set(POSITION) <= set(elements["vertex"][0]):
        raise ValueError("there is no element vertex with x, y and z")
    vertices = elements["vertex"][0]
    positions = TriangleMesh(_columns(vertices, POSITION), np.zeros((0, 3), dtype=np.int64)).vertices  # finite
    parts: list[TriangleCorners] = []
    doubts: tuple[str, ...] = ()
    if FACES in elements:
        lists = elements[FACES][1]
        corners, doubts = polygon_corners(_indices(FACES, lists), lists.get("texcoord"), positions, text)
        parts.append(corners)
    if STRIPS in elements:
        parts.append(strip_corners(_indices(STRIPS, elements[STRIPS][1]), len(positions)))
    if not parts:
        raise ValueError("there is no element face: a cloud of points has no surface")
    uvs = next((_columns(vertices, names) for names in TEXTURE_COORDINATES if set(names) <= set(vertices)), None)
    normals = _columns(vertices, NORMAL) if set(NORMAL) <= set(vertices) else None
    faces, corner_uvs = np.concatenate([part.faces for part in parts]), _joined_uvs(parts)
    mesh = TriangleMesh(positions, faces, uvs, normals, _colors(vertices, header))
    if corner_uvs is not None:
        mesh = with_corner_uvs(mesh, corner_uvs)
    columns = elements[FACES][0] if FACES in elements else {}
    lacking = [part.lacking_uvs for part in parts if part.lacking_uvs]
    dropped = (*_dropped(header), *["texture coordinates of some corners"] * len(lacking))
    no_uvs = "" if mesh.uvs is not None else (*lacking, "it has no texture coordinates")[0]
    return FileMesh(mesh, _materials(columns), dropped, doubts, no_uvs)


def _elements(content: bytes, header: PlyHeader) -> tuple[dict[str, tuple[Columns, dict[str, Lists]]], PlyRows | None]:
    """Return every element's single values and lists by their names, and the rows of an ASCII file."""
    text = PlyRows.of(content, header) if header.is_ascii else None
    body = memoryview(content)[header.size :]
    found = {}
    for element in header.elements:
        if text is not None:
            body = memoryview(text.take(element).tobytes())
        columns, lists, used = _records(element, body)
        body = body[used:]
        found[element.name] = columns, lists
    if text is not None:
        text.refuse_rest(header)
    elif bytes(body[:1024]).strip() or len(body) > 1024:
        raise ValueError(f"{len(body)} bytes are left over after what its header promises: {header.promised()}")
    return found, text


def _indices(element: str, lists: Mapping[str, Lists]) -> Lists:
    named = [lists[name] for name in FACE_LISTS if name in lists]
    if not named:
        raise ValueError(f"element {element} has no list {' or '.join(FACE_LISTS)}")
    return named[0]


def _columns(columns: Mapping[str, NDArray], names: Sequence[str]) -> NDArray[np.float64]:
    return np.column_stack([columns[name].astype(np.float64) for name in names])


def _colors(vertices: Columns, header: PlyHeader) -> NDArray[np.float64] | None:
    """Return the colours of the vertices, (n, 3); whole numbers stand for 0 to 1, and -1 for what is no number."""
    names = next((names for names in COLORS if set(names) <= set(vertices)), None)
    if names is None:
        return None
    types = [np.dtype(header.written_as("vertex", name)) for name in names]
    whole = [np.iinfo(dtype).max if dtype.kind in "iu" else 1 for dtype in types]
    colors = _columns(vertices, names) / whole
    return np.where(np.isfinite(colors), colors, -1.0)


def _joined_uvs(parts: Sequence[TriangleCorners]) -> CornerUvs | None:
    uvs = [part.uvs for part in parts if part.uvs is not None]
    return np.concatenate(uvs) if uvs and len(uvs) == len(parts) else None


def _materials(columns: Columns) -> tuple[str, ...]:
    """Return what the faces say of their pictures or materials, which are numbers here."""
    found = [f"{name} {number:g}" for name in MATERIALS if name in columns for number in np.unique(columns[name])]
    return tuple(found)


def _dropped(header: PlyHeader) -> tuple[str, ...]:
    """Return what the file has beside its surface, in a few words each."""
    pair = next((names for names in TEXTURE_COORDINATES if set(names) <= set(header.names("vertex"))), ())
    normal = NORMAL if set(NORMAL) <= set(header.names("vertex")) else ()
    color = next((names for names in COLORS if set(names) <= set(header.names("vertex"))), ())
    read = {FACES: {*FACE_LISTS, "texcoord", *MATERIALS}, STRIPS: {*FACE_LISTS}}
    read |= {"vertex": {*POSITION, *normal, *pair, *color}}
    found = [f"{', '.join(color)} of element vertex unless a mesh_attribute reads them"] if color else []
    for element in header.elements:
        if element.name not in read:
            found += [f"{element.count} of element {element.name}"] * bool(element.count)
            continue
        others = [name for name in header.names(element.name) if name not in read[element.name]]
        found += [f"{', '.join(others)} of element {element.name}"] * bool(others and element.count)
    return tuple(found)


def _records(element: PlyElement, body: memoryview) -> tuple[Columns, dict[str, Lists], int]:
    """Return an element's values, and the number of bytes they take.

    Lists of one length make records of one size, which numpy reads at once: the records are read in runs of
    equal lengths.
    """
    lists = [index for index, prop in enumerate(element.properties) if prop.count_dtype is not None]
    singles: dict[str, list[NDArray]] = {p.name: [] for p in element.properties if p.count_dtype is None}
    values: dict[str, Lists] = {element.properties[index].name: [] for index in lists}
    done, offset, window = 0, 0, element.count
    while done < element.count and element.properties:
        lengths = _lengths(element, body[offset:], done)
        dtype = element.dtype(lengths)
        fitting = (len(body) - offset) // dtype.itemsize
        if fitting == 0 or (fitting < element.count - done and not lists):
            raise element.cut_short(done + fitting)
        run = np.frombuffer(body, dtype, min(element.count - done, fitting, max(window, 1)), offset)
        same = np.ones(len(run), dtype=bool)
        for index, length in zip(lists, lengths, strict=True):
            same &= run[f"{index}n"] == length
        count = len(run) if same.all() else int(np.argmin(same))
        # a run that ends early is followed by short looks, or mixed polygons would be read again and again
        window = 2 * window if count == len(run) else 2 * count
        for index, prop in enumerate(element.properties):
            if prop.count_dtype is None:
                singles[prop.name].append(run[f"{index}"][:count])
            else:
                values[prop.name].append(run[f"{index}"][:count])
        done, offset = done + count, offset + count * dtype.itemsize
    return {name: _joined(parts) for name, parts in singles.items()}, values, offset


def _joined(parts: list[NDArray]) -> NDArray:
    return np.concatenate(parts) if parts else np.zeros(0)


def _lengths(element: PlyElement, body: memoryview, record: int) -> list[int]:
    """Return the lengths of the lists of the next record, all of which fit into the body."""
    lengths: list[int] = []
    for index, prop in enumerate(element.properties):
        if prop.count_dtype is None:
            continue
        before = element.dtype(lengths, index).itemsize
        if before + np.dtype(prop.count_dtype).itemsize > len(body):
            raise element.cut_short(record)
        length = float(np.frombuffer(body, prop.count_dtype, 1, before)[0])
        if not 0 <= length <= element.longest_list or length != int(length):
            raise ValueError(element.no_length(record, length))
        if length * np.dtype(prop.dtype).itemsize > len(body):
            raise element.cut_short(record)
        lengths.append(int(length))
    return lengths
