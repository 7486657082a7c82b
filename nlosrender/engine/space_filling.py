"""An order of points in which neighbours are near in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64

BITS = 10  # per axis


def z_order(points: Float64) -> NDArray[np.int64]:
    """Return the places (n,) of ``points`` (n, 3) along a Z-order curve through their box (Morton 1966)."""
    if not len(points):
        return np.zeros(0, np.int64)
    low = points.min(axis=0)
    scaled = (points - low) / max(float((points.max(axis=0) - low).max()), 1e-300)
    grid = np.minimum((scaled * 2**BITS).astype(np.int64), 2**BITS - 1)
    code = np.zeros(len(points), np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
