"""Regular grids of points on a planar wall, as a convolution needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlosrender.errors import FileError
from nlosrender.files.layout import Float64

IRREGULARITY = 0.02  # of the spacing that a point may be off its place; float32 positions far from the origin


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
    x, y = _axis(points[..., 0].mean(axis=0)), _axis(points[..., 1].mean(axis=1))
    steps = [axis.step for axis in (x, y) if axis.count > 1]
    fallback = abs(steps[0]) if steps else 1.0  # of a single row or column: any step does
    flips = tuple(number for number, axis in enumerate((y, x)) if axis.step < 0)
    x, y = (_ascending(axis, fallback) for axis in (x, y))
    height = float(points[..., 2].mean())
    ordered = np.flip(points, axis=flips) if flips else points
    expected = np.stack(np.broadcast_arrays(x.coordinates(), y.coordinates()[:, None], height), axis=-1)
    worst = float(np.abs(ordered - expected).max())
    if worst > IRREGULARITY * min(x.step, y.step):
        raise FileError(
            f"the {rows} x {columns} points on the wall are not equally spaced along its axes (one is {worst:.3g} m "
            "off), which phasor fields by convolution need. Use --method backprojection."
        )
    return Lattice(x, y, height, flips)


def _axis(coordinates: Float64) -> Axis:
    count = len(coordinates)
    step = float(coordinates[-1] - coordinates[0]) / (count - 1) if count > 1 else 0.0
    return Axis(float(coordinates[0]), step, count)


def _ascending(axis: Axis, fallback: float) -> Axis:
    if axis.step < 0:
        return Axis(axis.first + axis.step * (axis.count - 1), -axis.step, axis.count)
    return axis if axis.step > 0 else Axis(axis.first, fallback, axis.count)
