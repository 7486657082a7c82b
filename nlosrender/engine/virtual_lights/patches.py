"""Hidden surfaces -> patches small enough to be gathered as one light each.

A patch of size h at distance d from the nearest laser or sensor point has an error of order (h/d)^2 in its geometry
and of h^2/(4 d w) bins in its delay, with w the bin width: within a triangle the delay is taken as linear. One number,
``coarseness``, scales the size allowed by both, so that the error falls with its square.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.surface_sampler import facing_triangles
from nlosrender.scene.build import WALL_ID, BuiltScene
from nlosrender.scene.pose import Float64

MAX_PATCHES = 4_000_000  # of one gather; beyond it the path engine is the better choice
NEAREST = 1e-3  # engine units: surfaces nearer to a laser or sensor point are not cut any finer


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


@dataclass(frozen=True, eq=False)
class Cells:
    """Triangles, or quarters of quarters of them, no longer than their distance from any laser or sensor point."""

    corners: Float64  # (n, 3, 3) [engine units]
    weights: Float64  # (n, 3, 3) barycentric coordinates of the corners in the mesh's triangle
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of the mesh
    sizes: Float64  # (n,) longest edge
    distances: Float64  # (n,) of the centre from the nearest laser or sensor point, at least NEAREST

    def at(self, chosen: NDArray[np.bool_]) -> Cells:
        """Return the cells that are ``chosen``."""
        return Cells(*(values[chosen] for values in self._arrays()))

    @classmethod
    def joined(cls, parts: list[Cells]) -> Cells:
        """Return the cells of all parts."""
        if not parts:
            none, index = np.zeros((0, 3, 3)), np.zeros(0, np.uint32)
            return cls(none, none, index, index, np.zeros(0), np.zeros(0))
        return cls(*(np.concatenate(values) for values in zip(*(part._arrays() for part in parts), strict=True)))

    def _arrays(self) -> tuple[NDArray, ...]:
        return self.corners, self.weights, self.shapes, self.primitives, self.sizes, self.distances


@dataclass(frozen=True)
class _RegularPoints:
    """A regular grid of points on the plane z = 0 [engine units]."""

    first: tuple[float, float]
    step: tuple[float, float]
    count: tuple[int, int]  # columns, rows

    @classmethod
    def of(cls, grid: PointGrid, unit: float) -> _RegularPoints:
        x, y = grid.positions[0, :, 0] / unit, grid.positions[:, 0, 1] / unit
        steps = tuple(float(axis[1] - axis[0]) if len(axis) > 1 else 1.0 for axis in (x, y))
        return cls((float(x[0]), float(y[0])), (steps[0], steps[1]), (len(x), len(y)))

    def squared_distance(self, points: Float64) -> Float64:
        """Return the squared distance (n,) from ``points`` (n, 3) to the nearest point of the grid."""
        squares = points[:, 2] ** 2
        for axis in range(2):
            along = (points[:, axis] - self.first[axis]) / self.step[axis]
            nearest = np.clip(np.rint(along), 0, self.count[axis] - 1)
            squares = squares + ((along - nearest) * self.step[axis]) ** 2
        return squares


class Tessellator:
    """Cuts the hidden geometry of one scene into patches, as fine as asked.

    Triangles are first quartered until none is longer than its distance from the nearest laser or sensor point
    (the *cells*), then cut into equal parts.

    Parameters
    ----------
    built
        The scene: meshes and spheres; ``can_tessellate`` tells beforehand.
    capture
        Where the laser and sensor points are.
    bin_width
        Bin width [engine units].
    """

    def __init__(self, built: BuiltScene, capture: Capture, bin_width: float):
        self.built, self.bin_width = built, bin_width
        grids = {id(grid): grid for grid in (capture.sensor_grid, capture.laser_grid)}
        self._points = [_RegularPoints.of(grid, built.unit) for grid in grids.values()]
        self.reach = max(capture.sensor_grid.size) / (2 * built.unit)  # half the sensor grid's extent [engine units]
        cells: list[Cells] = []
        self._spheres: list[tuple[int, Float64]] = []  # centre and signed radius
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID:
                continue
            if shape.is_mesh():
                cells.append(self._cells_of_mesh(index, shape))
            else:
                self._spheres.append((index, _sphere_of(shape)))
        self.cells = Cells.joined(cells)

    def patches(self, coarseness: float) -> Patches:
        """Return patches whose error is of order ``coarseness`` squared."""
        parts = [self._flat(coarseness)]
        parts += [self._sphere(index, sphere, coarseness) for index, sphere in self._spheres]
        return Patches.joined(parts)

    def count(self, coarseness: float) -> int:
        """Return how many patches ``patches`` would make, without making them."""
        flat = int((self._splits(coarseness) ** 2).sum())
        return flat + sum(20 * self._sphere_splits(sphere, coarseness) ** 2 for _, sphere in self._spheres)

    @property
    def nearest(self) -> float:
        """Distance of the nearest cell's centre, or sphere, from any laser or sensor point [engine units]."""
        round_ones = [abs(float(self.distance(sphere[None, :3])[0]) - abs(sphere[3])) for _, sphere in self._spheres]
        return min([float(self.cells.distances.min(initial=np.inf)), *round_ones])

    def sphere_cells(self) -> list[tuple[Float64, Patches]]:
        """Return centre and signed radius of every sphere, and its cells, whose corners lie on it."""
        return [(sphere, self._sphere(index, sphere, 1.0)) for index, sphere in self._spheres]

    def distance(self, points: Float64) -> Float64:
        """Return the distance (n,) of ``points`` (n, 3) from the nearest laser or sensor point [engine units]."""
        return np.sqrt(np.min([grid.squared_distance(points) for grid in self._points], axis=0))

    def _allowed(self, distance: Float64, coarseness: float) -> Float64:
        """Return the size a patch may have at ``distance`` from the points [engine units]."""
        return coarseness * np.minimum(distance, 2 * np.sqrt(distance * self.bin_width))

    def _cells_of_mesh(self, index: int, mesh: mi.Mesh) -> Cells:
        corners, primitives = facing_triangles(self.built, mesh)
        weights = np.broadcast_to(np.eye(3), corners.shape)
        done: list[Cells] = []
        while len(corners):
            sizes = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
            distances = np.maximum(self.distance(corners.mean(axis=1)), NEAREST)
            large = sizes > distances
            small = Cells(corners, weights, np.full(len(corners), index, np.uint32), primitives, sizes, distances)
            done.append(small.at(~large))
            corners, weights = _quartered(corners[large]), _quartered(weights[large])
            primitives = np.tile(primitives[large], 4)
        return Cells.joined(done)

    def _splits(self, coarseness: float) -> NDArray[np.int64]:
        cells = self.cells
        return np.maximum(np.ceil(cells.sizes / self._allowed(cells.distances, coarseness)), 1).astype(np.int64)

    def _flat(self, coarseness: float) -> Patches:
        cells = self.cells
        normals = np.cross(cells.corners[:, 1] - cells.corners[:, 0], cells.corners[:, 2] - cells.corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        splits = self._splits(coarseness)
        parts = []
        for n in np.unique(splits):
            owners = np.flatnonzero(splits == n)
            weights = _split_weights(int(n))  # (n^2, 3 corners, 3 barycentric)
            corners = np.einsum("pkb,tbx->tpkx", weights, cells.corners[owners]).reshape(-1, 3, 3)
            centres = np.einsum("pb,tbx->tpx", weights.mean(axis=1), cells.weights[owners]).reshape(-1, 3)
            repeated = np.repeat(owners, n * n)
            parts.append(
                Patches(
                    corners,
                    lengths[repeated] / (2 * n * n),
                    corners.mean(axis=1),
                    normals[repeated] / lengths[repeated, None],
                    cells.shapes[repeated],
                    cells.primitives[repeated],
                    centres[:, 1:],
                    np.zeros(len(repeated)),
                )
            )
        return Patches.joined(parts) if parts else _no_patches()

    def _sphere_splits(self, sphere: Float64, coarseness: float) -> int:
        radius = sphere[3]
        nearest = max(float(self.distance(sphere[None, :3])[0]) - abs(radius), abs(radius) / 8)
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


def _quartered(triangles: Float64) -> Float64:
    """Return the four similar parts (4 n, 3, 3) of every triangle."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


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
