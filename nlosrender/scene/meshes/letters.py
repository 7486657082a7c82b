"""Text as flat or solid letters, generated from strokes: A-Z, 0-9 and space.

The centre lines of each glyph (``glyphs``) are widened to the stroke width, united, cut off at baseline and cap
height, and triangulated. No font is read, so that letters stay the same on every machine and for every release.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.glyphs import Glyph, Point, glyph_table
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64, Pose

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

Indices = NDArray[np.uint32]

CHARACTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 "
DEFAULT_STROKE_WIDTH = 0.2  # of the cap height: as bold as a sign, and the counters of B and 8 stay open
DEFAULT_SPACING = 0.2  # of the cap height, between the inked extents of neighbours: one stroke width
SPACE_WIDTH = 0.4  # of the cap height: half a wide letter


def letters_outline(
    text: str, height: float, stroke_width: float | None = None, spacing: float | None = None
) -> BaseGeometry:
    """Return the inked area of ``text`` as a shapely (multi)polygon, centred on the origin in x and y.

    Parameters as of ``letters_mesh``.
    """
    import shapely
    from shapely import affinity

    stroke = DEFAULT_STROKE_WIDTH if stroke_width is None else stroke_width / height
    gap = DEFAULT_SPACING if spacing is None else spacing / height
    glyphs = glyph_table()
    pen, inked = 0.0, []
    for character in text:
        if character == " ":
            pen += SPACE_WIDTH + gap
            continue
        outline = _glyph_outline(glyphs[character], stroke)
        left, _, right, _ = outline.bounds
        inked.append(affinity.translate(outline, pen - left, 0.0))
        pen += right - left + gap
    outline = shapely.union_all(inked)
    left, _, right, _ = outline.bounds
    return affinity.scale(affinity.translate(outline, -(left + right) / 2, -0.5), height, height, origin=(0.0, 0.0))


def letters_mesh(
    text: str,
    height: float,
    thickness: float = 0.0,
    stroke_width: float | None = None,
    spacing: float | None = None,
    pose: Pose | None = None,
) -> TriangleMesh:
    """Return ``text`` as triangles that do not overlap, readable from the side the pose's normal points to.

    Parameters
    ----------
    text
        Characters of ``CHARACTERS``, at least one of them not a space.
    height
        Cap height [m], > 0.
    thickness
        0 for a sheet in the pose's plane z = 0 (it has a front only); else [m], a closed solid with outward normals
        between z = -thickness/2 and z = +thickness/2.
    stroke_width
        Width of the strokes [m]; 0.2 * height when None, below 0.5 * height (legible up to 0.25).
    spacing
        Gap between neighbouring characters [m], >= 0; 0.2 * height when None.
    pose
        Centre of the text's extent, reading direction (x), up (y) and front normal (z); the mesh's frame when None.

    Returns
    -------
    TriangleMesh
        Texture coordinates run from 0 to 1 over the text's extent. Vertices are shared: in a solid every edge belongs
        to exactly two faces.
    """
    points, front, rims = _triangulated(letters_outline(text, height, stroke_width, spacing))
    extent = np.ptp(points, axis=0)
    uvs = points / extent + 0.5
    if thickness == 0:
        vertices, faces = np.column_stack([points, np.zeros(len(points))]), front
    else:
        z = np.repeat([thickness / 2, -thickness / 2], len(points))
        vertices = np.column_stack([np.tile(points, (2, 1)), z])
        faces, uvs = _solid_faces(front, rims, len(points)), np.tile(uvs, (2, 1))
    return TriangleMesh(vertices if pose is None else pose.to_scene(vertices), faces, uvs)


def _glyph_outline(glyph: Glyph, stroke: float) -> BaseGeometry:
    """Return the inked area of a glyph of cap height 1, as a polygon from y = 0 to y = 1 exactly."""
    import shapely

    # Centre lines keep half a stroke from the edges of the box, so that the ink fills it.
    scale = np.array([glyph.width - stroke, 1.0 - stroke])
    pieces = []
    for points in glyph.strokes:
        line = np.asarray(points) * scale + stroke / 2
        if points[0] == points[-1]:
            geometry = shapely.LinearRing(line)
        else:
            geometry = shapely.LineString(_extended(line, np.asarray(points), stroke))
        pieces.append(geometry.buffer(stroke / 2, cap_style="flat", join_style="mitre", mitre_limit=10.0))
    ink = shapely.union_all(pieces)
    left, right = (0.0, glyph.width) if glyph.cut_sides else (-10.0, 10.0)
    ink = ink.intersection(shapely.box(left, 0.0, right, 1.0))
    # 1e-9: drop vertices left over on straight edges; nothing visible moves.
    return shapely.simplify(ink, 1e-9)


def _extended(line: Float64, box_points: Float64, stroke: float) -> Float64:
    """Lengthen the ends of a stroke: straight ends by half a stroke, slanted ends at baseline and cap height past it.

    Any other end stays: it is a curve's, or lies within another stroke.
    """
    line = line.copy()
    for end, neighbour in ((0, 1), (-1, -2)):
        along = line[end] - line[neighbour]
        length = np.hypot(*along)
        if np.min(np.abs(along)) < 1e-9:
            line[end] += along / length * stroke / 2
        elif box_points[end, 1] in (0.0, 1.0):
            line[end] += along / length * 0.5  # cut off again at baseline and cap height
    return line


def _triangulated(outline: BaseGeometry) -> tuple[Float64, Indices, list[Indices]]:
    """Return vertices (n, 2), counter-clockwise faces (m, 3) and rims: rings of indices with the ink on their left."""
    import shapely
    from shapely.geometry import polygon

    polygons = [polygon.orient(part, 1.0) for part in shapely.get_parts(outline)]
    index: dict[Point, int] = {}
    rims = []
    for part in polygons:
        for ring in (part.exterior, *part.interiors):
            rims.append(np.array([index.setdefault(point, len(index)) for point in ring.coords[:-1]], np.uint32))
    faces = []
    for part in polygons:
        for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(part)):
            corners = polygon.orient(triangle, 1.0).exterior.coords[:-1]
            faces.append([index[corner] for corner in corners])
    return np.array(list(index)), np.array(faces, np.uint32), rims


def _solid_faces(front: Indices, rims: Iterable[Indices], n_front: int) -> Indices:
    """Return the faces of the solid whose back vertices follow its ``n_front`` front vertices in the same order."""
    faces = [front, front[:, ::-1] + n_front]
    for rim in rims:
        following = np.roll(rim, -1)
        faces.append(np.column_stack([rim, rim + n_front, following + n_front]))
        faces.append(np.column_stack([rim, following + n_front, following]))
    return np.concatenate(faces)
