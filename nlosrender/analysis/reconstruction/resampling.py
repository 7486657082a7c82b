"""Band-limited interpolation from a regular lattice to any coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.files.layout import Float64

REACH = 10  # lattice points used on either side of a coordinate
OVERSAMPLING = 1.5  # lattice points per wave, over the two that are needed at least
# A Kaiser window of this shape leaves exp(-pi * REACH * (1 - 1/OVERSAMPLING)) = 3e-5 of anything below the band's
# edge wrong (Kaiser 1974).
SHAPE = np.pi * REACH * (1 - 1 / OVERSAMPLING)


def interpolation_matrix(coordinates: Float64, first: float, step: float, count: int) -> NDArray[np.float32]:
    """Return the matrix (coordinate, count) that takes samples at first + i * step to ``coordinates``.

    Exact to 1e-4 for what has ``2 * OVERSAMPLING`` samples per period or more, where the lattice reaches ``REACH``
    points beyond the coordinates on both sides.
    """
    offset = (coordinates[:, None] - first) / step - np.arange(count)
    inside = np.clip(1 - (offset / REACH) ** 2, 0, None)
    window = np.where(np.abs(offset) < REACH, np.i0(SHAPE * np.sqrt(inside)) / np.i0(SHAPE), 0.0)
    return (np.sinc(offset) * window).astype(np.float32)


def covering(coordinates: Float64, first: float, step: float) -> tuple[int, int]:
    """Return the indices (start, stop) of the lattice first + i * step that interpolation to ``coordinates`` needs."""
    low, high = (float(end - first) / step for end in (coordinates.min(), coordinates.max()))
    return int(np.floor(low)) - REACH, int(np.ceil(high)) + REACH + 1
