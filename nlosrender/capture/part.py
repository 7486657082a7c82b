"""The part of a capture that is rendered: a range of laser points for a range of strips of the sensor grid.

The file stores the histograms of a storage tile of sensor points in one chunk. A strip is one row of a storage tile,
the smallest piece of the sensor grid that a shard can have. Strips are counted tile after tile, so that a range of them
touches as few tiles as possible. Both ranges depend on the capture alone, not on the machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from nlosrender.capture.tile import Tile
from nlosrender.errors import OptionError

Range = tuple[int, int]  # [first, last)


@dataclass(frozen=True)
class Tiling:
    """A sensor grid of ``ny`` x ``nx`` points cut into storage tiles of ``rows`` x ``columns``, smaller at its ends."""

    ny: int
    nx: int
    rows: int
    columns: int

    @property
    def n_strips(self) -> int:
        """Number of strips: every row of the grid in every column of tiles."""
        return self.ny * -(-self.nx // self.columns)

    def everything(self, n_lasers: int) -> Part:
        """Return the part that is the whole capture, with ``n_lasers`` laser points for every sensor point."""
        return Part((0, n_lasers), (0, self.n_strips))

    def tiles(self) -> Iterator[Tile]:
        """Yield the storage tiles, row by row."""
        for y0 in range(0, self.ny, self.rows):
            for x0 in range(0, self.nx, self.columns):
                yield Tile(y0, min(y0 + self.rows, self.ny), x0, min(x0 + self.columns, self.nx))

    def cells(self, strips: Range) -> Iterator[Tile]:
        """Yield the storage tiles that a range of strips touches, each cut to the strips' rows."""
        first = 0  # strip of the tile's first row
        for tile in self.tiles():
            height = tile.y1 - tile.y0
            start, stop = max(strips[0] - first, 0), min(strips[1] - first, height)
            if start < stop:
                yield Tile(tile.y0 + start, tile.y0 + stop, tile.x0, tile.x1)
            first += height


@dataclass(frozen=True)
class Part:
    """A range of laser points, counted row by row, for a range of strips; laser 0 alone unless exhaustive."""

    lasers: Range
    strips: Range

    def __str__(self) -> str:
        return f"lasers {self.lasers[0]}:{self.lasers[1]}, strips {self.strips[0]}:{self.strips[1]}"

    def share_of(self, whole: Part) -> float:
        """Return about which share of the pairs of laser and sensor points is in this part; strips differ in length."""
        n_own, n_whole = (
            (part.lasers[1] - part.lasers[0]) * (part.strips[1] - part.strips[0]) for part in (self, whole)
        )
        return n_own / n_whole

    def as_json(self) -> dict[str, object]:
        """Return the ranges as lists."""
        return {"lasers": list(self.lasers), "strips": list(self.strips)}

    @classmethod
    def from_json(cls, stored: Mapping[str, object]) -> Part:
        """Undo ``as_json``; ValueError for anything that it does not return."""
        return cls(_range(stored.get("lasers")), _range(stored.get("strips")))


@dataclass(frozen=True)
class Selection:
    """What the user asks for: everything, one of several shards, or a range of laser points."""

    shard: tuple[int, int] | None = None  # I of N, counted from 1
    lasers: Range | None = None

    def __str__(self) -> str:
        if self.shard is not None:
            return f"--shard {self.shard[0]}/{self.shard[1]}"
        return "the whole capture" if self.lasers is None else f"--lasers {self.lasers[0]}:{self.lasers[1]}"

    def part(self, n_lasers: int, tiling: Tiling) -> Part:
        """Return the part of a capture that is selected.

        Shards are ranges of laser points of nearly equal length, or of strips when there are fewer lasers than shards.

        Parameters
        ----------
        n_lasers
            Laser points that every sensor point is measured for: 1 unless the capture is exhaustive.
        tiling
            The sensor grid.

        Raises
        ------
        OptionError
            There are fewer laser points or strips than asked for.
        """
        everything = tiling.everything(n_lasers)
        if self.lasers is not None:
            first, last = self.lasers
            if not 0 <= first < last <= n_lasers:
                found = f"the laser points of this capture are 0:{n_lasers}"
                hint = "" if n_lasers > 1 else "; cut it with --shard"
                raise OptionError(f"{self}: need A < B, and {found}{hint}.")
            return Part(self.lasers, everything.strips)
        if self.shard is None:
            return everything
        number, count = self.shard
        if not 1 <= number <= count:
            raise OptionError(f"{self}: need I/N with 1 <= I <= N.")
        if count <= n_lasers:
            return Part(_shard(n_lasers, number, count), everything.strips)
        if count > tiling.n_strips:
            limit = max(n_lasers, tiling.n_strips)
            raise OptionError(f"{self}: this capture can be cut into at most {limit} shards.")
        return Part(everything.lasers, _shard(tiling.n_strips, number, count))


WHOLE = Selection()


def _shard(length: int, number: int, count: int) -> Range:
    return length * (number - 1) // count, length * number // count


def _range(stored: object) -> Range:
    if not isinstance(stored, list) or len(stored) != 2 or not all(type(bound) is int for bound in stored):
        raise ValueError(f"got {stored!r}, need a range of two integers")
    first, last = stored
    if not 0 <= first < last:
        raise ValueError(f"got {stored!r}, need a range that is not empty")
    return first, last
