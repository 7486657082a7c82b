"""Reads shard files, rejects those of other captures, and checks that they tile the capture exactly once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from nlosrender.capture.part import Part, Range, Tiling
from nlosrender.capture.tile import joined
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import json_object
from nlosrender.files.identity import PACKAGES, comparable_config, differences, listed
from nlosrender.files.partial.work_item_log import RenderState
from nlosrender.files.reading.reader import open_capture
from nlosrender.files.reading.stored_header import StoredHeader
from nlosrender.files.sums import Sums

PART, SUMS, CHECKSUMS, NOTE = "part", "part_sums", "part_checksums", "incomplete"
MAX_PROBLEMS = 8  # in one message
SAME = ("capture_hash", "variant", "replicas", "nlosrender_format_version")  # attributes that have to agree


@dataclass(frozen=True)
class StoredPart:
    """Which part of a capture a file holds, its sums and checksums."""

    part: Part
    sums: Sums
    checksum: Mapping[str, int]  # per dataset

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, object]) -> StoredPart | None:
        """Read it; None for a file that does not say that it is a part.

        Raises
        ------
        ValueError
            The attributes are damaged.
        """
        if PART not in attributes:
            return None
        try:
            part, sums, checksum = (json.loads(str(attributes[name])) for name in (PART, SUMS, CHECKSUMS))
            return cls(Part.from_json(part), Sums.from_json(sums), {str(k): int(v) for k, v in checksum.items()})
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"the attributes {PART}, {SUMS}, {CHECKSUMS} are damaged: {error!r}") from error


def part_attributes(part: Part, tiling: Tiling, finished: RenderState) -> dict[str, object]:
    """Return the attributes of a file that holds a part of a capture."""
    tiles = joined(tiling.cells(part.strips), tiling.ny * tiling.nx)
    shown: dict[str, Any] = part.as_json() | {"sensor_tiles": [list(astuple(tile)) for tile in tiles]}
    return {
        PART: json.dumps(shown),
        SUMS: json.dumps(finished.sums.as_json()),
        CHECKSUMS: json.dumps(finished.checksum),
        NOTE: "a part of a capture: laser points [first, last) counted row by row, and sensor tiles "
        "[y0, y1, x0, x1) as in the attribute part; everything else is zero. nlosrender merge puts parts together",
    }


@dataclass(frozen=True)
class Shard:
    """A file that holds a part of a capture."""

    path: Path
    header: StoredHeader
    stored: StoredPart

    def __str__(self) -> str:
        return f"{self.path} ({self.stored.part})"

    @property
    def part(self) -> Part:
        """What it holds."""
        return self.stored.part

    @property
    def tiling(self) -> Tiling:
        """The sensor grid cut into storage tiles."""
        chunks = dict(zip(layout.file_axes(self.header.confocal), self.header.chunks or (), strict=True))
        return Tiling(*self.header.sensor_grid, chunks["sensor_y"], chunks["sensor_x"])

    @property
    def n_lasers(self) -> int:
        """Laser points that every sensor point is measured for."""
        return self.header.sizes["laser_y"] * self.header.sizes["laser_x"]


def read_shards(paths: Sequence[Path]) -> list[Shard]:
    """Read what files say about the parts they hold, and make sure that together they are one capture.

    Returns
    -------
    list
        In the order of their laser points and strips.

    Raises
    ------
    FileError
        A file is damaged, holds no part or one of another capture, or parts overlap or are missing; all of it at once.
    """
    shards, problems = [], []
    for path in paths:
        try:
            shards.append(_read(path))
        except FileError as error:
            problems.append(str(error))
    if shards:
        problems += [f"{other.path}: {text}" for other in shards[1:] for text in _strangeness(shards[0], other)]
        if not problems:
            problems += _misfits(shards)
    if problems:
        more = [f"and {len(problems) - MAX_PROBLEMS} more"] if len(problems) > MAX_PROBLEMS else []
        raise FileError("\n".join(problems[:MAX_PROBLEMS] + more))
    return sorted(shards, key=lambda shard: (shard.part.lasers, shard.part.strips))


def _read(path: Path) -> Shard:
    with open_capture(path) as capture:
        header = capture.header
    try:
        stored = StoredPart.from_attributes(header.attributes)
    except ValueError as error:
        raise FileError(f"{path}: is damaged: {error}. Render it again.") from error
    if stored is None:
        raise FileError(f"{path}: is no part of a capture. Parts are rendered with --shard I/N or --lasers A:B.")
    if header.chunks is None:
        raise FileError(f"{path}: is damaged: its samples are not in chunks. Render it again.")
    shard = Shard(path, header, stored)
    if stored.part.lasers[1] > shard.n_lasers or stored.part.strips[1] > shard.tiling.n_strips:
        raise FileError(f"{path}: is damaged: it claims to hold {stored.part}, more than there is. Render it again.")
    return shard


def _strangeness(first: Shard, other: Shard) -> Iterator[str]:
    """Yield in what a shard differs from the first one so that they cannot be of one capture."""
    ours, theirs = first.header.attributes, other.header.attributes
    found = [(name, ours.get(name), theirs.get(name)) for name in SAME if ours.get(name) != theirs.get(name)]
    here, there = (json_object(attributes.get("versions")) for attributes in (ours, theirs))
    found += [(name, here.get(name), there.get(name)) for name in PACKAGES if here.get(name) != there.get(name)]
    for name in ("data_shape", "chunks", "compression", "has_variance"):
        a, b = getattr(first.header, name), getattr(other.header, name)
        if a != b:
            found.append((name, a, b))
    if not found:
        return
    differing = list(differences(_config(theirs), _config(ours)))
    if differing:
        texts = [f"{key}: {b}, there {a}" for key, b, a in differing]
        yield f"belongs to another capture than {first.path} ({listed(texts)})"
        return
    if [name for name, _, _ in found] == ["capture_hash"]:
        yield f"belongs to another capture than {first.path} (a mesh or texture that both name has changed)"
        return
    texts = [f"{name}: {b}, there {a}" for name, a, b in found if name != "capture_hash"]
    yield f"was rendered otherwise than {first.path} ({listed(texts)})"


def _misfits(shards: Sequence[Shard]) -> Iterator[str]:
    """Yield the overlaps and gaps of shards of one capture."""
    n_lasers, n_strips = shards[0].n_lasers, shards[0].tiling.n_strips
    owner = np.full((n_lasers, n_strips), -1, dtype=np.int32)
    for index, shard in enumerate(shards):
        (l0, l1), (s0, s1) = shard.part.lasers, shard.part.strips
        there = owner[l0:l1, s0:s1]
        for earlier in np.unique(there[there >= 0]):
            common = np.argwhere(there == earlier)
            (l_min, s_min), (l_max, s_max) = common.min(axis=0), common.max(axis=0)
            both = Part((l0 + int(l_min), l0 + int(l_max) + 1), (s0 + int(s_min), s0 + int(s_max) + 1))
            yield f"{shard} overlaps {shards[earlier]} in {_named(both, n_strips)}"
        owner[l0:l1, s0:s1] = index
    for gap in _gaps(owner < 0):
        yield f"missing: {_named(gap, n_strips)} (of {n_lasers} lasers and {n_strips} strips); no file holds it"


def _named(part: Part, n_strips: int) -> str:
    return f"lasers {part.lasers[0]}:{part.lasers[1]}" if part.strips == (0, n_strips) else str(part)


def _gaps(missing: np.ndarray) -> Iterator[Part]:
    """Yield rectangles that make up a mask (laser, strip)."""
    for ranges, group in groupby(enumerate(missing), key=lambda row: tuple(_true_ranges(row[1]))):
        lasers = [index for index, _ in group]
        for strips in ranges:
            yield Part((lasers[0], lasers[-1] + 1), strips)


def _true_ranges(mask: np.ndarray) -> Iterator[Range]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        yield int(start), int(stop)


def _config(attributes: Mapping[str, object]) -> dict[str, object]:
    return comparable_config(json_object(attributes.get("config")))
