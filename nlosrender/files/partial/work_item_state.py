"""State of the work item in flight: a file in the folder of an unfinished capture until the item is finished.

One line as in the journal (CRC-32, JSON) names the arrays and their checksums; their bytes follow. A file is written
under another name and renamed, so that a process may be killed at any byte. What does not verify, or belongs to
another render, means nothing: the work item begins anew.
"""

from __future__ import annotations

import math
import os
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.passes import SavedStages, Snapshot
from nlosrender.files.partial.journal import line_of, record_of
from nlosrender.files.partial.work_item_log import WorkItemKey

PREFIX, NEW = "unit.", ".new"
STATE_FORMAT = 3  # part of the tag: states of other arrays are not read; 2: phase, position, block, 3: sums in pairs
MAX_HEADER_BYTES = 2**24


@dataclass(frozen=True)
class ItemState:
    """State of one work item on the disk, if there is one.

    Parameters
    ----------
    path
        Its file.
    tag
        What a reader has to know of the render.
    """

    path: Path
    tag: str

    @classmethod
    def of(cls, folder: Path, item: WorkItemKey, tag: str = "") -> ItemState:
        """Return the state of an item in the folder of an unfinished capture."""
        corners = [f"{tile.y0}-{tile.y1}x{tile.x0}-{tile.x1}" for tile in item]
        return cls(folder / f"{PREFIX}{'.'.join(corners)}", tag)

    def write(self, stages: SavedStages) -> None:
        """Write a state, instead of an earlier one, which OSError leaves as it was."""
        header, contents = [], []
        for stage, snapshot in stages.items():
            arrays = []
            for name, values in snapshot.arrays.items():
                content = np.ascontiguousarray(values)
                contents.append(content)
                arrays.append([name, content.dtype.str, list(content.shape), zlib.crc32(_bytes_of(content))])
            header.append([stage, arrays, dict(snapshot.numbers)])
        new = self.path.with_name(self.path.name + NEW)
        new.unlink(missing_ok=True)
        try:
            with new.open("xb") as stream:  # exclusive: never writes through a link that lies there
                stream.write(line_of({"tag": self.tag, "stages": header}))
                for content in contents:
                    stream.write(_bytes_of(content))
            new.replace(self.path)
        except BaseException:
            with suppress(OSError):
                new.unlink()
            raise

    def read(self) -> SavedStages | None:
        """Return a state of the same tag; None where there is none that is whole."""
        try:
            with os.fdopen(os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as stream:
                record = record_of(stream.readline(MAX_HEADER_BYTES))
                if record is None or record.get("tag") != self.tag:
                    return None
                return {
                    stage: Snapshot({name: _array(stream, *layout) for name, *layout in arrays}, numbers)
                    for stage, arrays, numbers in record["stages"]
                }
        except (OSError, ValueError):
            return None


def states_in(folder: Path) -> list[Path]:
    """Return the files of work items in flight, complete or not."""
    return list(folder.glob(f"{PREFIX}*"))


def _array(stream: BinaryIO, dtype: str, shape: list[int], checksum: int) -> NDArray[Any]:
    kind, left = np.dtype(dtype), os.fstat(stream.fileno()).st_size - stream.tell()
    if kind.hasobject or kind.itemsize * math.prod(shape) > left:
        raise ValueError("damaged")
    values = np.empty(shape, kind)
    if stream.readinto(_bytes_of(values)) != values.nbytes or zlib.crc32(_bytes_of(values)) != checksum:  # type: ignore[attr-defined]
        raise ValueError("damaged")
    return values


def _bytes_of(values: NDArray[Any]) -> memoryview:
    return values.reshape(-1).view(np.uint8).data
