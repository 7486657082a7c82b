"""Regular grids of points on a planar wall, and band-limited interpolation from one to any coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError
from nlosrender.files.layout import Float64

MAX_IRREGULARITY = 0.02  # of the spacing that a point may be off its place: float32 positions far from the origin
HALF_WIDTH = 10  # lattice points used on either side of a coordinate
OVERSAMPLING = 1.5  # lattice points per wave, over the two that are needed at least
# A Kaiser window of this shape leaves exp(-pi * HALF_WIDTH * (1 - 1/OVERSAMPLING)) = 3e-5 of anything below the band's
# edge wrong (Kaiser 1974).
KAISER_SHAPE = np.pi * HALF_WIDTH * (1 - 1 / OVERSAMPLING)


@dataclass(frozen=True)
class Axis:
    """Equally spaced coordinates."""

    first: float  # m
    step: float  # m, > 0
    count: int

    def coordinates(self) -> Float64:
        """Return them, (count,) [m]."""
        return self.first + self.step * np.arange(self.count, dtype=np.float64)


@dataclass(frozen=True)
class Lattice:
    """Points (rows, columns) in the plane z = ``height``; x ascends along columns, y along rows."""

    x: Axis
    y: Axis
    height: float  # m
    flips: tuple[int, ...]  # axes (0 rows, 1 columns) along which the stored points descend


def lattice_of(points: Float64) -> Lattice:
    """Return the lattice that points (Ny, Nx, 3) [m] of a planar grid lie on.

    Raises
    ------
    FileError
        They are not equally spaced rows and columns along x and y.
    """
    rows, columns = points.shape[:2]
    x, y = points[..., 0].mean(axis=0), points[..., 1].mean(axis=1)
    flips = tuple(number for number, along in enumerate((y, x)) if along[-1] < along[0])
    steps = [abs(float(along[-1] - along[0])) / (len(along) - 1) for along in (x, y) if len(along) > 1]
    fallback = steps[0] if steps else 1.0  # of a single row or column: any step does
    x_axis, y_axis = _ascending(x, fallback), _ascending(y, fallback)
    height = float(points[..., 2].mean())
    places = np.broadcast_arrays(x_axis.coordinates(), y_axis.coordinates()[:, None], height)
    worst = float(np.abs(np.flip(points, axis=flips) - np.stack(places, axis=-1)).max())
    if worst > MAX_IRREGULARITY * min(x_axis.step, y_axis.step):
        raise FileError(
            f"the {rows} x {columns} points on the wall are not equally spaced along its axes (one is {worst:.3g} m "
            "off), which phasor fields by convolution need. Use --method backprojection."
        )
    return Lattice(x_axis, y_axis, height, flips)


def _ascending(coordinates: Float64, fallback: float) -> Axis:
    first, last = sorted((float(coordinates[0]), float(coordinates[-1])))
    return Axis(first, (last - first) / max(len(coordinates) - 1, 1) or fallback, len(coordinates))


def interpolation_matrix(coordinates: Float64, first: float, step: float, count: int) -> NDArray[np.float32]:
    """Return the matrix (coordinate, count) that takes samples at first + i * step to ``coordinates``.

    Exact to 1e-4 for what has ``2 * OVERSAMPLING`` samples per period or more, where the lattice reaches ``HALF_WIDTH``
    points beyond the coordinates on both sides.
    """
    offset = (coordinates[:, None] - first) / step - np.arange(count)
    inside = np.clip(1 - (offset / HALF_WIDTH) ** 2, 0, None)
    window = np.where(np.abs(offset) < HALF_WIDTH, np.i0(KAISER_SHAPE * np.sqrt(inside)) / np.i0(KAISER_SHAPE), 0.0)
    return (np.sinc(offset) * window).astype(np.float32)


def covering(coordinates: Float64, first: float, step: float) -> tuple[int, int]:
    """Return the indices (start, stop) of the lattice first + i * step that interpolation to ``coordinates`` needs."""
    low, high = (float(end - first) / step for end in (coordinates.min(), coordinates.max()))
    return int(np.floor(low)) - HALF_WIDTH, int(np.ceil(high)) + HALF_WIDTH + 1
