"""Low-discrepancy numbers of paths: additive recurrences, and systematic sampling of the first coordinate.

Additive recurrence (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences"): x_i = frac(s + i a), with
a from the generalised golden ratio. Here x is a 32-bit integer, so the recurrence is exact however long it runs. Every
lane has a random start s of its own (Cranley-Patterson rotation, Cranley & Patterson 1976): the estimate is unbiased
and lanes are independent.

Systematic sampling: path i of the n paths of a block takes its first coordinate from the i-th of n equal parts of
[0, 1), with the same random offset in every part. Unbiased once the block is complete. With an additive recurrence as
second coordinate the points are a randomly shifted rank-1 lattice. First coordinates ascend, so that lanes of a packet
send their rays to neighbouring points at the same time, which is what makes packets of rays fast.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

GOLDEN = 0x9E3779B9  # 2^32 over the golden ratio: offsets of later blocks fall between those of earlier ones


def recurrence_steps(dimensions: int) -> tuple[int, ...]:
    """Return the odd 32-bit integer steps of the additive recurrence in ``dimensions`` dimensions.

    The generalised golden ratio g is the positive root of g^(d+1) = g + 1; step j is 2^32 / g^j.

    Raises
    ------
    ValueError
        ``dimensions`` is below 1.
    """
    if dimensions < 1:
        raise ValueError(f"dimensions: got {dimensions}, need an integer >= 1")
    ratio = 2.0
    for _ in range(64):  # a contraction: 64 steps reach float64 precision
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    # odd: the recurrence then visits all 2^32 integers before it repeats
    return tuple(int(2.0**32 / ratio**j) | 1 for j in range(1, dimensions + 1))


@dataclass(frozen=True, eq=False)
class SystematicSequence:
    """Position of every lane in its block of paths; 64 bits, so that no part is skipped however many there are."""

    position: mi.UInt64  # its upper 32 bits are the next path's first coordinate
    stride: mi.UInt64  # from path to path, opaque
    block: range = range(0)  # numbers of the paths

    @classmethod
    def of_paths(cls, block: range, start: mi.UInt32) -> SystematicSequence:
        """Return the sequence at the begin of a block.

        Parameters
        ----------
        block
            Numbers of the paths; the estimate is unbiased when all of them have been traced.
        start
            Random 32-bit integers, one per lane.
        """
        stride = _stride(block)
        offset = mi.UInt64(start + mi.UInt32(block.start * GOLDEN % 2**32))
        position = offset * mi.UInt64(stride >> 32)
        dr.eval(position)
        return cls(position, dr.opaque(mi.UInt64, stride), block)

    @classmethod
    def at_position(cls, block: range, position: mi.UInt64) -> SystematicSequence:
        """Return the sequence inside a block of which some paths have been traced."""
        return cls(position, dr.opaque(mi.UInt64, _stride(block)), block)


def _stride(block: range) -> int:
    return min(2**64 // max(len(block), 1), 2**64 - 1)


def first_coordinate(position: mi.UInt64) -> mi.UInt32:
    """Return the first coordinate as a 32-bit integer."""
    return mi.UInt32(position >> 32)
