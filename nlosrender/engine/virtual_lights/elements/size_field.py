"""Elements with the size that patches on them may have: the patches of a scale, and their number.

docs/virtual-lights.md, 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.engine.virtual_lights.elements.area_moments import covered_boxes
from nlosrender.engine.virtual_lights.elements.clusters import Merger
from nlosrender.engine.virtual_lights.elements.patches import Patches, split_elements
from nlosrender.engine.virtual_lights.elements.triangles import normals_and_areas
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements


@dataclass(frozen=True, eq=False)
class SizeField:
    """What decides the size of patches, besides the distance."""

    bin_width: float  # [engine units]
    wall_index: int | None  # of the wall among the scene's shapes, where it is cut as well
    light: Float64  # (3,) mean of the laser points [engine units]
    is_one_point: bool  # all laser points are there
    tuning: VirtualLightTuning = DEFAULT_TUNING

    def allowed_size(self, distance: Float64) -> Float64:
        """Return the size a patch may have at ``distance`` from the points, at scale 1 [engine units]."""
        graded = np.where(distance < self.tuning.close_distance, distance / 2, distance)
        return np.minimum(graded, 2 * np.sqrt(distance * self.bin_width))


class SizedElements:
    """Subdivided elements, to be cut into equal parts, or merged where they are far smaller than need be."""

    def __init__(self, elements: Elements, size_field: SizeField):
        self.elements, self.size_field = elements, size_field
        self.allowed = size_field.allowed_size(elements.distances)
        self._ratios = elements.sizes / self.allowed  # of the sizes to those allowed at scale 1
        self.normals, self.areas = normals_and_areas(elements.corners)
        wall = size_field.wall_index
        self.is_hidden = np.ones(len(elements), bool) if wall is None else elements.shapes != wall

    def set_up(self) -> None:
        """Sum up the elements if some are merged at scale 1, the coarsest there is."""
        if (self._ratios < self.size_field.tuning.merge_ratio).any():
            self.merger.set_up()

    def patches(self, patch_scale: float) -> Patches:
        """Return patches whose error is of order ``patch_scale`` squared."""
        is_small = self._ratios < self.size_field.tuning.merge_ratio * patch_scale
        splits = np.ceil(self._ratios[~is_small] / patch_scale).astype(np.int64)
        cut = split_elements(self.elements.select(~is_small), splits)
        return Patches.joined([self.merger.clusters(patch_scale), cut]) if is_small.any() else cut

    def counts(self, patch_scale: float) -> tuple[int, int]:
        """Return about how many patches there would be of the hidden surfaces, and of a wall that sees itself.

        Exact where none merge.
        """
        hidden, wall = (count.at(patch_scale) for count in self._counts)
        return hidden, wall

    def share_if_far(self, distance: float) -> float:
        """Return about how many of the patches would be left if no element were nearer than ``distance`` to a point."""
        larger = self.size_field.allowed_size(np.maximum(self.elements.distances, distance))
        return float((self.areas / larger**2).sum() / max((self.areas / self.allowed**2).sum(), 1e-300))

    @cached_property
    def _counts(self) -> tuple[_PatchCount, _PatchCount]:
        tuning = self.size_field.tuning
        boxes = covered_boxes(self.normals, self.areas, self.allowed, tuning)  # without the merger: it may stay unused
        hidden, wall = (
            _PatchCount(self._ratios[of], boxes[of], tuning.merge_ratio) for of in (self.is_hidden, ~self.is_hidden)
        )
        return hidden, wall

    @cached_property
    def merger(self) -> Merger:
        """What makes clusters of the elements."""
        field = self.size_field
        allowed, light, tuning = self.allowed, field.light, field.tuning
        return Merger(self.elements, self.normals, self.areas, allowed, self._ratios, light, field.is_one_point, tuning)


class _PatchCount:
    """Number of patches that elements (n,) make, by binary search over their sizes per size allowed."""

    def __init__(self, ratios: Float64, boxes: Float64, merge_ratio: float):
        order = np.argsort(ratios)
        self._ratios, self._merge_ratio = ratios[order], merge_ratio
        self._boxes = np.append(0.0, np.cumsum(boxes[order]))  # of all smaller elements

    def at(self, patch_scale: float) -> int:
        """Return the number of patches: one per box, per element, or per part of an element."""
        merged, whole = np.searchsorted(self._ratios, [self._merge_ratio * patch_scale, patch_scale])
        parts = np.ceil(self._ratios[whole:] / patch_scale).astype(np.int64)
        return math.ceil(self._boxes[merged] / patch_scale**2) + int(whole - merged) + int((parts**2).sum())
