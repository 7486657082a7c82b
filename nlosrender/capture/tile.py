"""Rectangles of grid points, and how a grid or a range of its points is cut into them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Tile:
    """A rectangle of grid points: rows [y0, y1), columns [x0, x1)."""

    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def size(self) -> int:
        """Number of points."""
        return (self.y1 - self.y0) * (self.x1 - self.x0)

    def flat_indices(self, nx: int) -> list[int]:
        """Return the points' indices in a row-major grid with ``nx`` columns."""
        return [y * nx + x for y in range(self.y0, self.y1) for x in range(self.x0, self.x1)]

    def contains(self, other: Tile) -> bool:
        """Return whether every point of ``other`` is one of this tile's."""
        rows = self.y0 <= other.y0 and other.y1 <= self.y1
        return rows and self.x0 <= other.x0 and other.x1 <= self.x1

    def overlaps(self, other: Tile) -> bool:
        """Return whether the two have a point in common."""
        rows = self.y0 < other.y1 and other.y0 < self.y1
        return rows and self.x0 < other.x1 and other.x0 < self.x1


def runs(first: int, last: int, nx: int, max_points: int) -> Iterator[Tile]:
    """Cut the flat indices [first, last) of a grid with ``nx`` columns into tiles of at most ``max_points``.

    A tile is whole rows, or part of one row; together they keep the order of the indices.
    """
    while first < last:
        y, x = divmod(first, nx)
        points = min(max_points, last - first)
        rows, columns = (points // nx, nx) if x == 0 and points >= nx else (1, min(points, nx - x))
        yield Tile(y, y + rows, x, x + columns)
        first += rows * columns


def joined(cells: Iterable[Tile], max_points: int) -> list[Tile]:
    """Join neighbours among ``cells`` into tiles of at most ``max_points``; a larger cell stays as it is.

    Cells come row of cells after row of cells. They are joined along a row first, then such rows of equal width.
    """
    rows = _merged(cells, max_points, lambda a, b: (a.y0, a.y1, a.x1) == (b.y0, b.y1, b.x0))
    return _merged(rows, max_points, lambda a, b: (a.x0, a.x1, a.y1) == (b.x0, b.x1, b.y0))


def _merged(tiles: Iterable[Tile], max_points: int, adjoin: Callable[[Tile, Tile], bool]) -> list[Tile]:
    merged: list[Tile] = []
    for tile in tiles:
        if merged and adjoin(merged[-1], tile) and merged[-1].size + tile.size <= max_points:
            first = merged.pop()
            tile = Tile(first.y0, tile.y1, first.x0, tile.x1)
        merged.append(tile)
    return merged
