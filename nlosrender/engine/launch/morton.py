"""Morton order (Z-order curve, Morton 1966): points near in this order are near in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64

BITS = 10  # per axis: three axes fit a 32-bit number
MIN_SIZE = 1e-30  # of the box, by which coordinates are divided; not zero in float32 either


def morton_order(points: Float64) -> NDArray[np.int64]:
    """Return the Morton codes (n,) of ``points`` (n, 3) in their bounding cube."""
    if not len(points):
        return np.zeros(0, np.int64)
    axes = [np.ascontiguousarray(axis) for axis in points.T]  # numpy takes ten times as long for minima over rows
    low = [float(axis.min()) for axis in axes]
    size = max(max(float(axis.max()) - start for axis, start in zip(axes, low, strict=True)), MIN_SIZE)
    scaled = (((axis - start) / size) * 2**BITS for axis, start in zip(axes, low, strict=True))
    x, y, z = (_spread(np.minimum(along.astype(np.uint32), 2**BITS - 1)) for along in scaled)
    return (x | y << 1 | z << 2).astype(np.int64)


def _spread(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return 10-bit numbers with two zero bits inserted after each bit, by repeated halving."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        numbers = (numbers | numbers << np.uint32(shift)) & np.uint32(mask)
    return numbers
