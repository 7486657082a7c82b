"""Cells with the size that patches on them may have: what a resolution is made from, and how many patches it has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlosrender.engine.virtual_lights.elements.area_moments import covered_boxes
from nlosrender.engine.virtual_lights.elements.clusters import Merger
from nlosrender.engine.virtual_lights.elements.patches import Patches, split_cells
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, normals_and_areas
from nlosrender.scene.pose import Float64

# Engine units: of surfaces so near to a point, a dozen cells around its foot make up H. Their numbers of parts have to
# follow the coarseness in small steps, or two resolutions would differ less than either errs.
CLOSE = 1e-2
MERGED = 0.5  # of the size allowed: smaller cells are merged


@dataclass(frozen=True, eq=False)
class SizeField:
    """What decides the size of patches, besides the distance."""

    bin_width: float  # [engine units]
    wall_index: int | None  # of the wall among the scene's shapes, where it is cut as well
    light: Float64  # (3,) middle of the laser points [engine units]

    def allowed_size(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at coarseness 1 [engine units]."""
        graded = np.where(distance < CLOSE, distance / 2, distance)
        return np.minimum(graded, 2 * np.sqrt(distance * self.bin_width))


class SizedElements:
    """Cells that are cut into equal parts, or merged where they are far smaller than need be.

    Parameters
    ----------
    elements
        Cells no longer than their distance from the points that the patches are for.
    size_field
        Decides the size of the patches.
    """

    def __init__(self, elements: Elements, size_field: SizeField):
        self.elements, self.size_field = elements, size_field
        self.allowed = size_field.allowed_size(elements.distances)
        self._ratios = elements.sizes / self.allowed  # of the sizes to those allowed at coarseness 1
        self.normals, self.areas = normals_and_areas(elements.corners)
        wall = size_field.wall_index
        self.is_hidden = np.ones(len(elements.shapes), bool) if wall is None else elements.shapes != wall

    def set_up(self) -> None:
        """Sum up the cells if some are merged at coarseness 1, the coarsest resolution there is."""
        if (self._ratios < MERGED).any():
            self.merger.set_up()

    def patches(self, patch_scale: float) -> list[Patches]:
        """Return patches whose error is of order ``patch_scale`` squared, in parts."""
        is_small = self._ratios < MERGED * patch_scale
        parts = [self.merger.clusters(is_small, patch_scale)] if is_small.any() else []
        if not is_small.all():
            splits = np.ceil(self._ratios[~is_small] / patch_scale).astype(np.int64)
            parts.append(split_cells(self.elements.at(~is_small), splits))
        return parts

    def counts(self, patch_scale: float) -> tuple[int, int]:
        """Return about how many patches there would be of the hidden surfaces, and of a wall that sees itself.

        Exactly where none merge.
        """
        hidden, wall = (count.at(patch_scale) for count in self._counts)
        return hidden, wall

    def share_if_far(self, distance: float) -> float:
        """Return how many of the patches were left, about, if no cell were nearer than ``distance`` to a point."""
        larger = self.size_field.allowed_size(np.maximum(self.elements.distances, distance))
        return float((self.areas / larger**2).sum() / max((self.areas / self.allowed**2).sum(), 1e-300))

    @cached_property
    def _counts(self) -> tuple[_CellCount, _CellCount]:
        boxes = covered_boxes(self.normals, self.areas, self.allowed)  # the merger's, which may never be needed
        hidden, wall = (_CellCount(self._ratios[of], boxes[of]) for of in (self.is_hidden, ~self.is_hidden))
        return hidden, wall

    @cached_property
    def merger(self) -> Merger:
        """What makes clusters of the cells."""
        return Merger(self.elements, self.normals, self.areas, self.allowed, self.size_field.light)


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

    def at(self, patch_scale: float) -> int:
        """Return the number of patches: one per box, per cell, or per part of a cell."""
        merged, whole = np.searchsorted(self._ratios, [MERGED * patch_scale, patch_scale])
        parts = np.ceil(self._ratios[whole:] / patch_scale).astype(np.int64)
        return math.ceil(self._boxes[merged] / patch_scale**2) + int(whole - merged) + int((parts**2).sum())
