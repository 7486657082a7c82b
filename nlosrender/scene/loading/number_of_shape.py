"""Numbers of shapes on the device: which mirror, or which item, a ray met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

NO_NUMBER = 0xFFFFFFFF  # of a shape that has none


@dataclass(frozen=True, eq=False)
class NumberOfShape:
    """A number for some shapes of a scene, found by the shapes that rays meet."""

    numbers: mi.UInt32  # by Dr.Jit's index of a shape's pointer, the last entry for all later ones; NO_NUMBER of others
    # opaque: indices grow from scene to scene of a process, and kernels with a literal would be compiled anew
    last: mi.UInt32

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape], numbers: Sequence[int]) -> NumberOfShape:
        """Return the table of ``shapes`` and their ``numbers``."""
        index = [pointer_index(shape) for shape in shapes]
        last = max(index, default=0) + 1
        table = dr.full(mi.UInt32, NO_NUMBER, last + 1)
        if index:
            dr.scatter(table, mi.UInt32(list(numbers)), mi.UInt32(index))
        dr.eval(table)
        return cls(table, dr.opaque(mi.UInt32, last))

    def at(self, si: mi.SurfaceInteraction3f | mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.UInt32:
        """Return the number of the shape that a ray met; NO_NUMBER where it met another one, or none."""
        shape = dr.minimum(dr.reinterpret_array(mi.UInt32, si.shape), self.last)  # 0: nothing was met
        known = active & si.is_valid()
        return dr.select(known, dr.gather(mi.UInt32, self.numbers, shape, known), NO_NUMBER)


def pointer_index(shape: mi.Shape) -> int:
    """Return Dr.Jit's index of a shape's pointer."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
