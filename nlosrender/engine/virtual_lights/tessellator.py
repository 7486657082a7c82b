"""Hidden surfaces, and a wall that sees itself -> patches, as fine as asked.

A patch of size h at distance d from the nearest laser or sensor point has an error of order (h/d)^2 in its geometry
and of h^2/(4 d w) bins in its delay, with w the bin width: within a triangle the delay is taken as linear. One number,
``coarseness``, scales the size allowed by both, so that the error falls with its square.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture
from nlosrender.engine.virtual_lights.cells import Cells, WallDistance, cells_of_mesh, normals_and_areas
from nlosrender.engine.virtual_lights.clusters import Merger
from nlosrender.engine.virtual_lights.patches import Patches, no_patches, split_cells
from nlosrender.engine.virtual_lights.round_shapes import ROUND_PLUGINS, RoundShape
from nlosrender.scene.build import WALL_ID, BuiltScene
from nlosrender.scene.pose import Float64

MAX_PATCHES = 2_000_000  # of one gather; beyond it the path engine is the better choice
MOST_KEPT = 200_000  # patches of one resolution that are kept for the next call
# Engine units: of surfaces so near to a point, a dozen cells around its foot make up H. Their numbers of parts have to
# follow the coarseness in small steps, or two resolutions would differ less than either errs.
CLOSE = 1e-2
MERGED = 0.5  # of the size allowed: smaller cells are merged


class Tessellator:
    """Cuts the hidden geometry of one scene, and a wall that sees itself, into patches, as fine as asked.

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
        self.built, self.capture, self.bin_width = built, capture, bin_width
        self.distance = WallDistance(capture, built.unit)
        self.reach = max(capture.sensor_grid.size) / (2 * built.unit)  # half the sensor grid's extent [engine units]
        cells: list[Cells] = []
        self.round_shapes: list[RoundShape] = []
        self.wall_index: int | None = None  # of the wall among the scene's shapes, where it is cut as well
        for index, shape in enumerate(built.scene.shapes()):
            if shape.id() == WALL_ID:
                if not wall_sees_itself(built):
                    continue
                self.wall_index = index
            if shape.is_mesh():
                cells.append(cells_of_mesh(built, index, shape, self.distance))
            else:
                self.round_shapes.append(RoundShape.of(index, shape))
        self.cells = Cells.joined(cells)
        self._allowed = self._allowed_at(self.cells.distances)
        self._ratios = self.cells.sizes / self._allowed  # of the sizes to those allowed at coarseness 1
        self._normals, self._areas = normals_and_areas(self.cells.corners)
        self._kept_patches = lru_cache(maxsize=4)(self._make_patches)

    def patches(self, coarseness: float) -> Patches:
        """Return patches whose error is of order ``coarseness`` squared; those of the last calls are kept if few."""
        if self.count(coarseness) > MOST_KEPT:
            return self._make_patches(coarseness)
        return self._kept_patches(coarseness)

    def _make_patches(self, coarseness: float) -> Patches:
        is_small = self._ratios < MERGED * coarseness
        parts = [self._merger.clusters(is_small, coarseness)] if is_small.any() else []
        if not is_small.all():
            splits = np.ceil(self._ratios[~is_small] / coarseness).astype(np.int64)
            parts.append(split_cells(self.cells.at(~is_small), splits))
        parts += [shape.patches(self._allowed_on(shape, coarseness)) for shape in self.round_shapes]
        return Patches.joined(parts) if parts else no_patches()

    @cached_property
    def _merger(self) -> Merger:
        light = self.capture.laser_grid.positions.reshape(-1, 3).mean(axis=0) / self.built.unit
        return Merger(self.cells, self._normals, self._areas, self._allowed, light)

    def count(self, coarseness: float) -> int:
        """Return about how many patches ``patches`` would make, without making them; exactly where none merge."""
        return sum(self.counts(coarseness))

    def counts(self, coarseness: float) -> tuple[int, int]:
        """Return ``count`` of the hidden surfaces, and of a wall that sees itself."""
        hidden, wall = (count.at(coarseness) for count in self._counts)
        for shape in self.round_shapes:
            more = shape.count(self._allowed_on(shape, coarseness))
            hidden, wall = (hidden, wall + more) if shape.index == self.wall_index else (hidden + more, wall)
        return hidden, wall

    @cached_property
    def _counts(self) -> tuple[_CellCount, _CellCount]:
        hidden = self._hidden()
        boxes = self._merger.boxes
        on_wall = _CellCount(self._ratios[~hidden], boxes[~hidden])
        return _CellCount(self._ratios[hidden], boxes[hidden]), on_wall

    @property
    def nearest(self) -> float:
        """Distance from the points to the nearest hidden cell's centre, or round shape [engine units]."""
        return min([float(self.cells.distances[self._hidden()].min(initial=np.inf)), self.nearest_round])

    @property
    def nearest_round(self) -> float:
        """Distance from the points to the nearest hidden round shape [engine units]; inf where there is none."""
        on_round = (shape.nearest(self.distance) for shape in self.round_shapes if shape.index != self.wall_index)
        return min(on_round, default=math.inf)

    @cached_property
    def nearest_to_laser(self) -> float:
        """Distance from the laser points to the nearest hidden cell's centre, or round shape [engine units]."""
        lasers = WallDistance(replace(self.capture, sensor_grid=self.capture.laser_grid), self.built.unit)
        on_round = [shape.nearest(lasers) for shape in self.round_shapes if shape.index != self.wall_index]
        centres = self.cells.corners[self._hidden()].mean(axis=1)
        return min([float(lasers(centres).min(initial=np.inf)) if len(centres) else math.inf, *on_round])

    def _hidden(self) -> NDArray[np.bool_]:
        """Return which cells are not the wall's."""
        if self.wall_index is None:
            return np.ones(len(self.cells.shapes), bool)
        return self.cells.shapes != self.wall_index

    def round_cells(self) -> list[tuple[RoundShape, Patches]]:
        """Return every round shape, and its cells, whose corners lie on it."""
        return [(shape, shape.patches(self._allowed_on(shape, 1.0))) for shape in self.round_shapes]

    def _allowed_at(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at coarseness 1 [engine units]."""
        graded = np.where(distance < CLOSE, distance / 2, distance)
        return np.minimum(graded, 2 * np.sqrt(distance * self.bin_width))

    def _allowed_on(self, shape: RoundShape, coarseness: float) -> float:
        if shape.index == self.wall_index:
            # cos cos / r^2 varies over the radius only, however near: 1 / (4 radius^2) between points of a sphere
            nearest = abs(shape.radius)
        else:
            nearest = max(shape.nearest(self.distance), abs(shape.radius) / 8)
        return coarseness * min(float(self._allowed_at(np.array([nearest]))[0]), abs(shape.radius))


class _CellCount:
    """Counts the patches that some cells make, quickly: it is asked many times.

    Parameters
    ----------
    ratios
        (n,) sizes of the cells over the sizes allowed.
    boxes
        (n,) ``Merger.boxes``.
    """

    def __init__(self, ratios: Float64, boxes: Float64):
        order = np.argsort(ratios)
        self._ratios = ratios[order]
        self._boxes = np.append(0.0, np.cumsum(boxes[order]))  # of all smaller cells

    def at(self, coarseness: float) -> int:
        """Return the number of patches: one per box, per cell, or per part of a cell."""
        merged, whole = np.searchsorted(self._ratios, [MERGED * coarseness, coarseness])
        parts = np.ceil(self._ratios[whole:] / coarseness).astype(np.int64)
        return math.ceil(self._boxes[merged] / coarseness**2) + int(whole - merged) + int((parts**2).sum())


def can_tessellate(built: BuiltScene) -> bool:
    """Return whether every hidden shape is a mesh, a sphere or a cylinder."""
    return all(shape.is_mesh() or shape.class_name() in ROUND_PLUGINS for shape in built.hidden_shapes)


def wall_sees_itself(built: BuiltScene) -> bool:
    """Return whether light may go from the wall to the wall: not on a plane, nor outside a sphere or cylinder."""
    wall = built.wall_shape
    return not built.wall.is_planar and (wall.is_mesh() or wall.has_flipped_normals())
