"""Render synthetic samples work item by work item into resumable files, without a renderer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.part import WHOLE, Part, Selection, Tiling
from nlosrender.capture.tile import Tile, runs
from nlosrender.files import layout
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.capture_results import SummedCapture
from nlosrender.files.identity import identity_attributes
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.parts.shards import part_attributes
from nlosrender.files.provenance import provenance_attributes
from nlosrender.files.sums import Sums, sums_of
from nlosrender.files.validation import check_file

Array = NDArray[np.float64]
BOUNCES = BounceAxis(3, True)  # of the headers in tests/files/conftest.py
CONFIG: Mapping[str, Any] = {"name": "synthetic", "render": {"spp": 8, "memory_limit": "1GB"}, "output": {"path": "x"}}


class Stopped(Exception):
    """The render was told to stop half-way."""


def tiling_of(header: CaptureHeader) -> Tiling:
    """The sensor grid of a capture cut into storage tiles."""
    chunks = dict(zip(layout.file_axes(header.confocal), header.chunks, strict=True))
    rows, columns = header.sensor_positions.shape[:2]
    return Tiling(rows, columns, chunks["sensor_y"], chunks["sensor_x"])


def part_of(header: CaptureHeader, selection: Selection) -> Part:
    """The part that is selected."""
    return selection.part(header.sizes["laser_y"] * header.sizes["laser_x"], tiling_of(header))


def items_of(header: CaptureHeader, part: Part) -> Iterator[tuple[Tile, Tile]]:
    """Storage tiles with one laser each: (sensors, lasers)."""
    for cell in tiling_of(header).cells(part.strips):
        for laser in runs(*part.lasers, header.sizes["laser_x"], 1):
            yield cell, cell if header.confocal else laser


def sums_of_unit(block: Array, variance: Array) -> Sums:
    """Sums over samples (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin)."""
    channels, slots, *points, bins = block.shape
    flat = (channels, slots, points[0] * points[1], points[2] * points[3], bins)
    mean = block.reshape(flat).astype(np.float64)
    return sums_of(mean, variance.reshape(flat).astype(np.float64), mean[..., 0], samples=8, seconds=0.5)


def write_part(
    path: Path,
    header: CaptureHeader,
    block: Array,
    selection: Selection = WHOLE,
    *,
    stop_after: int | None = None,
    resume: bool | None = None,
    config: Mapping[str, Any] = CONFIG,
    compression: str = "gzip",
) -> int:
    """Write ``block`` and its square as variance, work item by work item; return how many earlier runs had finished.

    ``stop_after`` work items ``Stopped`` is raised, as an error in a renderer would be.
    """
    part, tiling = part_of(header, selection), tiling_of(header)
    identity = {"config": dict(config), "variant": "none", "replicas": 2, "part": str(selection)}
    variance = block**2
    with PartialCapture.claim(path, identity, resume) as partial:
        provenance = provenance_attributes(config, "hash") | identity_attributes(identity)
        partial.open(header, provenance, compression, store_variance=True)
        earlier = list(partial.finished.items)
        left = [item for item in items_of(header, part) if item not in earlier]
        for number, (sensors, lasers) in enumerate(left):
            if number == stop_after:
                raise Stopped
            laser = (slice(0, 1), slice(0, 1))
            if not header.confocal:
                laser = (slice(lasers.y0, lasers.y1), slice(lasers.x0, lasers.x1))
            inside = np.s_[:, :, *laser, sensors.y0 : sensors.y1, sensors.x0 : sensors.x1]
            corner = ((laser[0].start, laser[1].start), (sensors.y0, sensors.x0))
            samples = {layout.DATA: block[inside], layout.VARIANCE: variance[inside]}
            chunks = partial.chunker.pack(samples, *corner)
            partial.store((sensors, lasers), chunks, sums_of_unit(block[inside], variance[inside]))
        results = SummedCapture(partial.finished.sums, BOUNCES).attributes({"render": 0.5})
        if selection != WHOLE:
            results |= part_attributes(part, tiling, partial.finished)
        partial.publish(results)
    return len(earlier)


def write_capture(
    path: Path,
    header: CaptureHeader,
    block: Array | None = None,
    variance: Array | None = None,
    attributes: Mapping[str, object] | None = None,
    compression: str = "gzip",
) -> Path:
    """Write samples (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin), or none, over an earlier capture."""
    samples = {
        name: values for name, values in ((layout.DATA, block), (layout.VARIANCE, variance)) if values is not None
    }
    rows, columns = header.sensor_positions.shape[:2]
    everything = Tile(0, rows, 0, columns), Tile(0, header.sizes["laser_y"], 0, header.sizes["laser_x"])
    with PartialCapture.claim(path, {}, resume=False) as partial:
        partial.open(header, attributes or {}, compression, store_variance=variance is not None)
        partial.store(everything, partial.chunker.pack(samples, (0, 0), (0, 0)), Sums())
        partial.publish({})
    return path


def validate_file(path: str | Path) -> list[str]:
    """Every way in which a file deviates from the layout; an empty list for a flawless one."""
    check = check_file(path)
    return [*check.violations, *check.deviations]
