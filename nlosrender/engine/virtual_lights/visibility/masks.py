"""Visibility masks: tiles of a planar wall from which nothing can hide a point, so that no shadow ray is needed.

A shadow ray spends most of its time in its last centimetres, in the boxes around the very surface it ends on, and
mostly for nothing: before a point that faces the wall, neighbours that face the wall too cannot lie. A mask holds the
tiles of the wall that see its point for certain; from the others a ray is traced.

The test is conservative (proof: docs/virtual-lights.md, 5). A triangle cannot hide a point from a tile if some plane
separates it from the pyramid between the two: the triangle's own plane, a side of the pyramid, the plane through the
point along the wall, or that of the point's surface, from behind which nothing sees the point.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.footprint import Footprint
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.pilot_points import Pilot
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.engine.virtual_lights.visibility.bvh import LEAF, Bvh
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

TILES = 8  # along each side of a rectangle: one bit of a 64-bit mask each, row by row
ALL_TILES = 2**TILES**2 - 1  # the bits
COLUMN_TILES = sum(1 << TILES * row for row in range(TILES))  # the bits of one column
# How far a triangle may rise over the point's plane: shadow rays end at an offset of 5e-7 or more.
RISE = 1e-5  # of a point's height over the wall
MAX_RISE = 1e-6  # engine units: float32 vertices of a plane of size 1 are good to 1e-7
MARGIN = 1e-5  # engine units by which rectangles are wider on each side: 100 float32 steps at size 1
SLACK = 1e-3  # of a tile, around shadows: 1e3 steps of float32 for what lies halfway
MIN_DEPTH = 1e-30  # engine units: guards a quotient

T = TypeVar("T")


class Rectangle(NamedTuple):
    """A rectangle of the wall [engine units]."""

    low: mi.Point2f
    high: mi.Point2f


@dataclass(frozen=True, eq=False)
class WallTiles:
    """Rectangles of a planar wall that points are seen from, each in ``TILES`` x ``TILES`` tiles."""

    packed: mi.Float  # four a rectangle: lowest x and y, width and height of a tile [engine units]
    n_points: int  # sensor points that share a mask

    @classmethod
    def around(cls, groups: Sequence[Float64], n_points: int, margin: Float64 | float = 0.0) -> WallTiles:
        """Return the rectangles, wider by ``margin`` (2,) on each side, around wall points (n, 3) [engine units]."""
        low, high = (np.array([end(points[:, :2], axis=0) for points in groups]) for end in (np.min, np.max))
        low, high = low - margin, high + margin
        sizes = (high - low + 2 * MARGIN) / TILES
        return cls(on_device(mi.Float, np.concatenate([low - MARGIN, sizes], axis=1).ravel()), n_points)

    @classmethod
    def of(cls, built: BuiltScene, capture: Capture, batch: Batch | Pilot, *, with_lasers: bool = False) -> WallTiles:
        """Return the rectangle around all sensor points, and all laser points if asked for."""
        grids = [capture.sensor_grid, *([capture.laser_grid] if with_lasers else [])]
        points = np.concatenate([grid.positions.reshape(-1, 3) / built.metres_per_engine_unit for grid in grids])
        return cls.around([points], count_sensors(capture, batch), footprint_margin(built, capture))

    def tiles(self, index: mi.UInt32) -> mi.Vector4f:
        """Return lowest x and y of a rectangle, and width and height of its tiles."""
        return dr.gather(mi.Vector4f, self.packed, index)

    def tile_bit(self, index: mi.UInt32, point: mi.Point3f) -> mi.UInt64:
        """Return the bit of the tile that a point of the wall lies in."""
        left, bottom, width, height = self.tiles(index)
        places = (point.x - left) / width, (point.y - bottom) / height
        column, row = (mi.UInt32(dr.clip(place, 0, TILES - 1)) for place in places)
        return mi.UInt64(1) << mi.UInt64(row * TILES + column)


def footprint_margin(built: BuiltScene, capture: Capture) -> Float64:
    """Return how far the footprints of sensor points reach along the wall's axes (2,) [engine units]."""
    seen = capture.footprint if isinstance(capture.footprint, Footprint) else None
    return np.zeros(2) if seen is None else np.array([seen.width, seen.height]) / (2 * built.metres_per_engine_unit)


def count_sensors(capture: Capture, batch: Batch | Pilot) -> int:
    """Return how many sensor points share a mask: those of the capture, so that batching cannot change results."""
    return batch.sensors.size if isinstance(batch, Pilot) else capture.n_sensors


@dataclass(frozen=True, eq=False)
class Surface:
    """Points that may be hidden, on the device."""

    points: mi.Point3f  # [engine units]
    normals: mi.Vector3f  # masks hold for wall points in front of these planes only
    other_normals: mi.Vector3f  # nothing behind these planes hides the points from wall points in front of them


class VisibilityMasks:
    """Finds the tiles of a planar wall from which nothing can hide points of the hidden geometry.

    Parameters
    ----------
    built
        The scene. Before a curved wall all masks are empty.
    tuning
        How many sensor points make a mask pay off.
    """

    def __init__(self, built: BuiltScene, tuning: VirtualLightTuning = DEFAULT_TUNING):
        self.built, self.tuning = built, tuning

    @functools.cached_property
    def _bvh(self) -> Bvh:
        return Bvh.of(self.built.hidden_shapes)

    def set_up(self) -> None:
        """Build the BVH."""
        _ = self._bvh

    def pay_off(self, n_points: int) -> bool:
        """Return whether points that ``n_points`` sensor points look at get masks."""
        return self.built.wall.is_planar and n_points >= self.tuning.min_mask_sensors

    def of(self, surface: Surface, wall_tiles: WallTiles, where: mi.UInt32, active: mi.Bool) -> mi.UInt64:
        """Return the bits of the tiles of rectangle ``where`` that certainly see each ``active`` point.

        The masks of other points are empty, and all where masks do not pay off.
        """
        if not self.pay_off(wall_tiles.n_points):
            return dr.zeros(mi.UInt64, dr.width(surface.points))
        active = active & (surface.points.z > 0)
        for shape in self.built.hidden_shapes:
            if not shape.is_mesh():  # a point in its box may be hidden by the shape itself, however near
                box = shape.bbox()
                active = active & ~mi.BoundingBox3f(mi.Point3f(box.min), mi.Point3f(box.max)).contains(surface.points)
        view = _View(surface, wall_tiles.tiles(where))
        mask = dr.select(active, mi.UInt64(ALL_TILES) & ~_hidden_tiles(self._bvh, view, active), 0)
        dr.eval(mask)
        return mask


@dr.syntax
def _hidden_tiles(bvh: Bvh, view: _View, active: mi.Bool) -> mi.UInt64:
    """Return the bits of the tiles from which some triangle may hide each point: stackless BVH traversal."""
    hidden = mi.UInt64(0)
    node = dr.select(active, mi.UInt32(1), 0)
    while dr.hint(node > 0, exclude=[bvh, view]):
        # to the next leaf first: lanes of a packet then test triangles together
        descending = node > 0
        while dr.hint(descending, exclude=[bvh, view, hidden]):
            enters = (view.tiles_hidden_by_box(*bvh.box(node)) & ~hidden) != 0
            is_leaf = node >= bvh.n_leaves
            node = dr.select(enters, dr.select(is_leaf, node, 2 * node), bvh.following(node))
            descending = (node > 0) & ~(enters & is_leaf)
        # a symbolic loop: the kernel holds the test of one triangle
        index = dr.gather(mi.UInt32, bvh.first, node - bvh.n_leaves, node > 0)
        end = dr.select(node > 0, index + LEAF, index)
        while dr.hint(index < end, exclude=[bvh, view, node, end]):
            corners, normal = bvh.triangle(index)
            more = view.tiles_in_shadow(corners) & ~hidden
            if dr.hint(more != 0, exclude=[view, corners, normal]):
                hidden |= more & ~view.tiles_separated(corners[0], normal)
            index += 1
        node = dr.select(node > 0, bvh.following(node), 0)
    return hidden


class _View:
    """The tiles of the wall as points see them, and those in the shadow of what lies in between."""

    def __init__(self, surface: Surface, tiles: mi.Vector4f):
        self.points = surface.points
        self.feet = mi.Point2f(self.points.x, self.points.y)
        self.low, self.step = mi.Point2f(tiles.x, tiles.y), mi.Vector2f(tiles.z, tiles.w)
        self.rise = dr.minimum(RISE * self.points.z, MAX_RISE)
        self.normals, self.other_normals = surface.normals, surface.other_normals
        # tiles wholly behind the surface do not see the points, hidden or not
        self.seen = ~self._tiles_beside(self.points, surface.normals)[1]
        self.before_other_planes = self._tiles_beside(self.points, surface.other_normals)[0]

    def tiles_hidden_by_box(self, low: mi.Point3f, high: mi.Point3f) -> mi.UInt64:
        """Return the bits of the tiles from which triangles in boxes may hide the points."""
        highest = [
            dr.dot(plane, dr.select(plane > 0, high, low) - self.points) for plane in (self.normals, self.other_normals)
        ]
        is_between = (low.z < self.points.z) & (high.z > 0) & (highest[0] > self.rise)
        tiles = self._tiles_in(self._shadow_of_box(low, high))
        return dr.select(is_between, self._without_low(tiles, highest[1]), 0)

    def tiles_in_shadow(self, corners: list[mi.Point3f]) -> mi.UInt64:
        """Return the bits of the tiles from which triangles may hide the points, their own planes not considered."""
        edges = [corner - self.points for corner in corners]
        depths = [-edge.z for edge in edges]
        highest = [_maximum([dr.dot(plane, edge) for edge in edges]) for plane in (self.normals, self.other_normals)]
        is_between = (_maximum(depths) > 0) & (highest[0] > self.rise)
        tiles = self._tiles_in(self._shadow_of_triangle(edges, depths))
        return dr.select(is_between, self._without_low(tiles, highest[1]), 0)

    def _without_low(self, tiles: mi.UInt64, highest: mi.Float) -> mi.UInt64:
        """Return ``tiles`` without those before the points' other planes, for what does not rise over these."""
        return dr.select(highest > self.rise, tiles, tiles & ~self.before_other_planes)

    def _shadow_of_box(self, low: mi.Point3f, high: mi.Point3f) -> Rectangle:
        """Return the rectangle around the shadow that boxes throw on the wall, lit from the points."""
        # the nearer to the point, the larger the shadow: the ends of the box bound it
        nearest, farthest = (self.points.z / dr.maximum(self.points.z - z, MIN_DEPTH) for z in (high.z, low.z))
        one, other = mi.Point2f(low.x, low.y) - self.feet, mi.Point2f(high.x, high.y) - self.feet
        ends = dr.minimum(one * nearest, one * farthest), dr.maximum(other * nearest, other * farthest)
        return Rectangle(ends[0] + self.feet, ends[1] + self.feet)

    def _shadow_of_triangle(self, edges: list[mi.Vector3f], depths: list[mi.Float]) -> Rectangle:
        """Return the rectangle around the shadow of triangles; beside the points it is unbounded."""
        low, high = mi.Point2f(dr.inf), mi.Point2f(-dr.inf)
        for k, (edge, depth) in enumerate(zip(edges, depths, strict=True)):
            flat = mi.Vector2f(edge.x, edge.y)
            place = flat * (self.points.z / depth)
            low = dr.select(depth > 0, dr.minimum(low, place), low)
            high = dr.select(depth > 0, dr.maximum(high, place), high)
            # an edge that crosses the points' height throws its shadow to infinity, in the direction of the crossing
            before, other = edges[k - 1], depths[k - 1]
            crossing = flat * other - mi.Vector2f(before.x, before.y) * depth
            crossing = dr.select(other > depth, crossing, -crossing)
            crosses = (depth > 0) != (other > 0)
            low = dr.select(crosses & (crossing <= 0), -dr.inf, low)
            high = dr.select(crosses & (crossing >= 0), dr.inf, high)
        return Rectangle(low + self.feet, high + self.feet)

    def tiles_separated(self, corner: mi.Point3f, normal: mi.Vector3f) -> mi.UInt64:
        """Return the bits of the tiles on the same side of planes as the points; all for points in the plane."""
        height, (before, behind) = dr.dot(normal, self.points - corner), self._tiles_beside(corner, normal)
        separated = dr.select(height > 0, before, behind)
        # no ray crosses a plane that it begins in
        return dr.select(dr.abs(height) <= self.rise, mi.UInt64(ALL_TILES), separated)

    def _tiles_beside(self, point: mi.Point3f, normal: mi.Vector3f) -> tuple[mi.UInt64, mi.UInt64]:
        """Return the bits of the tiles that lie before planes, and behind them."""
        edges = [[normal[axis] * (self.low[axis] + self.step[axis] * k) for k in range(TILES + 1)] for axis in range(2)]
        lowest, highest = (
            [[of(*pair) for pair in pairwise(heights)] for heights in edges] for of in (dr.minimum, dr.maximum)
        )
        base, before, behind = dr.dot(normal, point), mi.UInt64(0), mi.UInt64(0)
        for row, column in np.ndindex(TILES, TILES):
            bit = mi.UInt64(1 << row * TILES + column)
            before |= dr.select(lowest[0][column] + lowest[1][row] >= base, bit, 0)
            behind |= dr.select(highest[0][column] + highest[1][row] <= base, bit, 0)
        return before, behind

    def _tiles_in(self, rectangle: Rectangle) -> mi.UInt64:
        """Return the bits of the tiles that touch a rectangle."""
        low, high = ((end - self.low) / self.step for end in rectangle)
        first = dr.clip(dr.floor(low - SLACK), 0, TILES)
        last = dr.maximum(dr.clip(dr.floor(high + SLACK) + 1, 0, TILES), first)
        columns, rows = (
            _bit(mi.UInt64(last[axis]) * stride) - _bit(mi.UInt64(first[axis]) * stride)
            for axis, stride in enumerate((1, TILES))
        )
        return (columns * COLUMN_TILES) & rows & self.seen


def _bit(index: mi.UInt64) -> mi.UInt64:
    """Return the bit of an index, 0 for that after the last: the difference of two is the bits in between."""
    # a shift by the whole width is undefined
    return dr.select(index < TILES**2, mi.UInt64(1) << (index & (TILES**2 - 1)), 0)


def _maximum(values: Sequence[T]) -> T:
    return functools.reduce(dr.maximum, values)
