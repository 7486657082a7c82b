"""Distribution of a patch's light over the bins it covers: no noise, exact for a delay that is linear over the patch.

The density of delays over a triangle rises and then falls, linearly; over a parallelogram it is constant in between.
Let the delays (in bins) at which it begins, reaches its height, leaves it and ends be t0 <= t1 <= t2 <= t3. Its
cumulative distribution function (CDF), the part of the area with a delay below t, is

    (t - t0)^2 / ((t1 - t0) s)                 for t0 <= t <= t1
    (2 t - t0 - t1) / s                        for t1 <= t <= t2
    1 - (t3 - t)^2 / ((t3 - t2) s)             for t2 <= t <= t3

with s = t3 + t2 - t1 - t0, and a bin's fraction is the difference of the CDF at its edges: docs/virtual-lights.md, 2.
Of a triangle whose light is not even but linear, the squares get factors that are linear in the delay.
Cf. Iseringhausen & Hullin 2020; Tsai et al. 2019.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from nlosrender.engine.virtual_lights.gather.block_histogram import BLOCK, BlockHistogram

MIN_WIDTH = 1e-3  # bins: below it the patch's delay counts as one number; float32 delays of 4096 bins are good to 2e-4
MIN_RAMP = 1e-6  # bins, of the rise and the fall: guards quotients


@dataclass(frozen=True, eq=False)
class PatchDelays:
    """Delays from wall points to patches [bins]."""

    corners: mi.Vector4f  # successive ones of a parallelogram; of a triangle the first three
    middle: mi.Float  # to the centre on the true surface

    @classmethod
    def from_point(
        cls,
        point: mi.Point3f,
        centre: mi.Point3f,
        corners: tuple[mi.Point3f, mi.Point3f, mi.Point3f],
        bins_per_unit: mi.Float,
    ) -> PatchDelays:
        """Return the delays from one wall point; ``corners``: three successive ones of a parallelogram."""
        a, b, c = corners
        ends = mi.Vector4f(*(dr.norm(end - point) * bins_per_unit for end in (a, b, c, a + (c - b))))
        return cls(ends, dr.norm(centre - point) * bins_per_unit)

    def __add__(self, other: PatchDelays) -> PatchDelays:
        return PatchDelays(self.corners + other.corners, self.middle + other.middle)


@dataclass(eq=False)  # not frozen: the state of a loop
class Delays:
    """Corners of the density of a patch's delays [bins], ascending."""

    t0: mi.Float
    t1: mi.Float
    t2: mi.Float | None  # None: no patch is a parallelogram, t2 = t1
    t3: mi.Float
    first: mi.Float  # least delay that light may have: the CDF is 0 before, and jumps there
    light: mi.Vector3f | None = None  # per area, at t0, t1 and t3 of triangles, mean 1; None: even over all patches

    @classmethod
    def of_triangle(cls, delays: mi.Vector3f, light: mi.Vector3f | None = None) -> Delays:
        """Return those of triangles with ``delays`` at the corners.

        ``light``: per area at the corners, linear between them, mean 1; None: even.
        """
        (a, b, c) = delays
        low, high = dr.minimum(a, b), dr.maximum(a, b)
        t0, t1, t3 = dr.minimum(low, c), dr.maximum(low, dr.minimum(high, c)), dr.maximum(high, c)
        sorted_light = None
        if light is not None:
            (p, q, r) = light
            at_low, at_high = dr.select(a > b, q, p), dr.select(a > b, p, q)
            first, last = c < low, c > high
            sorted_light = mi.Vector3f(
                dr.select(first, r, at_low),
                dr.select(first, at_low, dr.select(last, at_high, r)),
                dr.select(last, r, at_high),
            )
        return cls(t0, t1, None, t3, t0, sorted_light)

    @classmethod
    def of_parallelogram(cls, a: mi.Float, b: mi.Float, c: mi.Float, d: mi.Float) -> Delays:
        """Return the density's corners of a parallelogram; parameters are the delays of its successive corners.

        Of all linear delays, the one nearest to theirs is taken: half their differences along the sides, and their
        mean in the middle.
        """
        one, other = dr.abs((b - a) + (c - d)) / 2, dr.abs((d - a) + (c - b)) / 2
        short, long = dr.minimum(one, other), dr.maximum(one, other)
        t0 = ((a + b) + (c + d)) / 4 - (short + long) / 2
        return cls(t0, t0 + short, t0 + long, t0 + short + long, t0)

    @classmethod
    def of_patch(
        cls, delays: PatchDelays, is_parallelogram: mi.Bool | None, light: mi.Vector3f | None = None
    ) -> Delays:
        """Return those of patches with four corners, of triangles the first three.

        Between its corners a linear delay is later than the true one. Cubature with the corners and the centre, exact
        for quadratic functions, tells by how much on average: weights 1/12 and 3/4 over a triangle, 1/12 and 2/3 over
        a parallelogram. All delays are moved by that, and none before the earliest of them
        (docs/virtual-lights.md, 2.1).

        ``is_parallelogram`` None: no patch is one; their light is even. ``light``: see ``of_triangle``.
        """
        (a, b, c, d), middle = delays.corners, delays.middle
        patch = cls.of_triangle(mi.Vector3f(a, b, c), light)
        late = 0.75 * ((a + b + c) / 3 - middle)
        if is_parallelogram is not None:
            other = replace(cls.of_parallelogram(a, b, c, d), light=None if light is None else mi.Vector3f(1))
            patch = dr.select(is_parallelogram, other, replace(patch, t2=patch.t1))
            late = dr.select(is_parallelogram, (2 / 3) * (dr.mean(delays.corners) - middle), late)
        moved = patch.later(-late)
        return replace(moved, first=dr.maximum(moved.t0, dr.minimum(patch.t0, middle)))

    def later(self, delay: mi.Float | int) -> Delays:
        """Return the delays that begin so much later."""
        t2 = None if self.t2 is None else self.t2 + delay
        return Delays(self.t0 + delay, self.t1 + delay, t2, self.t3 + delay, self.first + delay, self.light)


class _DelayCdf:
    """The CDF at the top of the module."""

    def __init__(self, delays: Delays):
        t0, t1, t3 = delays.t0, delays.t1, delays.t3
        t2 = t1 if delays.t2 is None else delays.t2
        self.delays = delays
        self.height = dr.rcp(dr.maximum((t3 - t0) + (t2 - t1), MIN_WIDTH))
        rise, fall = dr.rcp(dr.maximum(t1 - t0, MIN_RAMP)), dr.rcp(dr.maximum(t3 - t2, MIN_RAMP))
        self.rising, self.falling = self.height * rise, self.height * fall
        if delays.light is not None:
            early, middle, late = delays.light
            along = (late - early) * self.height
            self.more = (along + (middle - early) * rise) / 3
            self.less = ((middle - late) * fall - along) / 3

    def __call__(self, delay: mi.Float | int) -> mi.Float:
        t0, t1, t2, t3 = self.delays.t0, self.delays.t1, self.delays.t2, self.delays.t3
        since, until = delay - t0, dr.maximum(t3 - delay, 0)
        up, down = dr.square(since) * self.rising, dr.square(until) * self.falling
        if self.delays.light is not None:
            up *= self.delays.light.x + self.more * since
            down *= self.delays.light.z + self.less * until
        down = 1 - down
        if t2 is not None:
            down = dr.select(delay < t2, ((delay - t0) + (delay - t1)) * self.height, down)
        return dr.select(delay > self.delays.first, dr.select(delay < t1, up, down), 0)

    def bin_fractions(self, below: mi.Float) -> tuple[list[mi.Float], mi.Float]:
        """Return the fractions of the bins of a block that begins at 0, and the CDF at its end; ``below``: at 0."""
        edges = [below, *(self(edge) for edge in range(1, BLOCK + 1))]
        return [right - left for left, right in pairwise(edges)], edges[-1]


@dr.syntax
def deposit_patch(
    histogram: BlockHistogram,
    lane: mi.UInt32,
    laser: mi.UInt32,
    delays: Delays,
    whole: mi.Int32,
    value: mi.Spectrum,
    active: mi.Bool,
) -> None:
    """Deposit ``value`` over the bins that a patch covers: those of its ``delays`` [bins] plus ``whole`` bins."""
    base = dr.floor(delays.first)
    first = mi.Int32(base) + whole
    last = first + mi.Int32(delays.t3 - base)
    block = dr.maximum(first, 0) // BLOCK
    # delays are counted from the block's left edge
    covered = delays.later(mi.Float(first - block * BLOCK) - base)
    below = mi.Float(0)  # CDF at the block's left edge
    early, late = first < 0, last >= histogram.shape.n_bins
    spilled = active & (early | late)
    if dr.hint(spilled, exclude=[histogram, value, lane, laser]):
        cdf = _DelayCdf(covered)
        end = mi.Float(histogram.shape.n_bins - block * BLOCK)
        below = dr.select(early, cdf(mi.Float(0)), 0)
        beyond = dr.select(late, 1 - cdf(end), 0)
        histogram.deposit_outside(lane, laser, value * (below + beyond), spilled)
    more = active & (last >= 0) & (block < histogram.n_blocks)
    while dr.hint(more, exclude=[histogram, value, lane, laser]):
        fractions, below = _DelayCdf(covered).bin_fractions(below)
        histogram.deposit(lane, laser, block, fractions, value, more)
        block += 1
        more = (covered.t3 > BLOCK) & (block < histogram.n_blocks)
        covered = covered.later(-BLOCK)
