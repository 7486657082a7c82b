"""An order of points in which neighbours are near in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64

BITS = 10  # per axis: three times as many fill a number
LEAST = 1e-30  # what a box of no size is divided by; more than nothing in float32, too


def morton_order(points: Float64) -> NDArray[np.int64]:
    """Return the places (n,) of ``points`` (n, 3) along a Z-order curve through their box (Morton 1966)."""
    if not len(points):
        return np.zeros(0, np.int64)
    axes = [np.ascontiguousarray(axis) for axis in points.T]  # numpy's extremes of rows take ten times as long
    low = [float(axis.min()) for axis in axes]
    size = max(max(float(axis.max()) - least for axis, least in zip(axes, low, strict=True)), LEAST)
    scaled = (((axis - least) / size) * 2**BITS for axis, least in zip(axes, low, strict=True))
    x, y, z = (_spread(np.minimum(along.astype(np.uint32), 2**BITS - 1)) for along in scaled)
    return (x | y << 1 | z << 2).astype(np.int64)


def _spread(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return numbers of ten bits with two empty bits after each: halves of the bits are moved apart, then theirs."""
    for shift, saved in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        numbers = (numbers | numbers << np.uint32(shift)) & np.uint32(saved)
    return numbers
