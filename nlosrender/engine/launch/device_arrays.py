"""Arrays of numbers brought to the device, aligned so that no kernel is compiled twice for them."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

KINDS = {
    "Float": np.float32,
    "UInt": np.uint32,
    "UInt64": np.uint64,
    "Int": np.int32,
    "Float64": np.float64,
}  # by Dr.Jit's type names
ALIGNMENT = 64  # bytes of an AVX-512 vector


def on_device(kind: Any, values: NDArray[np.generic]) -> Any:
    """Copy numbers (n,) to the device as an array of type ``kind``, aligned to ``ALIGNMENT``.

    Dr.Jit uses numpy's memory in place, and the alignment of arrays is part of a kernel: numpy's varies, so every
    pattern of alignments would be compiled anew.
    """
    source = np.ascontiguousarray(values, dtype=KINDS[kind.__name__])
    room = np.empty(source.nbytes + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    aligned = room[start : start + source.nbytes].view(source.dtype)
    aligned[:] = source
    return kind(aligned)


def columns(values: NDArray[np.floating]) -> list[mi.Float]:
    """Copy the columns of ``values`` (n, k) to the device, one array each.

    Made from the whole array, a vector would be split by a kernel that contains n and is compiled anew for every n.
    """
    return [on_device(mi.Float, column) for column in np.asarray(values).T]


def rays_on_device(origins: NDArray[np.floating], directions: NDArray[np.floating], length: float) -> mi.Ray3f:
    """Copy rays (n, 3) to the device; they end after ``length`` times their direction, of any norm."""
    origin, direction = mi.Point3f(*columns(origins)), mi.Vector3f(*columns(directions))
    return mi.Ray3f(origin, direction, mi.Float(length), mi.Float(0), [])
