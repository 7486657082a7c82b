"""Rectangles of grid points, and how a grid or a range of its points is cut into them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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


def runs(first: int, last: int, nx: int, most: int) -> Iterator[Tile]:
    """Cut the flat indices [first, last) of a grid with ``nx`` columns into tiles of at most ``most`` points.

    A tile is whole rows, or part of one row; together they keep the order of the indices.
    """
    while first < last:
        y, x = divmod(first, nx)
        points = min(most, last - first)
        rows, columns = (points // nx, nx) if x == 0 and points >= nx else (1, min(points, nx - x))
        tile = Tile(y, y + rows, x, x + columns)
        yield tile
        first += tile.size


def joined(cells: Iterable[Tile], most: int) -> list[Tile]:
    """Join neighbours among ``cells`` into tiles of at most ``most`` points; a larger cell stays as it is.

    Cells come row of cells after row of cells. Along a row they are joined first, then such rows of equal width.
    """
    rows: list[Tile] = []
    for cell in cells:
        before = rows[-1] if rows else None
        if before and (before.y0, before.y1, before.x1) == (cell.y0, cell.y1, cell.x0):
            wider = Tile(before.y0, before.y1, before.x0, cell.x1)
            if wider.size <= most:
                rows[-1] = wider
                continue
        rows.append(cell)
    blocks: list[Tile] = []
    for row in rows:
        before = blocks[-1] if blocks else None
        if before and (before.x0, before.x1, before.y1) == (row.x0, row.x1, row.y0):
            taller = Tile(before.y0, row.y1, before.x0, before.x1)
            if taller.size <= most:
                blocks[-1] = taller
                continue
        blocks.append(row)
    return blocks
