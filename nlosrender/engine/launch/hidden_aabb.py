"""Axis-aligned bounding box of the hidden geometry: rays from a planar wall that miss it meet nothing."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlosrender.scene.pose import Float64


@dataclass(frozen=True, eq=False)
class HiddenAabb:
    """Corners of the box [engine units]; opaque, so that kernels do not depend on their values."""

    low: mi.Point3f
    high: mi.Point3f

    @classmethod
    def of(cls, low: Float64, high: Float64) -> HiddenAabb:
        """Return the box with corners (3,)."""
        ends = (mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in corner)) for corner in (low, high))
        return cls(*ends)

    def is_missed(self, ray: mi.Ray3f) -> mi.Bool:
        """Return which rays, extended to both sides, miss it: slab test (Kay & Kajiya 1986).

        A ray in the plane of a side counts as meeting it: its distances are NaN.
        """
        inverse = dr.rcp(ray.d)
        one, other = (self.low - ray.o) * inverse, (self.high - ray.o) * inverse
        return dr.max(dr.minimum(one, other)) > dr.min(dr.maximum(one, other))
