"""First coordinates of paths in ascending order: the lanes of a packet look at neighbouring points at the same time.

Path i of the n paths of a stage takes its first coordinate from the i-th of n equal parts of [0, 1), at a place that
is random per lane and the same in every part: systematic sampling, unbiased once the stage is complete. With an
additive recurrence as second coordinate the points are a rank-1 lattice, shifted at random (Cranley & Patterson 1976).
Rays of neighbouring lanes go to neighbouring points, which is what makes packets of rays quick.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

GOLDEN = 0x9E3779B9  # 2^32 over the golden ratio: places of later stages fall between those of earlier ones


@dataclass(frozen=True, eq=False)
class SystematicSequence:
    """Where every lane is in its stage. 64 bits: no part is missed, however many there are."""

    at: mi.UInt64  # its upper 32 bits are the next path's first coordinate
    stride: mi.UInt64  # from path to path, opaque
    stage: range = range(0)  # numbers of the paths

    @classmethod
    def of_paths(cls, stage: range, start: mi.UInt32) -> SystematicSequence:
        """Return the strata of the paths ``stage`` of every lane.

        Parameters
        ----------
        stage
            Numbers of the paths, of which all are going to be traced.
        start
            Random 32-bit integers, one per lane.
        """
        stride = _stride(stage)
        place = mi.UInt64(start + mi.UInt32(stage.start * GOLDEN % 2**32))
        at = place * mi.UInt64(stride >> 32)
        dr.eval(at)
        return cls(at, dr.opaque(mi.UInt64, stride), stage)

    @classmethod
    def at_position(cls, stage: range, at: mi.UInt64) -> SystematicSequence:
        """Return the strata of a stage of which some paths are traced: ``at`` is where the lanes are."""
        return cls(at, dr.opaque(mi.UInt64, _stride(stage)), stage)


def _stride(stage: range) -> int:
    return min(2**64 // max(len(stage), 1), 2**64 - 1)


def first_coordinate(at: mi.UInt64) -> mi.UInt32:
    """Return the coordinate as a 32-bit integer."""
    return mi.UInt32(at >> 32)
