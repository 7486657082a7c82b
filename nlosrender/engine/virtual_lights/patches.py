"""Hidden surfaces -> patches small enough to be gathered as one light each.

A patch of size h at distance d from the wall has an error of order (h/d)^2 in its geometry and of h^2/(4 d w) bins
in its delay, with w the bin width: within a triangle the delay is taken as linear. One number, ``coarseness``,
scales the size allowed by both, so that the error falls with its square.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.build import WALL_ID, BuiltScene
from nlosrender.scene.pose import Float64

MAX_PATCHES = 4_000_000  # of one gather; beyond it the path engine is the better choice


@dataclass(frozen=True, eq=False)
class Patches:
    """Triangular patches of the hidden geometry [engine units].

    ``areas``, ``centres`` and ``normals`` are those of the true surface where it is curved; ``corners`` lie on it.
    """

    corners: Float64  # (n, 3, 3)
    areas: Float64  # (n,)
    centres: Float64  # (n, 3)
    normals: Float64  # (n, 3) geometric, unit
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of a mesh, 0 on analytic shapes
    barycentric: Float64  # (n, 2) the centre within that triangle
    lifts: Float64  # (n,) height of the surface over the plane of the corners: where shadow rays may end

    def __len__(self) -> int:
        return len(self.areas)

    @classmethod
    def joined(cls, parts: list[Patches]) -> Patches:
        """Return the patches of all parts."""
        names = ("corners", "areas", "centres", "normals", "shapes", "primitives", "barycentric", "lifts")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class Tessellator:
    """Cuts the hidden geometry of one scene into patches, as fine as asked.

    Parameters
    ----------
    built
        The scene: meshes, spheres and cylinders; ``can_tessellate`` tells beforehand.
    bin_width
        Bin width [engine units].
    """

    def __init__(self, built: BuiltScene, bin_width: float):
        self.built, self.bin_width = built, bin_width
        self._meshes: list[tuple[int, Float64]] = []
        self._spheres: list[tuple[int, Float64]] = []  # centre and signed radius
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID:
                continue
            if shape.is_mesh():
                parameters = mi.traverse(shape)
                vertices = np.asarray(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
                self._meshes.append((index, vertices[np.asarray(parameters["faces"]).reshape(-1, 3)]))
            else:
                self._spheres.append((index, _sphere_of(shape)))

    def patches(self, coarseness: float) -> Patches:
        """Return patches whose error is of order ``coarseness`` squared."""
        parts = [self._flat(index, triangles, coarseness) for index, triangles in self._meshes]
        parts += [self._sphere(index, sphere, coarseness) for index, sphere in self._spheres]
        return Patches.joined(parts)

    def count(self, coarseness: float) -> int:
        """Return how many patches ``patches`` would make, without making them."""
        flat = sum(int((self._splits(triangles, coarseness) ** 2).sum()) for _, triangles in self._meshes)
        return flat + sum(20 * self._sphere_splits(sphere, coarseness) ** 2 for _, sphere in self._spheres)

    def _allowed(self, distance: Float64, coarseness: float) -> Float64:
        """Return the size a patch may have at ``distance`` from the wall [engine units]."""
        return coarseness * np.minimum(distance, 2 * np.sqrt(distance * self.bin_width))

    def _splits(self, triangles: Float64, coarseness: float) -> NDArray[np.int64]:
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1)
        distance = np.maximum(self._distance_to_wall(triangles.mean(axis=1)), edges / 8)
        return np.maximum(np.ceil(edges / self._allowed(distance, coarseness)), 1).astype(np.int64)

    def _distance_to_wall(self, points: Float64) -> Float64:
        half = np.array([self.built.wall.width, self.built.wall.height]) / (2 * self.built.unit)
        beyond = np.maximum(np.abs(points[:, :2]) - half, 0)
        return np.sqrt((beyond**2).sum(axis=1) + points[:, 2] ** 2)

    def _flat(self, index: int, triangles: Float64, coarseness: float) -> Patches:
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        kept = np.flatnonzero((lengths > 0) & (triangles[:, :, 2].max(axis=1) > 0))  # nothing behind the wall counts
        splits = self._splits(triangles[kept], coarseness)
        parts = []
        for n in np.unique(splits):
            owners = kept[splits == n]
            weights = _split_weights(int(n))  # (n^2, 3 corners, 3 barycentric)
            corners = np.einsum("pkb,tbx->tpkx", weights, triangles[owners]).reshape(-1, 3, 3)
            repeated = np.repeat(owners, n * n)
            centre = np.tile(weights.mean(axis=1), (len(owners), 1))
            parts.append(
                Patches(
                    corners,
                    np.repeat(lengths[owners] / (2 * n * n), n * n),
                    corners.mean(axis=1),
                    np.repeat(normals[owners] / lengths[owners, None], n * n, axis=0),
                    np.full(len(repeated), index, np.uint32),
                    repeated.astype(np.uint32),
                    centre[:, 1:],
                    np.zeros(len(repeated)),
                )
            )
        return Patches.joined(parts) if parts else _no_patches()

    def _sphere_splits(self, sphere: Float64, coarseness: float) -> int:
        radius = sphere[3]
        nearest = max(float(self._distance_to_wall(sphere[None, :3])[0]) - abs(radius), abs(radius) / 8)
        allowed = min(float(self._allowed(np.array([nearest]), coarseness)[0]), coarseness * abs(radius))
        return int(np.ceil(1.052 * abs(radius) / allowed))  # 1.052: edge of the icosahedron in its unit sphere

    def _sphere(self, index: int, sphere: Float64, coarseness: float) -> Patches:
        n = self._sphere_splits(sphere, coarseness)
        flat = np.einsum("pkb,tbx->tpkx", _split_weights(n), _icosahedron()).reshape(-1, 3, 3)
        unit = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
        a, b, c = unit[:, 0], unit[:, 1], unit[:, 2]
        # solid angle of a spherical triangle (Van Oosterom & Strackee 1983)
        triple = np.einsum("ij,ij->i", a, np.cross(b, c))
        denominator = 1 + np.einsum("ij,ij->i", a, b) + np.einsum("ij,ij->i", b, c) + np.einsum("ij,ij->i", c, a)
        solid_angle = 2 * np.arctan2(triple, denominator)
        direction = unit.mean(axis=1)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        centre, radius = sphere[:3], abs(sphere[3])
        count = len(unit)
        return Patches(
            centre + radius * unit,
            radius**2 * solid_angle,
            centre + radius * direction,
            np.sign(sphere[3]) * direction,
            np.full(count, index, np.uint32),
            np.zeros(count, np.uint32),
            np.zeros((count, 2)),
            # seen from within, a plane through points of the sphere lies in front of it already
            np.maximum(np.sign(sphere[3]), 0) * radius * (1 - np.linalg.norm(unit.mean(axis=1), axis=1)),
        )


def can_tessellate(built: BuiltScene) -> bool:
    """Return whether every hidden shape is a mesh or a sphere, in front of a planar wall."""
    return built.wall.is_planar and all(
        shape.is_mesh() or shape.class_name() == "Sphere" for shape in built.hidden_shapes
    )


def _no_patches() -> Patches:
    none = np.zeros((0, 3))
    index = np.zeros(0, np.uint32)
    return Patches(np.zeros((0, 3, 3)), np.zeros(0), none, none, index, index, np.zeros((0, 2)), np.zeros(0))


def _sphere_of(shape: mi.Shape) -> Float64:
    """Return centre and signed radius (4,) of a sphere: negative when it is seen from within."""
    box = shape.bbox()
    low, high = np.ravel(np.asarray(box.min, dtype=np.float64)), np.ravel(np.asarray(box.max, dtype=np.float64))
    sign = -1.0 if shape.has_flipped_normals() else 1.0
    return np.append((low + high) / 2, sign * (high - low).max() / 2)


def _split_weights(n: int) -> Float64:
    """Return the n^2 similar parts of a triangle, (n^2, 3 corners, 3 barycentric coordinates)."""
    parts = []
    for i in range(n):
        for j in range(n - i):
            parts.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                parts.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    second_third = np.array(parts, dtype=np.float64) / n
    return np.concatenate([1 - second_third.sum(axis=-1, keepdims=True), second_third], axis=-1)


def _icosahedron() -> Float64:
    """Return the 20 faces (20, 3, 3) of the icosahedron in the unit sphere, counter-clockwise from outside."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array([(s, t * golden, 0) for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([vertices, np.roll(vertices, 1, axis=1), np.roll(vertices, 2, axis=1)])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    edge = 2 / np.sqrt(1 + golden**2)
    near = np.abs(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) - edge) < 1e-9
    faces = []
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                if near[i, j] and near[j, k] and near[i, k]:
                    a, b, c = vertices[i], vertices[j], vertices[k]
                    faces.append((a, b, c) if np.dot(a, np.cross(b, c)) > 0 else (a, c, b))
    return np.array(faces)
