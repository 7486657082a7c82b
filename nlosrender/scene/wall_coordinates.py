"""What wall coordinates and sizes have to be on every relay wall."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pose import Float64

EDGE_TOLERANCE = 1e-9  # relative to the wall's extent: decimal YAML numbers may overshoot the edge by rounding


class HasExtent(Protocol):
    """A wall whose coordinates reach from minus to plus half its width and height."""

    @property
    def width(self) -> float:
        """Extent of the wall coordinate x [m]."""

    @property
    def height(self) -> float:
        """Extent of the wall coordinate y [m]."""


def on_wall(wall: HasExtent, xy: ArrayLike) -> Float64:
    """Return wall coordinates as an array (..., 2) [m].

    Raises
    ------
    ValueError
        The shape is wrong, or a point is off the wall.
    """
    xy = np.asarray(xy, dtype=np.float64)
    if xy.ndim < 1 or xy.shape[-1] != 2:
        raise ValueError(f"wall coordinates have shape {xy.shape}: need (..., 2)")
    limit = np.array([wall.width, wall.height]) * (0.5 + EDGE_TOLERANCE)
    outside = ~np.all(np.abs(xy) <= limit, axis=-1)  # not "any >": NaN is off the wall, too
    if np.any(outside):
        x, y = xy[outside][0]
        raise ValueError(f"wall point ({x:g}, {y:g}) m is off the wall, which is {wall.width:g} x {wall.height:g} m")
    return xy


def require_positive(owner: str, **sizes: float) -> None:
    """Raise ValueError for a size [m] that is not finite and positive."""
    for name, size in sizes.items():
        if not (np.isfinite(size) and size > 0):
            raise ValueError(f"{owner} {name}: got {size!r}, need a finite number > 0 [m]")
