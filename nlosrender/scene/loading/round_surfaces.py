"""Spheres and cylinders as Mitsuba has them, and new radii for concentric ones that rays cannot resolve."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from nlosrender.scene.loading.coincident import GAP, STEP
from nlosrender.scene.pose import Float64

ROUND_PLUGINS = ("Sphere", "Cylinder")
WALL = -1  # number of the relay wall


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
        """Distance from which rays resolve it and a concentric one: four ray offsets, see ``ray_offset_at``."""
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
    """A sphere or cylinder that is given another radius, so that rays resolve it and a concentric one."""

    moved: int  # its number
    other: int  # the next one
    factor: float  # new radius over its own
    is_hidden: bool  # by the other; not where the two are seen from opposite sides


def curvature(shape: mi.Shape) -> float:
    """Return 1 / radius [1 / engine unit] of a sphere or cylinder, 0 for other shapes."""
    return 1 / RoundSurface.of(shape).radius if shape.class_name() in ROUND_PLUGINS else 0.0


def nested_surfaces(shapes: Sequence[mi.Shape], wall: mi.Shape | None) -> list[Nested]:
    """Return which spheres and cylinders get another radius: of those too near to a concentric one for rays.

    Of surfaces with one radius the later one is in front: outermost where they are seen from outside, innermost where
    they are seen from within, and these lie inside the former. Before a round relay wall hidden surfaces are in front.
    """
    everything = dict(enumerate(shapes)) if wall is None else dict(enumerate([wall, *shapes], WALL))
    surfaces = {n: RoundSurface.of(shape) for n, shape in everything.items() if shape.class_name() in ROUND_PLUGINS}
    groups = [{number} for number in surfaces]
    for i, j in itertools.combinations(surfaces, 2):
        a, b = surfaces[i], surfaces[j]
        if a.distance_of_axes(b) + abs(a.radius - b.radius) < max(a.gap, b.gap):
            one, other = (next(group for group in groups if n in group) for n in (i, j))
            if one is not other:
                one |= other
                groups.remove(other)
    return [nested for group in groups if len(group) > 1 for nested in _separated({n: surfaces[n] for n in group})]


def _separated(group: Mapping[int, RoundSurface]) -> list[Nested]:
    """Return the new radii of concentric surfaces, from the one that is seen inwards and outwards."""
    gap = max(surface.gap for surface in group.values())
    apart = max(a.distance_of_axes(b) for a, b in itertools.permutations(group.values(), 2))
    step = STEP * gap + (apart if np.isfinite(apart) else 0.0)

    def place(number: int) -> tuple[float, bool, int]:
        surface = group[number]  # radii that differ by less than float32 rounds are one
        return round(surface.radius / (1e-2 * gap)), not surface.is_inside, -number if surface.is_inside else number

    order = sorted(group, key=place)
    outward = [k for k, number in enumerate(order) if not group[number].is_inside]
    anchor = order.index(WALL) if WALL in group else max(outward, default=0)
    radii = {number: group[number].radius for number in order}
    nested = []
    inwards = [(order[k], order[k + 1], -1) for k in range(anchor - 1, -1, -1)]
    outwards = [(order[k], order[k - 1], 1) for k in range(anchor + 1, len(order))]
    for number, other, sign in (*inwards, *outwards):
        needed = radii[other] + sign * step
        if sign * (needed - radii[number]) > 0 and needed > 0:
            radii[number] = needed
            is_hidden = group[number].is_inside == group[other].is_inside and other != WALL
            nested.append(Nested(number, other, needed / group[number].radius, is_hidden))
    return nested
