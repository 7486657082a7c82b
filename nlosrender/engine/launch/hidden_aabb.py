"""The box around all hidden geometry: rays from a planar wall that miss it meet nothing."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlosrender.scene.pose import Float64


@dataclass(frozen=True, eq=False)
class HiddenAabb:
    """A box [engine units], opaque: its place is no part of a kernel."""

    least: mi.Point3f
    most: mi.Point3f

    @classmethod
    def of(cls, least: Float64, most: Float64) -> HiddenAabb:
        """Return the box with corners (3,)."""
        ends = (mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in corner)) for corner in (least, most))
        return cls(*ends)

    def is_missed(self, ray: mi.Ray3f) -> mi.Bool:
        """Return which rays miss it, wherever on them it would be (Kay & Kajiya 1986).

        One that runs in the plane of a side counts as meeting it: its distances are no numbers.
        """
        inverse = dr.rcp(ray.d)
        one, other = (self.least - ray.o) * inverse, (self.most - ray.o) * inverse
        return dr.max(dr.minimum(one, other)) > dr.min(dr.maximum(one, other))
