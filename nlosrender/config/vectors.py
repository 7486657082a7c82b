"""The little vector arithmetic the config's rules need, without waiting for numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence


def length(vector: Sequence[float]) -> float:
    """Return the Euclidean length of ``vector``."""
    return math.hypot(*vector)


def unit(vector: Sequence[float]) -> tuple[float, ...]:
    """Return ``vector`` scaled to length 1; it must not be zero."""
    norm = length(vector)
    return tuple(item / norm for item in vector)


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product of ``a`` and ``b``."""
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    """Return the vector product of ``a`` and ``b``, both (3,)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def parallel(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether two non-zero vectors (3,) span no plane."""
    return length(cross(unit(a), unit(b))) < 1e-6  # poses lose half their float64 digits there


def height_above(point: Sequence[float], origin: Sequence[float], normal: Sequence[float]) -> float:
    """Return the signed distance [m] of ``point`` from the plane through ``origin`` with ``normal``."""
    return dot([p - o for p, o in zip(point, origin, strict=True)], unit(normal))
