"""Hidden surfaces -> patches, as fine as asked.

A patch of size h at distance d from the nearest laser or sensor point has an error of order (h/d)^2 in its geometry
and of h^2/(4 d w) bins in its delay, with w the bin width: within a triangle the delay is taken as linear. One number,
``coarseness``, scales the size allowed by both, so that the error falls with its square.
"""

from __future__ import annotations

import math
from functools import lru_cache

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture
from nlosrender.engine.virtual_lights.cells import Cells, WallDistance, cells_of_mesh, normals_and_areas
from nlosrender.engine.virtual_lights.clusters import cluster
from nlosrender.engine.virtual_lights.patches import Patches, sphere_patches, split_cells
from nlosrender.scene.build import WALL_ID, BuiltScene
from nlosrender.scene.pose import Float64

MAX_PATCHES = 2_000_000  # of one gather; beyond it the path engine is the better choice
MOST_KEPT = 200_000  # patches of one resolution that are kept for the next call
MERGED = 0.4  # of the size allowed: smaller cells are merged


class Tessellator:
    """Cuts the hidden geometry of one scene into patches, as fine as asked.

    Triangles are first quartered until none is longer than its distance from the nearest laser or sensor point
    (the *cells*), then cut into equal parts, or merged where they are far smaller than need be.

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
        self.distance = WallDistance(capture, built.unit)
        self.reach = max(capture.sensor_grid.size) / (2 * built.unit)  # half the sensor grid's extent [engine units]
        cells: list[Cells] = []
        self._spheres: list[tuple[int, Float64]] = []  # centre and signed radius
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID:
                continue
            if shape.is_mesh():
                cells.append(cells_of_mesh(built, index, shape, self.distance))
            else:
                self._spheres.append((index, _sphere_of(shape)))
        self.cells = Cells.joined(cells)
        self._allowed = self._allowed_at(self.cells.distances)
        self._normals, self._areas = normals_and_areas(self.cells.corners)
        self._kept_patches = lru_cache(maxsize=4)(self._make_patches)

    def patches(self, coarseness: float) -> Patches:
        """Return patches whose error is of order ``coarseness`` squared; those of the last calls are kept if few."""
        if self.count(coarseness) > MOST_KEPT:
            return self._make_patches(coarseness)
        return self._kept_patches(coarseness)

    def _make_patches(self, coarseness: float) -> Patches:
        far_smaller = self._far_smaller(coarseness)
        parts = [split_cells(self.cells.at(~far_smaller), self._splits(coarseness)[~far_smaller])]
        if far_smaller.any():
            small, normals, areas = self.cells.at(far_smaller), self._normals[far_smaller], self._areas[far_smaller]
            parts.append(cluster(small, normals, areas, self._allowed[far_smaller], coarseness))
        parts += [
            sphere_patches(index, sphere, self._sphere_splits(sphere, coarseness)) for index, sphere in self._spheres
        ]
        return Patches.joined(parts)

    def count(self, coarseness: float) -> int:
        """Return about how many patches ``patches`` would make, without making them; exactly where none merge."""
        far_smaller = self._far_smaller(coarseness)
        flat = int((self._splits(coarseness)[~far_smaller] ** 2).sum())
        # an equilateral triangle of the size allowed has 0.43 of its square as area
        areas = self._areas[far_smaller] / (0.43 * (coarseness * self._allowed[far_smaller]) ** 2)
        spheres = sum(20 * self._sphere_splits(sphere, coarseness) ** 2 for _, sphere in self._spheres)
        return flat + math.ceil(areas.sum()) + spheres

    @property
    def nearest(self) -> float:
        """Distance of the nearest cell's centre, or sphere, from any laser or sensor point [engine units]."""
        round_ones = [abs(float(self.distance(sphere[None, :3])[0]) - abs(sphere[3])) for _, sphere in self._spheres]
        return min([float(self.cells.distances.min(initial=np.inf)), *round_ones])

    def sphere_cells(self) -> list[tuple[Float64, Patches]]:
        """Return centre and signed radius of every sphere, and its cells, whose corners lie on it."""
        return [
            (sphere, sphere_patches(index, sphere, self._sphere_splits(sphere, 1.0))) for index, sphere in self._spheres
        ]

    def _allowed_at(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at coarseness 1 [engine units]."""
        return np.minimum(distance, 2 * np.sqrt(distance * self.bin_width))

    def _splits(self, coarseness: float) -> NDArray[np.int64]:
        return np.maximum(np.ceil(self.cells.sizes / (coarseness * self._allowed)), 1).astype(np.int64)

    def _far_smaller(self, coarseness: float) -> NDArray[np.bool_]:
        """Return which cells are so small that several make one patch."""
        return self.cells.sizes < MERGED * coarseness * self._allowed

    def _sphere_splits(self, sphere: Float64, coarseness: float) -> int:
        radius = sphere[3]
        nearest = max(float(self.distance(sphere[None, :3])[0]) - abs(radius), abs(radius) / 8)
        allowed = min(coarseness * float(self._allowed_at(np.array([nearest]))[0]), coarseness * abs(radius))
        return int(np.ceil(1.052 * abs(radius) / allowed))  # 1.052: edge of the icosahedron in its unit sphere


def can_tessellate(built: BuiltScene) -> bool:
    """Return whether every hidden shape is a mesh or a sphere, in front of a planar wall."""
    return built.wall.is_planar and all(
        shape.is_mesh() or shape.class_name() == "Sphere" for shape in built.hidden_shapes
    )


def _sphere_of(shape: mi.Shape) -> Float64:
    """Return centre and signed radius (4,) of a sphere: negative when it is seen from within."""
    box = shape.bbox()
    low, high = np.ravel(np.asarray(box.min, dtype=np.float64)), np.ravel(np.asarray(box.max, dtype=np.float64))
    sign = -1.0 if shape.has_flipped_normals() else 1.0
    return np.append((low + high) / 2, sign * (high - low).max() / 2)
