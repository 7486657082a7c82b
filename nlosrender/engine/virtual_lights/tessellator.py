"""Hidden surfaces -> patches, as fine as asked.

A patch of size h at distance d from the nearest laser or sensor point has an error of order (h/d)^2 in its geometry
and of h^2/(4 d w) bins in its delay, with w the bin width: within a triangle the delay is taken as linear. One number,
``coarseness``, scales the size allowed by both, so that the error falls with its square.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture
from nlosrender.engine.virtual_lights.cells import Cells, WallDistance, cells_of_mesh, normals_and_areas
from nlosrender.engine.virtual_lights.clusters import cluster
from nlosrender.engine.virtual_lights.patches import Patches, split_cells
from nlosrender.engine.virtual_lights.round_shapes import ROUND_PLUGINS, RoundShape
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
        The scene: meshes, spheres and cylinders; ``can_tessellate`` tells beforehand.
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
        self.round_shapes: list[RoundShape] = []
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID:
                continue
            if shape.is_mesh():
                cells.append(cells_of_mesh(built, index, shape, self.distance))
            else:
                self.round_shapes.append(RoundShape.of(index, shape))
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
        parts += [shape.patches(self._allowed_on(shape, coarseness)) for shape in self.round_shapes]
        return Patches.joined(parts)

    def count(self, coarseness: float) -> int:
        """Return about how many patches ``patches`` would make, without making them; exactly where none merge."""
        far_smaller = self._far_smaller(coarseness)
        flat = int((self._splits(coarseness)[~far_smaller] ** 2).sum())
        # an equilateral triangle of the size allowed has 0.43 of its square as area
        areas = self._areas[far_smaller] / (0.43 * (coarseness * self._allowed[far_smaller]) ** 2)
        on_round = sum(shape.count(self._allowed_on(shape, coarseness)) for shape in self.round_shapes)
        return flat + math.ceil(areas.sum()) + on_round

    @property
    def nearest(self) -> float:
        """Distance of the nearest cell's centre, or round shape, from any laser or sensor point [engine units]."""
        on_round = [shape.nearest(self.distance) for shape in self.round_shapes]
        return min([float(self.cells.distances.min(initial=np.inf)), *on_round])

    def round_cells(self) -> list[tuple[RoundShape, Patches]]:
        """Return every round shape, and its cells, whose corners lie on it."""
        return [(shape, shape.patches(self._allowed_on(shape, 1.0))) for shape in self.round_shapes]

    def _allowed_at(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at coarseness 1 [engine units]."""
        return np.minimum(distance, 2 * np.sqrt(distance * self.bin_width))

    def _splits(self, coarseness: float) -> NDArray[np.int64]:
        return np.maximum(np.ceil(self.cells.sizes / (coarseness * self._allowed)), 1).astype(np.int64)

    def _far_smaller(self, coarseness: float) -> NDArray[np.bool_]:
        """Return which cells are so small that several make one patch."""
        return self.cells.sizes < MERGED * coarseness * self._allowed

    def _allowed_on(self, shape: RoundShape, coarseness: float) -> float:
        nearest = max(shape.nearest(self.distance), abs(shape.radius) / 8)
        return coarseness * min(float(self._allowed_at(np.array([nearest]))[0]), abs(shape.radius))


def can_tessellate(built: BuiltScene) -> bool:
    """Return whether every hidden shape is a mesh, a sphere or a cylinder, in front of a planar wall."""
    return built.wall.is_planar and all(
        shape.is_mesh() or shape.class_name() in ROUND_PLUGINS for shape in built.hidden_shapes
    )
