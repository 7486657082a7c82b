"""Axis-aligned boxes around geometry."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from nlosrender.scene.pose import Float64

Bounds = tuple[Float64, Float64]  # smallest and largest coordinates, (3,) and (3,) m


def bounds_of(points: Float64) -> Bounds:
    """Return the box around points (n, 3)."""
    return points.min(axis=0), points.max(axis=0)


def joined_bounds(boxes: Iterable[Bounds | None]) -> Bounds | None:
    """Return the box around all boxes that are not None; None when there is none."""
    known = [box for box in boxes if box is not None]
    if not known:
        return None
    return np.min([low for low, _ in known], axis=0), np.max([high for _, high in known], axis=0)


def box_corners(box: Bounds) -> Float64:
    """Return the eight corners of a box, (8, 3); z varies fastest."""
    return np.where(np.indices((2, 2, 2)).reshape(3, -1).T == 0, *box)


def distance_to_box(points: Float64, box: Bounds) -> Float64:
    """Return the distance of points (..., 3) to a box, (...,), 0 inside."""
    return np.linalg.norm(np.maximum(np.maximum(box[0] - points, points - box[1]), 0), axis=-1)
