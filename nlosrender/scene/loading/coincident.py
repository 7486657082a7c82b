"""Coincident surfaces: triangles in one place, or closer than rays resolve, are moved apart by 1.25 gaps.

Shadow rays end a ray offset (about 5e-7 of the scene's size) before a surface, and float32 intersections are good to
about 1e-7: of two surfaces closer than that, both would be lit, or either one met by chance. The later of the two, in
the order of the items and of the triangles of a mesh, is moved along its normal by more than the gap that rays resolve.
Visibility then decides as everywhere: what lies behind is dark, and their union counts once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.triangle_mesh import TriangleMesh, unit_rows
from nlosrender.scene.triangle_point import triangle_weights

# over 1 + the largest coordinate [engine units]: four times the ray offset of 5e-7. A shadow ray leaves one surface by
# an offset and ends another before the next; float32 rounds each by up to 1e-7
GAP = 2e-6
STEP = 1.25  # gaps by which triangles are moved: farther than the gap, so that they are not found again
FLATNESS = 4.0  # gaps that the corners of a triangle may be off the plane of the other; surfaces that cross are farther
SHIFT = GAP / 2  # more than float32 rounds by; rays from a gap off still meet what they would
EDGE = 1e-3  # barycentric distance from an edge, at most two gaps, in which float32 may meet a neighbour in the plane
MIN_POINTS = 2**16  # tried on all meshes of a scene: 65 of them lie in an overlap of 1e-3 of the area
NEXT_POINTS = 64  # tried on each triangle beside one that coincides
DISK_POINTS = 4096  # tried on each disk
MIN_DISK_SHARE = 0.01  # of these within the gap: of surfaces that cross the disk only a thin strip is
MAX_LAYERS = 32  # in one place that are moved apart: each takes a pass, which loads the scene anew


@dataclass(frozen=True, eq=False)
class Overlap:
    """Triangles of one mesh that coincide with others."""

    mesh: int
    other: int  # the mesh that most of them lie on
    faces: NDArray[np.bool_]  # (m,) to be moved
    share: float  # of the mesh's area that these have


def overlaps(
    scene: mi.Scene, shapes: Sequence[mi.Shape], meshes: Mapping[int, TriangleMesh], seed: int = 0
) -> list[Overlap]:
    """Find triangles that lie within ``GAP`` of earlier ones.

    Points of all triangles are tried, in proportion to area but two of each at least, by a ray that comes from just
    outside and goes to just inside. Of two triangles in one plane the ray tracer meets the one that it keeps last, so
    that only the larger ones' points may tell. Once any is found, rays from either side are sent through triangles that
    are shifted by random parts of the gap: of two in one place one way meets the other one. More points are tried on
    the neighbours of those found, until none is.

    Parameters
    ----------
    scene, shapes
        Scene, and its hidden shapes.
    meshes
        Those of the shapes that are meshes, by their number, in engine units; of others nothing is found.
    seed
        Of the points.
    """
    if not meshes:
        return []
    joined = TriangleMesh.merged([TriangleMesh(mesh.vertices, mesh.faces) for mesh in meshes.values()])
    owners = np.repeat(list(meshes), [len(mesh.faces) for mesh in meshes.values()])  # mesh of each triangle
    in_scene = list(scene.shapes())
    first = np.zeros(len(in_scene), np.uint32)  # triangle in ``joined`` of each of the scene's shapes, plus 1
    for number in meshes:
        first[in_scene.index(shapes[number])] = np.searchsorted(owners, number) + 1
    areas = joined.areas()
    points = 1 + np.ceil(areas / areas.sum() * max(MIN_POINTS, len(areas))).astype(np.intp)
    if not _pairs(scene, joined, points, mi.UInt32(first), seed).size:
        return []
    shifted, tried, found = _shifted(joined, seed), np.zeros(len(areas), bool), []
    while points.any():
        found += [_pairs(shifted, joined, points, mi.UInt32(1), seed, way) for way in (-1, 1)]
        touched = np.zeros(len(joined.vertices), bool)
        touched[joined.faces[np.concatenate(found[-2:], axis=1)]] = True
        is_next = touched[joined.faces].any(axis=1) & ~tried
        tried |= is_next
        points = NEXT_POINTS * is_next
    pairs = np.concatenate(found, axis=1)
    # in a mesh what faces away from the wall counts as later: both sides of a sheet are then one layer each
    turned_away = np.einsum("ij,ij->i", joined.face_normals(), joined.vertices[joined.faces[:, 0]]) > 0
    rank = (2 * owners + turned_away) * len(owners) + np.arange(len(owners))
    earlier, later = np.take_along_axis(pairs, np.argsort(rank[pairs], axis=0), axis=0)
    result = []
    for number in np.unique(owners[later]).tolist():
        of_this = owners[later] == number
        faces = np.zeros(len(owners), bool)
        faces[later[of_this]] = True
        other = int(np.bincount(owners[earlier[of_this]]).argmax())
        share = areas[faces].sum() / areas[owners == number].sum()
        result.append(Overlap(number, other, faces[owners == number], float(share)))
    return result


def coincident_disks(shapes: Sequence[mi.Shape]) -> list[tuple[int, int]]:
    """Return pairs of a disk and a shape that coincide: disks are no triangles, and are not moved."""
    pairs = []
    for number, shape in enumerate(shapes):
        others = [other for other in range(len(shapes)) if other != number]
        if shape.class_name() != "Disk" or not others:
            continue
        scene = mi.load_dict({"type": "scene"} | {f"other_{other}": shapes[other] for other in others})
        random = np.random.default_rng(0).random((2, DISK_POINTS)).astype(np.float32)
        sample = shape.sample_position(mi.Float(0), mi.Point2f(random))
        reach = mi.Vector3f(sample.n) * (GAP * (1 + dr.max(dr.abs(sample.p))))
        hit = scene.ray_intersect_preliminary(mi.Ray3f(sample.p + reach, -2 * reach, mi.Float(1), mi.Float(0), []))
        in_scene = list(scene.shapes())
        counts = np.bincount(np.array(hit.shape_index)[np.array(hit.is_valid())], minlength=len(in_scene))
        pairs += [
            (number, other) for other in others if counts[in_scene.index(shapes[other])] > MIN_DISK_SHARE * DISK_POINTS
        ]
    return pairs


def moved_apart(mesh: TriangleMesh, faces: NDArray[np.bool_], *, both_sides: bool) -> TriangleMesh:
    """Return the mesh with some of its faces (m,) moved along their normals, as the last of its faces.

    A surface that reflects from ``both_sides`` is moved towards the origin, where the relay wall is.
    """
    moved = mesh.subset(faces)
    normals = moved.face_normals()
    if both_sides:
        normals = normals * -np.sign(np.einsum("ij,ij->i", normals, moved.vertices[moved.faces].mean(axis=1)))[:, None]
    at_vertices = np.zeros_like(moved.vertices)
    for corner in range(3):
        np.add.at(at_vertices, moved.faces[:, corner], normals)
    step = STEP * GAP * (1 + np.abs(moved.vertices).max(axis=1, keepdims=True))
    moved = replace(moved, vertices=moved.vertices + unit_rows(at_vertices) * step)
    return TriangleMesh.merged([mesh.subset(~faces), moved]) if not faces.all() else moved


def _shifted(mesh: TriangleMesh, seed: int) -> mi.Scene:
    """Return a scene of the triangles of a mesh, each moved along its normal by a random part of ``SHIFT``."""
    corners = mesh.vertices[mesh.faces]
    parts = SHIFT * (1 + np.abs(corners).max(axis=(1, 2))) * np.random.default_rng(seed).random(len(corners))
    corners += (mesh.face_normals() * parts[:, None])[:, None]
    shape = mi.Mesh("shifted", vertex_count=3 * len(corners), face_count=len(corners))
    parameters = mi.traverse(shape)
    parameters["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
    parameters["vertex_positions"] = corners.ravel().astype(np.float32)
    parameters.update()
    return mi.load_dict({"type": "scene", "shifted": shape})


def _pairs(
    scene: mi.Scene, mesh: TriangleMesh, points: NDArray[np.intp], first: mi.UInt32, seed: int, way: int = -1
) -> NDArray[np.uint32]:
    """Return pairs (2, n) of triangles of ``mesh`` in one plane, one within ``GAP`` before a point of the other.

    ``points`` (m,) of each triangle are tried. ``first`` is, for each shape of the scene, the triangle of ``mesh`` that
    it begins with, plus 1; 0 for other shapes. ``way`` of the rays: -1 against the normals, 1 along them.
    """
    own = mi.UInt32(np.repeat(np.arange(len(points), dtype=np.uint32), points))
    faces, vertices = mi.UInt32(np.ravel(mesh.faces)), mi.Float(np.ravel(mesh.vertices).astype(np.float32))

    def corners(face: mi.UInt32) -> list[mi.Point3f]:
        return [dr.gather(mi.Point3f, vertices, dr.gather(mi.UInt32, faces, 3 * face + k)) for k in range(3)]

    lane, number = dr.arange(mi.UInt32, dr.width(own)), dr.opaque(mi.UInt32, 2 * seed)
    first_number, second_number = (mi.sample_tea_float32(lane, number + k) for k in range(2))
    _, at_b, at_c = triangle_weights(first_number, EDGE + (1 - 2 * EDGE) * second_number, dr.sqrt)
    a, b, c = corners(own)
    point = a + (b - a) * at_b + (c - a) * at_c
    normal = dr.normalize(dr.cross(b - a, c - a))
    reach = normal * (way * GAP * (1 + dr.max(dr.abs(point))))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(point - reach, 2 * reach, mi.Float(1), mi.Float(0), []))
    start = dr.gather(mi.UInt32, first, hit.shape_index, hit.is_valid())
    met = start - 1 + hit.prim_index
    chosen = (start > 0) & (met != own)
    # in one plane, not across each other: surfaces that cross are in one place in a thin strip alone
    here, there = [a, b, c], corners(dr.select(chosen, met, 0))
    normals = [dr.cross(q - p, r - p) for p, q, r in (here, there)]
    (u, v), (p, q, r) = hit.prim_uv, there
    longest = dr.sqrt(dr.maximum(dr.maximum(*map(dr.squared_norm, (q - p, r - p))), dr.squared_norm(r - q)))
    margin = dr.minimum(EDGE, 2 * GAP * (1 + dr.max(dr.abs(point))) * longest / dr.norm(normals[1]))
    chosen &= dr.minimum(dr.minimum(u, v), 1 - u - v) > margin
    is_larger = dr.squared_norm(normals[0]) > dr.squared_norm(normals[1])
    plane, corner = dr.normalize(dr.select(is_larger, *normals)), dr.select(is_larger, here[0], there[0])
    for k in range(3):
        off = dr.dot(plane, dr.select(is_larger, there[k], here[k]) - corner)
        chosen &= dr.abs(off) < FLATNESS * GAP * (1 + dr.max(dr.abs(corner)))
    index = dr.compress(chosen)
    return np.stack([dr.gather(mi.UInt32, values, index).numpy() for values in (own, met)])
