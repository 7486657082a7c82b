"""From where on the wall nothing can hide a point of the hidden geometry: no visibility rays are needed there.

A shadow ray spends most of its time in its last centimetres, in the boxes around the very surface it ends on, and
mostly for nothing: before a point that faces the wall, neighbours that face the wall too cannot lie. The *clearance*
of a point are the tiles of the wall to which it is known to be open.

A triangle cannot hide a point from a tile if some plane parts it from the pyramid between the two: the triangle's own
plane, a side of the pyramid, the plane through the point along the wall, or that of the point's surface, from behind
which nothing sees the point.
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

from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.pilot_points import Pilot
from nlosrender.engine.virtual_lights.visibility.bvh import LEAF, Bvh
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

TILES = 8  # along each side of a rectangle: one bit each, row by row
OF_ALL = 2**TILES**2 - 1  # the bits
OF_COLUMN = sum(1 << TILES * row for row in range(TILES))  # the bits of one column
RISE = 1e-5  # of a point's height over the wall: how far a triangle may rise over the point's plane; rays end before
MOST_RISE = 1e-6  # engine units: float32 vertices of a plane of size 1 are good to 1e-7
MARGIN = 1e-5  # engine units by which rectangles and tiles are wider on each side, for rounding
LEAST_POINTS = 256  # that look at a point: below it a clearance costs more than the rays that it saves
SLACK = 1e-3  # of a tile: what a triangle nearby hides float32 knows no better
NEARLY = 1e-30  # engine units: the least depth by which is divided

T = TypeVar("T")


class Rectangle(NamedTuple):
    """A rectangle of the wall [engine units]."""

    least: mi.Point2f
    most: mi.Point2f


@dataclass(frozen=True, eq=False)
class WallTiles:
    """Rectangles of a planar wall that points are seen from, each in ``TILES`` x ``TILES`` tiles."""

    packed: mi.Float  # four a rectangle: least x and y, width and height of a tile [engine units]
    n_points: int  # look at each point from a rectangle: whether it is worth while to leave out rays

    @classmethod
    def around(cls, groups: Sequence[Float64], n_points: int) -> WallTiles:
        """Return the rectangles around groups of wall points (n, 3) [engine units]."""
        least, most = (np.array([end(points[:, :2], axis=0) for points in groups]) for end in (np.min, np.max))
        sizes = (most - least + 2 * MARGIN) / TILES
        return cls(on_device(mi.Float, np.concatenate([least - MARGIN, sizes], axis=1).ravel()), n_points)

    @classmethod
    def of(cls, built: BuiltScene, capture: Capture, batch: Batch | Pilot, *, with_lasers: bool = False) -> WallTiles:
        """Return the rectangle around all sensor points, and all laser points if asked for."""
        grids = [capture.sensor_grid, *([capture.laser_grid] if with_lasers else [])]
        points = np.concatenate([grid.positions.reshape(-1, 3) / built.unit for grid in grids])
        return cls.around([points], count_sensors(capture, batch))

    def tiles(self, index: mi.UInt32) -> mi.Vector4f:
        """Return least x and y of a rectangle, and width and height of its tiles."""
        return dr.gather(mi.Vector4f, self.packed, index)

    def tile_bit(self, index: mi.UInt32, point: mi.Point3f) -> mi.UInt64:
        """Return the bit of the tile that a point of the wall lies in."""
        left, bottom, width, height = self.tiles(index)
        places = (point.x - left) / width, (point.y - bottom) / height
        column, row = (mi.UInt32(dr.clip(place, 0, TILES - 1)) for place in places)
        return mi.UInt64(1) << mi.UInt64(row * TILES + column)


def count_sensors(capture: Capture, batch: Batch | Pilot) -> int:
    """Return how many sensor points look: those of the capture, not the batch, whose size must not show."""
    return batch.sensors.size if isinstance(batch, Pilot) else capture.n_sensors


@dataclass(frozen=True, eq=False)
class Surface:
    """Points that may be hidden, on the device."""

    points: mi.Point3f  # [engine units]
    normals: mi.Vector3f  # what is known holds for wall points in front of these planes only
    others: mi.Vector3f  # more normals: nothing behind these planes hides the points from what lies in front of them


class VisibilityMasks:
    """Tells from where nothing can hide points of the hidden geometry, before a planar wall.

    Parameters
    ----------
    built
        The scene. Before a curved wall nothing is known.
    """

    def __init__(self, built: BuiltScene):
        self.built = built

    @functools.cached_property
    def _tree(self) -> Bvh:
        return Bvh.of(self.built.hidden_shapes)

    def set_up(self) -> None:
        """Make the tree."""
        _ = self._tree

    def pay_off(self, n_points: int) -> bool:
        """Return whether anything is known of what ``n_points`` wall points look at."""
        return self.built.wall.is_planar and n_points >= LEAST_POINTS

    def of(self, surface: Surface, wall_tiles: WallTiles, where: mi.UInt32, active: mi.Bool) -> mi.UInt64:
        """Return the bits of the tiles that each point is open to.

        Parameters
        ----------
        surface
            The points.
        wall_tiles, where
            Rectangles, and from which of them each point is seen. Where few look from, nothing is known.
        active
            The others have none.
        """
        if not self.pay_off(wall_tiles.n_points):
            return dr.zeros(mi.UInt64, dr.width(surface.points))
        active = active & (surface.points.z > 0)
        for shape in self.built.hidden_shapes:
            if not shape.is_mesh():  # a point in its box may be hidden by the shape itself, however near
                box = shape.bbox()
                active = active & ~mi.BoundingBox3f(mi.Point3f(box.min), mi.Point3f(box.max)).contains(surface.points)
        view = _View(surface, wall_tiles.tiles(where))
        clear = dr.select(active, mi.UInt64(OF_ALL) & ~_hidden_tiles(self._tree, view, active), 0)
        dr.eval(clear)
        return clear


@dr.syntax
def _hidden_tiles(tree: Bvh, view: _View, active: mi.Bool) -> mi.UInt64:
    """Return the bits of the tiles from which some triangle may hide each point."""
    hidden = mi.UInt64(0)
    node = dr.select(active, mi.UInt32(1), 0)
    while dr.hint(node > 0, exclude=[tree, view]):
        # on to the next leaf: points that walked through leaves on their own would wait for one another at each
        on_the_way = node > 0
        while dr.hint(on_the_way, exclude=[tree, view, hidden]):
            enters = (view.tiles_hidden_by_box(*tree.box(node)) & ~hidden) != 0
            is_leaf = node >= tree.n_leaves
            node = dr.select(enters, dr.select(is_leaf, node, 2 * node), tree.following(node))
            on_the_way = (node > 0) & ~(enters & is_leaf)
        # a symbolic loop: the kernel holds the test of one triangle
        index = dr.gather(mi.UInt32, tree.first, node - tree.n_leaves, node > 0)
        end = dr.select(node > 0, index + LEAF, index)
        while dr.hint(index < end, exclude=[tree, view, node, end]):
            corners, normal = tree.triangle(index)
            more = view.tiles_in_shadow(corners) & ~hidden
            if dr.hint(more != 0, exclude=[view, corners, normal]):
                hidden |= more & ~view.tiles_parted(corners[0], normal)
            index += 1
        node = dr.select(node > 0, tree.following(node), 0)
    return hidden


class _View:
    """What points see of the wall, and from which tiles what lies in between may hide them."""

    def __init__(self, surface: Surface, tiles: mi.Vector4f):
        self.points = surface.points
        self.feet = mi.Point2f(self.points.x, self.points.y)
        self.least, self.step = mi.Point2f(tiles.x, tiles.y), mi.Vector2f(tiles.z, tiles.w)
        self.rise = dr.minimum(RISE * self.points.z, MOST_RISE)
        self.normals, self.others = surface.normals, surface.others
        # tiles wholly behind the surface do not see the points: what hides these from there does not matter
        self.seen = ~self._tiles_beside(self.points, surface.normals)[1]
        self.before_others = self._tiles_beside(self.points, surface.others)[0]

    def tiles_hidden_by_box(self, low: mi.Point3f, high: mi.Point3f) -> mi.UInt64:
        """Return the bits of the tiles from which triangles in boxes may hide the points."""
        highest = [
            dr.dot(plane, dr.select(plane > 0, high, low) - self.points) for plane in (self.normals, self.others)
        ]
        is_between = (low.z < self.points.z) & (high.z > 0) & (highest[0] > self.rise)
        tiles = self._tiles_in(self._shadow_of_box(low, high))
        return dr.select(is_between, self._without_low(tiles, highest[1]), 0)

    def tiles_in_shadow(self, corners: list[mi.Point3f]) -> mi.UInt64:
        """Return the bits of the tiles from which triangles may hide the points; their own planes are not looked at."""
        ways = [corner - self.points for corner in corners]
        depths = [-way.z for way in ways]
        highest = [_most([dr.dot(plane, way) for way in ways]) for plane in (self.normals, self.others)]
        is_between = (_most(depths) > 0) & (highest[0] > self.rise)
        tiles = self._tiles_in(self._shadow_of_triangle(ways, depths))
        return dr.select(is_between, self._without_low(tiles, highest[1]), 0)

    def _without_low(self, tiles: mi.UInt64, highest: mi.Float) -> mi.UInt64:
        """Return ``tiles`` without those before the points' other planes, for what does not rise over these."""
        return dr.select(highest > self.rise, tiles, tiles & ~self.before_others)

    def _shadow_of_box(self, low: mi.Point3f, high: mi.Point3f) -> Rectangle:
        """Return the rectangle around the shadow that boxes throw on the wall, lit from the points."""
        # what is nearer to the point, or as near as can be, covers more of the wall
        nearest, farthest = (self.points.z / dr.maximum(self.points.z - z, NEARLY) for z in (high.z, low.z))
        one, other = mi.Point2f(low.x, low.y) - self.feet, mi.Point2f(high.x, high.y) - self.feet
        ends = dr.minimum(one * nearest, one * farthest), dr.maximum(other * nearest, other * farthest)
        return Rectangle(ends[0] + self.feet, ends[1] + self.feet)

    def _shadow_of_triangle(self, ways: list[mi.Vector3f], depths: list[mi.Float]) -> Rectangle:
        """Return the rectangle around the shadow of triangles; beside the points it goes on without an end."""
        least, most = mi.Point2f(dr.inf), mi.Point2f(-dr.inf)
        for k, (way, depth) in enumerate(zip(ways, depths, strict=True)):
            flat = mi.Vector2f(way.x, way.y)
            place = flat * (self.points.z / depth)
            least, most = (
                dr.select(depth > 0, dr.minimum(least, place), least),
                dr.select(depth > 0, dr.maximum(most, place), most),
            )
            # an edge that crosses the points' height throws its shadow to infinity, in the direction of the crossing
            before, other = ways[k - 1], depths[k - 1]
            crossing = flat * other - mi.Vector2f(before.x, before.y) * depth
            crossing = dr.select(other > depth, crossing, -crossing)
            crosses = (depth > 0) != (other > 0)
            least, most = (
                dr.select(crosses & (crossing <= 0), -dr.inf, least),
                dr.select(crosses & (crossing >= 0), dr.inf, most),
            )
        return Rectangle(least + self.feet, most + self.feet)

    def tiles_parted(self, corner: mi.Point3f, normal: mi.Vector3f) -> mi.UInt64:
        """Return the bits of the tiles that lie on the same side of planes as the points; of all for those in them."""
        height, (before, behind) = dr.dot(normal, self.points - corner), self._tiles_beside(corner, normal)
        partition_by_size = dr.select(height > 0, before, behind)
        # no ray crosses a plane that it begins in
        return dr.select(dr.abs(height) <= self.rise, mi.UInt64(OF_ALL), partition_by_size)

    def _tiles_beside(self, point: mi.Point3f, normal: mi.Vector3f) -> tuple[mi.UInt64, mi.UInt64]:
        """Return the bits of the tiles that lie before planes, and behind them."""
        edges = [
            [normal[axis] * (self.least[axis] + self.step[axis] * k) for k in range(TILES + 1)] for axis in range(2)
        ]
        least, most = (
            [[of(*pair) for pair in pairwise(heights)] for heights in edges] for of in (dr.minimum, dr.maximum)
        )
        base, before, behind = dr.dot(normal, point), mi.UInt64(0), mi.UInt64(0)
        for row, column in np.ndindex(TILES, TILES):
            bit = mi.UInt64(1 << row * TILES + column)
            before |= dr.select(least[0][column] + least[1][row] >= base, bit, 0)
            behind |= dr.select(most[0][column] + most[1][row] <= base, bit, 0)
        return before, behind

    def _tiles_in(self, rectangle: Rectangle) -> mi.UInt64:
        """Return the bits of the tiles that touch a rectangle."""
        least, most = ((end - self.least) / self.step for end in rectangle)
        first = dr.clip(dr.floor(least - SLACK), 0, TILES)
        last = dr.maximum(dr.clip(dr.floor(most + SLACK) + 1, 0, TILES), first)
        columns, rows = (
            _bit(mi.UInt64(last[axis]) * stride) - _bit(mi.UInt64(first[axis]) * stride)
            for axis, stride in enumerate((1, TILES))
        )
        return (columns * OF_COLUMN) & rows & self.seen


def _bit(index: mi.UInt64) -> mi.UInt64:
    """Return the bit of a number, 0 for the one after the last: differences of two are the bits in between."""
    # shifts by the whole width are not defined
    return dr.select(index < TILES**2, mi.UInt64(1) << (index & (TILES**2 - 1)), 0)


def _most(values: Sequence[T]) -> T:
    return functools.reduce(dr.maximum, values)
