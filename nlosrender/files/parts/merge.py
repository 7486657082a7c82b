"""Puts the parts of a capture together, chunk by chunk: memory does not grow with the capture."""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.part import WHOLE
from nlosrender.capture.tile import Tile
from nlosrender.config.canonical import tree_hash
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.atomic_write import check_writable, explained_write, replacing
from nlosrender.files.attributes import json_object, set_attributes, text_list
from nlosrender.files.capture_results import (
    OMITTED,
    UNKNOWN_FROM,
    UNSAMPLED,
    WARNINGS,
    ZERO,
    CaptureResults,
    SummedCapture,
)
from nlosrender.files.file_kinds import CAPTURE, FileKind, same_capture
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.identity import SELECTION
from nlosrender.files.partial.work_item_log import CHECKSUM_RANGE, placed_checksum
from nlosrender.files.parts.shards import CHECKSUMS, NOTE, PART, SUMS, Shard, read_shards
from nlosrender.files.reading.reader import explained_read, open_hdf5
from nlosrender.files.sums import Sums
from nlosrender.interruption import uninterrupted

Progress = Callable[[float], None]


@dataclass(frozen=True, kw_only=True)
class MergeReport(CaptureResults):
    """What was put together."""

    output: Path
    parts: int


def merge_captures(
    paths: Sequence[str | Path],
    output: str | Path,
    progress: Progress = lambda share: None,
    warn: Callable[[str], None] = lambda text: None,
    *,
    overwrite: bool = False,
) -> MergeReport:
    """Put the parts of a capture together; ``data`` is bit for bit what one render of the whole would have given.

    Parameters
    ----------
    paths
        Files rendered with ``--shard`` or ``--lasers``, in any order.
    output
        File to write; it appears when it is complete.
    progress, warn
        Called with the share of the work done, and with warnings.
    overwrite
        Whether a file that holds another capture, or a part, may be replaced.

    Raises
    ------
    FileError
        A part is damaged, of another capture, overlaps another one or is missing; or the output cannot be written.
    """
    output = Path(output)
    check_writable(output, CAPTURE, paths)
    shards = read_shards([Path(path) for path in paths])
    summed = _summed(shards)
    with replacing(output, CAPTURE if overwrite else _whole(shards[0]), paths) as partial:
        with uninterrupted():
            shutil.copyfile(shards[0].path, partial)  # its samples included
        with HDF5Writer(partial, reopen=True) as writer:
            for number, shard in enumerate(shards):
                _copy(shard, None if number == 0 else writer, output)
                progress((number + 1) / len(shards))
            with writer.writing():
                for name in (PART, SUMS, CHECKSUMS, NOTE, ZERO, SELECTION):
                    writer.file.attrs.pop(name, None)
                set_attributes(writer.file, _attributes(shards, summed, output))
            if json_object(shards[0].header.attributes.get("config")).get("sensor"):
                from nlosrender.files.measured import add_counts  # SciPy takes time to import

                with explained_write(output):
                    counted = add_counts(writer, output, warn=warn)
                    with writer.writing():
                        set_attributes(writer.file, counted)
    return MergeReport(output=output, parts=len(shards), **summed.results())


def _whole(shard: Shard) -> FileKind:
    """Return the kind of files that hold the capture that a shard is a part of."""
    attributes = shard.header.attributes
    return same_capture(str(attributes.get("capture_hash")), str(WHOLE), json_object(attributes.get("config")))


def _copy(shard: Shard, writer: HDF5Writer | None, output: Path) -> None:
    """Copy a shard's chunks into ``output``, or without a writer only check them; FileError: they are damaged."""
    header, tiling, (first, last) = shard.header, shard.tiling, shard.part.lasers
    cells = {(cell.y0 // tiling.rows * tiling.rows, cell.x0): cell for cell in tiling.cells(shard.part.strips)}
    whole = set(tiling.tiles())
    axes = layout.file_axes(header.confocal)
    with open_hdf5(shard.path) as file, explained_read(shard.path):
        for name in layout.sample_names(header.has_variance):
            samples: h5py.Dataset = file[name]
            chunks: list[tuple[int, ...]] = []
            # in one pass: asking for each chunk takes time that grows with their number squared
            samples.id.chunk_iter(lambda chunk, chunks=chunks: chunks.append(chunk.chunk_offset))
            checksum = 0
            for chunk in chunks:
                at = dict(zip(axes, chunk, strict=True))
                cell = cells.get((at["sensor_y"], at["sensor_x"]))
                laser = at.get("laser_y", 0) * header.sizes["laser_x"] + at.get("laser_x", 0)
                if cell is None or not first <= laser < last or at["bounce"] not in header.bounce_indices:
                    raise _damaged(shard, name)
                _, content = samples.id.read_direct_chunk(chunk)
                checksum += placed_checksum(chunk, zlib.crc32(content))
                if writer is None:
                    continue
                target: h5py.Dataset = writer.file[name]
                if cell in whole:
                    with explained_write(output):
                        writer.put_chunk(target, chunk, content)
                else:  # the rest of this chunk is another shard's
                    where = _selection(shard, cell, chunk)
                    light = np.asarray(samples[where], dtype=np.float32)
                    with explained_write(output):
                        writer.fill(target, where, light)
            if checksum % CHECKSUM_RANGE != shard.stored.checksum.get(name, 0):
                raise _damaged(shard, name)


def _damaged(shard: Shard, name: str) -> FileError:
    return FileError(f"{shard}: is damaged: its {name} is not what was rendered. Copy it again, or render it again.")


def _selection(shard: Shard, cell: Tile, chunk: tuple[int, ...]) -> tuple[slice, ...]:
    """Return what a shard has of a chunk, as a selection of the dataset."""
    header = shard.header
    axes, steps, shape = layout.file_axes(header.confocal), header.chunks or (), header.data_shape
    inside = {
        axis: slice(start, min(start + step, length))
        for axis, start, step, length in zip(axes, chunk, steps, shape, strict=True)
    }
    rows = {"sensor_y": slice(cell.y0, cell.y1), "sensor_x": slice(cell.x0, cell.x1)}
    return layout.in_file_order(inside | rows, header.confocal)


def _attributes(shards: Sequence[Shard], summed: SummedCapture, output: Path) -> dict[str, object]:
    """Return the attributes of the whole that its first part does not have."""
    attributes = shards[0].header.attributes
    seconds: dict[str, float] = {}
    for shard in shards:
        for stage, spent in json_object(shard.header.attributes.get("seconds")).items():
            seconds[stage] = seconds.get(stage, 0.0) + float(spent)
    changed: dict[str, object] = {"created": datetime.now(UTC).isoformat(timespec="seconds")}
    config = json_object(attributes.get("config"))
    if isinstance(config.get("output"), dict):
        config["output"]["path"] = str(output)
        changed |= {"config": json.dumps(config, ensure_ascii=False), "config_hash": tree_hash(config)}
    changed |= {name: list(_texts(shards, name)) for name in (OMITTED, WARNINGS) if name in attributes}
    return changed | summed.attributes(seconds)


def _texts(shards: Sequence[Shard], name: str) -> tuple[str, ...]:
    """Return the texts in a list that every shard has, each once."""
    return tuple(dict.fromkeys(text for shard in shards for text in text_list(shard.header.attributes, name)))


def _summed(shards: Sequence[Shard]) -> SummedCapture:
    """Return the sums over all shards, and what any of them misses."""
    attributes = [shard.header.attributes for shard in shards]
    limit, sums = attributes[0].get("max_bounces"), sum((shard.stored.sums for shard in shards), Sums())
    bounces = BounceAxis(
        limit if isinstance(limit, int) else None,
        bool(attributes[0].get("split_bounces")),
        shards[0].header.first_bounce,
    )
    unsampled, zero = _texts(shards, UNSAMPLED), _texts(shards, ZERO)
    unknown = [bounce for each in attributes if isinstance(bounce := each.get(UNKNOWN_FROM), int)]
    return SummedCapture(sums, bounces, unsampled, () if sums.squares else zero, min(unknown, default=None))
