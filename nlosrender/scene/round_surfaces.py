"""Spheres and cylinders as Mitsuba has them, and concentric ones that rays do not tell apart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from nlosrender.scene.coincident import GAP, STEP
from nlosrender.scene.pose import Float64

ROUND_PLUGINS = ("Sphere", "Cylinder")


@dataclass(frozen=True, eq=False)
class RoundSurface:
    """A sphere, or a cylinder without caps [engine units]."""

    centre: Float64  # (3,) of a cylinder: where its axis begins
    radius: float
    axis: Float64  # (3,) from end to end; zero for a sphere
    is_inside: bool  # seen from within

    @classmethod
    def of(cls, shape: mi.Shape) -> RoundSurface:
        """Return what a Mitsuba sphere or cylinder is."""
        if shape.class_name() == "Cylinder":
            to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
            radius = float(np.linalg.norm(to_world[:3, 0]))
            return cls(to_world[:3, 3], radius, to_world[:3, 2], shape.has_flipped_normals())
        box = shape.bbox()
        low, high = (np.ravel(np.asarray(corner, dtype=np.float64)) for corner in (box.min, box.max))
        return cls((low + high) / 2, float((high - low).max()) / 2, np.zeros(3), shape.has_flipped_normals())

    @property
    def gap(self) -> float:
        """Distance from which rays tell it from a concentric one: four ray offsets, see ``ray_offset_at``."""
        farthest = np.abs([self.centre, self.centre + self.axis]).max() + self.radius
        return float(GAP * (1 + farthest) * max(1.0, 1 / self.radius))

    def distance_of_axes(self, other: RoundSurface) -> float:
        """Return how far the other's centre or axis is from this one's at most; inf where they lie side by side."""
        length = float(np.linalg.norm(self.axis))
        between = other.centre - self.centre
        if length == 0 or not other.axis.any():
            return float(np.linalg.norm(between)) if length == 0 and not other.axis.any() else np.inf
        unit = self.axis / length
        ends = np.array([between, between + other.axis])
        along = ends @ unit
        if along.max() < 0 or along.min() > length:
            return np.inf
        return float(np.linalg.norm(ends - along[:, None] * unit, axis=1).max())


@dataclass(frozen=True)
class Nested:
    """A sphere or cylinder that lies so close to a concentric one that it is given another radius."""

    hidden: int  # its number
    other: int  # the one it is hidden by
    factor: float  # new radius over its own


def curvature(shape: mi.Shape) -> float:
    """Return 1 / radius [1 / engine unit] of a sphere or cylinder, 0 for other shapes."""
    return 1 / RoundSurface.of(shape).radius if shape.class_name() in ROUND_PLUGINS else 0.0


def nested_surfaces(shapes: Sequence[mi.Shape]) -> list[Nested]:
    """Return which spheres and cylinders have to be made smaller, or larger if seen from within, to be hidden.

    Of two with one radius the later one is seen.
    """
    surfaces = {n: RoundSurface.of(shape) for n, shape in enumerate(shapes) if shape.class_name() in ROUND_PLUGINS}
    found = []
    for (i, a), (j, b) in itertools.combinations(surfaces.items(), 2):
        apart, gap = a.distance_of_axes(b), max(a.gap, b.gap)
        if a.is_inside != b.is_inside or apart + abs(a.radius - b.radius) >= gap:
            continue
        sign = -1 if a.is_inside else 1
        hidden, other = (i, j) if sign * (b.radius - a.radius) >= 0 else (j, i)
        radius = surfaces[other].radius - sign * (STEP * gap + apart)
        if radius > 0:
            found.append(Nested(hidden, other, radius / surfaces[hidden].radius))
    return found
