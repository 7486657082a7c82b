"""Cells with the size that patches on them may have: what a resolution is made from, and how many patches it has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlosrender.engine.virtual_lights.elements.area_moments import covered_boxes
from nlosrender.engine.virtual_lights.elements.clusters import Merger
from nlosrender.engine.virtual_lights.elements.patches import Patches, split_cells
from nlosrender.engine.virtual_lights.elements.subdivision import Cells, normals_and_areas
from nlosrender.scene.pose import Float64

# Engine units: of surfaces so near to a point, a dozen cells around its foot make up H. Their numbers of parts have to
# follow the coarseness in small steps, or two resolutions would differ less than either errs.
CLOSE = 1e-2
MERGED = 0.5  # of the size allowed: smaller cells are merged


@dataclass(frozen=True, eq=False)
class Grading:
    """What decides the size of patches, besides the distance."""

    bin_width: float  # [engine units]
    wall_index: int | None  # of the wall among the scene's shapes, where it is cut as well
    light: Float64  # (3,) middle of the laser points [engine units]

    def allowed_size(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at coarseness 1 [engine units]."""
        graded = np.where(distance < CLOSE, distance / 2, distance)
        return np.minimum(graded, 2 * np.sqrt(distance * self.bin_width))


class GradedCells:
    """Cells that are cut into equal parts, or merged where they are far smaller than need be.

    Parameters
    ----------
    cells
        Cells no longer than their distance from the points that the patches are for.
    grading
        Decides the size of the patches.
    """

    def __init__(self, cells: Cells, grading: Grading):
        self.cells, self.grading = cells, grading
        self.allowed = grading.allowed_size(cells.distances)
        self._ratios = cells.sizes / self.allowed  # of the sizes to those allowed at coarseness 1
        self.normals, self.areas = normals_and_areas(cells.corners)
        wall = grading.wall_index
        self.is_hidden = np.ones(len(cells.shapes), bool) if wall is None else cells.shapes != wall

    def set_up(self) -> None:
        """Sum up the cells if some are merged at coarseness 1, the coarsest resolution there is."""
        if (self._ratios < MERGED).any():
            self.merger.set_up()

    def patches(self, coarseness: float) -> list[Patches]:
        """Return patches whose error is of order ``coarseness`` squared, in parts."""
        is_small = self._ratios < MERGED * coarseness
        parts = [self.merger.clusters(is_small, coarseness)] if is_small.any() else []
        if not is_small.all():
            splits = np.ceil(self._ratios[~is_small] / coarseness).astype(np.int64)
            parts.append(split_cells(self.cells.at(~is_small), splits))
        return parts

    def counts(self, coarseness: float) -> tuple[int, int]:
        """Return about how many patches there would be of the hidden surfaces, and of a wall that sees itself.

        Exactly where none merge.
        """
        hidden, wall = (count.at(coarseness) for count in self._counts)
        return hidden, wall

    def share_if_far(self, distance: float) -> float:
        """Return how many of the patches were left, about, if no cell were nearer than ``distance`` to a point."""
        larger = self.grading.allowed_size(np.maximum(self.cells.distances, distance))
        return float((self.areas / larger**2).sum() / max((self.areas / self.allowed**2).sum(), 1e-300))

    @cached_property
    def _counts(self) -> tuple[_CellCount, _CellCount]:
        boxes = covered_boxes(self.normals, self.areas, self.allowed)  # the merger's, which may never be needed
        hidden, wall = (_CellCount(self._ratios[of], boxes[of]) for of in (self.is_hidden, ~self.is_hidden))
        return hidden, wall

    @cached_property
    def merger(self) -> Merger:
        """What makes clusters of the cells."""
        return Merger(self.cells, self.normals, self.areas, self.allowed, self.grading.light)


class _CellCount:
    """Counts the patches that some cells make, quickly: it is asked many times.

    Parameters
    ----------
    ratios
        (n,) sizes of the cells over the sizes allowed.
    boxes
        (n,) ``covered_boxes``.
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
