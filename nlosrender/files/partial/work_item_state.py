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
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.passes import SavedStages, Snapshot
from nlosrender.files.partial.journal import line_of, record_of
from nlosrender.files.partial.work_item_log import WorkItemKey

PREFIX, NEW = "unit.", ".new"
MAX_HEADER_BYTES = 2**24  # bytes


def state_path(folder: Path, item: WorkItemKey) -> Path:
    """Return the file of a work item."""
    corners = [f"{tile.y0}-{tile.y1}x{tile.x0}-{tile.x1}" for tile in item]
    return folder / f"{PREFIX}{'.'.join(corners)}"


def has_states(folder: Path) -> bool:
    """Return whether there is a file of a work item in flight."""
    return any(not path.name.endswith(NEW) for path in folder.glob(f"{PREFIX}*"))


def write_state(path: Path, tag: str, kept: SavedStages) -> None:
    """Write a state, instead of an earlier one.

    Parameters
    ----------
    path
        Its file.
    tag
        What a reader has to know of the render.
    kept
        The state, by stage.

    Raises
    ------
    OSError
        The disk is full, or gone; the earlier state is untouched.
    """
    stages, contents = [], []
    for stage, snapshot in kept.items():
        arrays = []
        for name, values in snapshot.arrays.items():
            content = np.ascontiguousarray(values)
            contents.append(content)
            arrays.append([name, content.dtype.str, list(content.shape), zlib.crc32(_bytes_of(content))])
        stages.append([stage, arrays, dict(snapshot.numbers)])
    new = path.with_name(path.name + NEW)
    new.unlink(missing_ok=True)
    try:
        # exclusive: nothing that lies there, a link say, is written through
        with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as stream:
            stream.write(line_of({"tag": tag, "stages": stages}))
            for content in contents:
                stream.write(_bytes_of(content))
        new.replace(path)
    except BaseException:
        with suppress(OSError):
            new.unlink()
        raise


def read_state(path: Path, tag: str) -> SavedStages | None:
    """Return a state that belongs to the render of ``tag``; None where there is none that is whole."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW), "rb") as stream:
            record = record_of(stream.readline(MAX_HEADER_BYTES))
            if record is None or record.get("tag") != tag:
                return None
            return {
                stage: Snapshot({name: _array(stream, *layout) for name, *layout in arrays}, numbers)
                for stage, arrays, numbers in record["stages"]
            }
    except (OSError, ValueError):
        return None


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
