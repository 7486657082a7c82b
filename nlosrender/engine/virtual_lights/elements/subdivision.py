"""Elements: triangles, quartered until none is longer than its distance from the nearest laser or sensor point.

docs/virtual-lights.md, 3. Patches and VPLs are made of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.launch.facing_triangles import facing_triangles
from nlosrender.engine.launch.flat_mirrors import FlatMirrors
from nlosrender.engine.virtual_lights.elements.struct_of_arrays import StructOfArrays
from nlosrender.engine.virtual_lights.elements.surface_distance import SurfaceDistance
from nlosrender.engine.virtual_lights.elements.triangles import (
    centroids,
    longest_edges,
    normals_and_areas,
    unit_vectors,
)
from nlosrender.scene.build import BuiltScene, wall_box
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID
from nlosrender.scene.pose import Float64

# Engine units, and what follows from float32.
MIN_IN_PLANE_DISTANCE = 1e-3  # where the nearest point lies in the element's plane: they exchange no light
MIN_DISTANCE = 1e-8  # elsewhere: float32 points on a wall of size 1 are 6e-8 apart
HEIGHT_ROUNDING = 1e-7  # of a float32 point over a tilted plane
GRID_TOLERANCE = 1e-9  # float64 points this close to those of a regular grid are that grid
N_NEIGHBOURS = 8  # of a point of a mesh wall: more than share one of its triangles are searched for in vain
WALL_PARTS = 8  # elements of a planar wall along each side, seen in a mirror only: chosen, not measured
MIN_COSINE = 1e-5  # below it an element of the wall lies in the plane of a wall point: no light goes between them


@dataclass(frozen=True, eq=False)
class Elements(StructOfArrays):
    """Triangles, or quarters of quarters of them [engine units]."""

    corners: Float64  # (n, 3, 3)
    weights: Float64  # (n, 3, 3) barycentric coordinates of the corners in the mesh's triangle
    shading: Float64  # (n, 3, 3) shading normals at the corners, as the mesh interpolates them
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of the mesh
    sizes: Float64  # (n,) longest edge
    distances: Float64  # (n,) of the centroid from the nearest laser or sensor point, at least MIN_DISTANCE

    @classmethod
    def none(cls) -> Elements:
        """Return no elements."""
        none, index, numbers = np.zeros((0, 3, 3)), np.zeros(0, np.uint32), np.zeros(0)
        return cls(none, none, none, index, index, numbers, numbers)

    @property
    def shading_normals(self) -> Float64:
        """Unit shading normals (n, 3) at the centroids."""
        return unit_vectors(centroids(self.shading))


@dataclass(frozen=True)
class RegularPoints:
    """A regular grid of points on the plane z = 0 [engine units]."""

    first: tuple[float, float]
    step: tuple[float, float]
    count: tuple[int, int]  # columns, rows

    @classmethod
    def of(cls, grid: PointGrid, unit: float) -> RegularPoints:
        x, y = grid.positions[0, :, 0] / unit, grid.positions[:, 0, 1] / unit
        # 1: of one row or column, and of lists that are no lattice, any step does
        steps = tuple((float(axis[1] - axis[0]) if len(axis) > 1 else 0.0) or 1.0 for axis in (x, y))
        return cls((float(x[0]), float(y[0])), (steps[0], steps[1]), (len(x), len(y)))

    def squared_distance(self, points: Float64) -> Float64:
        """Return the squared distance (n,) from ``points`` (n, 3) to the nearest point of the grid."""
        squares = points[:, 2] ** 2
        for axis in range(2):
            along = (points[:, axis] - self.first[axis]) / self.step[axis]
            nearest = np.clip(np.rint(along), 0, self.count[axis] - 1)
            squares = squares + ((along - nearest) * self.step[axis]) ** 2
        return squares


class WallDistance:
    """Distance from the nearest laser or sensor point of a capture; ``unit``: metres per engine unit."""

    def __init__(self, capture: Capture, unit: float):
        grids = {id(grid): grid for grid in (capture.sensor_grid, capture.laser_grid)}.values()
        points = np.concatenate([grid.positions.reshape(-1, 3) / unit for grid in grids])
        self._points = points.astype(np.float32).astype(np.float64)  # as the device knows them: it matters close by
        self._normals = np.concatenate([grid.normals.reshape(-1, 3) for grid in grids])
        self._regular: list[RegularPoints] = []
        self._trees: list[cKDTree] = []
        for grid in grids:
            regular = RegularPoints.of(grid.lattice, unit)
            positions = grid.positions.reshape(-1, 3) / unit
            if regular.squared_distance(positions).max() < GRID_TOLERANCE**2:
                self._regular.append(regular)
            else:
                self._trees.append(cKDTree(positions))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._points)

    def __call__(self, points: Float64) -> Float64:
        """Return the distance (n,) of ``points`` (n, 3) [engine units]."""
        squares = [grid.squared_distance(points) for grid in self._regular]
        squares += [np.square(tree.query(points)[0]) for tree in self._trees]
        return np.sqrt(np.min(squares, axis=0))

    def of_planes(self, points: Float64, normals: Float64) -> Float64:
        """Return the distance (n,) of planes close to the wall, given by points and normals (n, 3).

        At least ``MIN_IN_PLANE_DISTANCE`` where the nearest laser or sensor point is in the plane as far as float32
        knows. Heights over a plane that is parallel to a planar wall are exact in float32.
        """
        distances, nearest = self._tree.query(points)
        heights = np.abs(np.einsum("nx,nx->n", points - self._points[nearest], normals))
        tilts = np.linalg.norm(np.cross(normals, self._normals[nearest]), axis=1)
        is_off_plane = heights > MIN_DISTANCE + HEIGHT_ROUNDING * tilts
        return np.maximum(distances, np.where(is_off_plane, MIN_DISTANCE, MIN_IN_PLANE_DISTANCE))

    def out_of_plane(self, points: Float64) -> Float64:
        """Return the distance (n,) of points of the wall (n, 3) from the nearest one whose plane they are not in.

        If all ``N_NEIGHBOURS`` nearest ones are in their planes, the distance of the last: no other one is nearer.
        """
        count = min(N_NEIGHBOURS, len(self._points))
        distances, index = self._tree.query(points, k=np.arange(1, count + 1))
        heights = np.einsum("nkx,nkx->nk", points[:, None] - self._points[index], self._normals[index])
        apart = np.abs(heights) > MIN_COSINE * distances
        apart[:, -1] = True
        return distances[np.arange(len(points)), apart.argmax(axis=1)]


def elements_of_mesh(built: BuiltScene, index: int, mesh: mi.Mesh, mirror: FlatMirrors | None = None) -> Elements:
    """Return the triangles of shape ``index`` that the wall or its image may see lit, distances still to be found."""
    corners, primitives = facing_triangles(built, mesh, None if mirror is None else mirror.images)
    count = len(corners)
    return Elements(
        corners=corners,
        weights=np.broadcast_to(np.eye(3), corners.shape),
        shading=_shading_normals(mesh, corners, primitives),
        shapes=np.full(count, index, np.uint32),
        primitives=primitives,
        sizes=longest_edges(corners),
        distances=np.zeros(count),
    )


def wall_elements(built: BuiltScene) -> Elements:
    """Return elements of a rectangular wall, of which ``shading`` and ``distances`` are not known."""
    numbers = np.linspace(-1, 1, WALL_PARTS + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(numbers[:-1], numbers[:-1]))
    step, none = 2 / WALL_PARTS, np.zeros_like(x)
    low, right, up, far = (
        np.stack([none, x + i * step, y + j * step], axis=1) for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
    )
    weights = np.concatenate([np.stack(corners, axis=1) for corners in ((low, right, far), (low, far, up))])
    half = np.abs(wall_box(built.wall)[:, :2]).max(axis=0) / built.metres_per_engine_unit
    corners = np.concatenate([weights[..., 1:] * half, 0 * weights[..., :1]], axis=2)
    index = next(index for index, shape in enumerate(built.scene.shapes()) if shape.id() == WALL_ID)
    count = len(weights)
    shapes, primitives = np.full(count, index, np.uint32), np.zeros(count, np.uint32)
    return Elements(corners, weights, 0 * corners, shapes, primitives, longest_edges(corners), np.zeros(count))


def partition_by_size(
    elements: Elements, distance: WallDistance | SurfaceDistance, wall_index: int | None, min_size: float = 0.0
) -> tuple[Elements, Elements]:
    """Return the elements that ``subdivide`` leaves as they are, with their distances, and those that it quarters."""
    distances = _distances(elements, distance, wall_index)
    large = elements.sizes > np.maximum(distances, min_size)
    return replace(elements, distances=distances).select(~large), elements.select(large)


def subdivide(
    elements: Elements, distance: WallDistance | SurfaceDistance, wall_index: int | None, min_size: float = 0.0
) -> Elements:
    """Quarter elements until none is longer than its distance from the nearest point, found anew, or than ``min_size``.

    On the wall, shape ``wall_index`` of the scene, only points in the planes of other triangles count.
    """
    done: list[Elements] = []
    while True:
        small, large = partition_by_size(elements, distance, wall_index, min_size)
        done.append(small)
        if not len(large):
            break
        corners = _similar_quarters(large.corners)
        elements = Elements(
            corners=corners,
            weights=_similar_quarters(large.weights),
            shading=_similar_quarters(large.shading),
            shapes=np.tile(large.shapes, 4),
            primitives=np.tile(large.primitives, 4),
            sizes=longest_edges(corners),
            distances=np.zeros(len(corners)),
        )
    return Elements.joined(done)


def _shading_normals(mesh: mi.Mesh, corners: Float64, primitives: NDArray[np.uint32]) -> Float64:
    """Return the shading normals (n, 3, 3) at the corners of a mesh's triangles."""
    if not mesh.has_vertex_normals():
        return np.repeat(normals_and_areas(corners)[0][:, None], 3, axis=1)
    parameters = mi.traverse(mesh)
    at_vertices = np.asarray(parameters["vertex_normals"], dtype=np.float64).reshape(-1, 3)
    return at_vertices[np.asarray(parameters["faces"]).reshape(-1, 3)[primitives]]


def _distances(elements: Elements, distance: WallDistance | SurfaceDistance, wall_index: int | None) -> Float64:
    if isinstance(distance, SurfaceDistance):
        return distance.of_elements(elements)
    centres = centroids(elements.corners)
    distances = np.empty(len(centres))
    on_wall = elements.shapes == (-1 if wall_index is None else wall_index)
    distances[on_wall] = np.maximum(distance.out_of_plane(centres[on_wall]), MIN_IN_PLANE_DISTANCE)
    hidden = np.flatnonzero(~on_wall)
    distances[hidden] = distance(centres[hidden])
    close = hidden[distances[hidden] < MIN_IN_PLANE_DISTANCE]
    distances[close] = distance.of_planes(centres[close], normals_and_areas(elements.corners[close])[0])
    return distances


def _similar_quarters(triangles: Float64) -> Float64:
    """Return the four similar parts (4 n, 3, 3) of every triangle."""
    a, b, c = (triangles[:, k] for k in range(3))
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])
