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
}  # by Dr.Jit's names
ALIGNMENT = 64  # bytes, the widest vectors there are


def on_device(kind: Any, values: NDArray[np.generic]) -> Any:
    """Bring numbers (n,) to the device as an array of type ``kind``.

    Dr.Jit takes numpy's memory as it is, and a kernel knows how its arrays are aligned: numpy aligns by chance, and
    each pattern of chance would be a kernel to compile.
    """
    source = np.ascontiguousarray(values, dtype=KINDS[kind.__name__])
    room = np.empty(source.nbytes + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    aligned = room[start : start + source.nbytes].view(source.dtype)
    aligned[:] = source
    return kind(aligned)


def columns(values: NDArray[np.floating]) -> list[mi.Float]:
    """Bring the columns of ``values`` (n, k) to the device, each as an array of its own.

    A vector made of the whole would be taken apart by a kernel that has n in it, compiled anew for every n.
    """
    return [on_device(mi.Float, column) for column in np.asarray(values).T]
