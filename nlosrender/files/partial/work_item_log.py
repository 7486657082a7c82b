"""The journal of an unfinished capture: finished work items, where their chunks lie, and whether they still do."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib

from nlosrender.capture.tile import Tile
from nlosrender.files.sums import Sums

CHECKSUM_RANGE = 2**64
READ_BYTES = 2**20  # read at a time between the chunks
WorkItemKey = tuple[Tile, Tile]  # sensors, lasers
Record = Mapping[str, Any]


@dataclass(frozen=True)
class StoredChunk:
    """Where the bytes of a chunk lie in a file."""

    dataset: str
    at: tuple[int, ...]  # where the chunk starts, in file order
    offset: int
    length: int
    checksum: int  # CRC-32 of the bytes


@dataclass(frozen=True)
class Closing:
    """What a file of samples was like when HDF5 had closed it properly."""

    size: int  # bytes
    checksum: int  # CRC-32 of everything but the chunks


@dataclass
class RenderState:
    """The finished work items of a render, and sums over them."""

    items: list[WorkItemKey] = field(default_factory=list)
    sums: Sums = field(default_factory=Sums)
    checksum: dict[str, int] = field(default_factory=dict)  # per dataset, of its chunks in whatever order
    n_bytes: int = 0  # of all chunks

    def add(self, item: WorkItemKey, chunks: Iterable[StoredChunk], sums: Sums) -> None:
        """Count one work item."""
        self.items.append(item)
        self.sums += sums
        for chunk in chunks:
            before = self.checksum.get(chunk.dataset, 0)
            self.checksum[chunk.dataset] = (before + placed_checksum(chunk.at, chunk.checksum)) % CHECKSUM_RANGE
            self.n_bytes += chunk.length


@dataclass
class JournalState:
    """The state that the records of a journal add up to."""

    first: Record = field(default_factory=dict)  # the record of how it began
    generation: int = 0  # of the file that holds the samples
    newest: int = 0  # generation that was ever begun
    closed: Closing | None = None  # that file as HDF5 has closed it; None: it has not
    finished: RenderState = field(default_factory=RenderState)
    run: Record = field(default_factory=dict)  # of ``run_record``, the newest; renders by earlier versions note none
    n_in_run: int = 0  # work items finished since

    @classmethod
    def from_records(cls, records: Iterable[Record]) -> JournalState:
        """Add up the records of a journal, oldest first.

        Raises
        ------
        ValueError
            They are not those of a render.
        """
        state = cls()
        generations: dict[int, RenderState] = {}
        try:
            for record in records:
                closed = record.get("closed")
                state.closed = Closing(*closed) if isinstance(closed, list) else None
                if "identity" in record:
                    state.first = record
                if "run" in record:
                    state.run, state.n_in_run = {**record["run"]}, 0
                if "switched_to" in record:
                    state.generation = record["switched_to"]
                if "unit" in record:
                    state.newest, state.n_in_run = max(state.newest, record["generation"]), state.n_in_run + 1
                    generations.setdefault(record["generation"], RenderState()).add(*item_of(record))
            state.newest = max(state.newest, state.generation)
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"no record of a render: {error!r}") from error
        state.finished = generations.get(state.generation, RenderState())
        return state


def closing_record(closing: Closing) -> dict[str, Any]:
    """Return the record that the file of samples is closed."""
    return {"closed": astuple(closing)}


def run_record(units: int) -> dict[str, Any]:
    """Return the record that this process begins to render what is left of ``units`` work items."""
    by = {"process": os.getpid(), "machine": socket.gethostname()}
    return {"run": {"units": units, "begun": time.time(), **by}}


def item_record(generation: int, item: WorkItemKey, chunks: Iterable[StoredChunk], sums: Sums) -> dict[str, Any]:
    """Return the record of a finished work item whose chunks lie in the file of a ``generation``."""
    return {
        "unit": [list(astuple(tile)) for tile in item],
        "generation": generation,
        "sums": sums.as_json(),
        "chunks": [list(astuple(chunk)) for chunk in chunks],
    }


def item_of(record: Record) -> tuple[WorkItemKey, list[StoredChunk], Sums]:
    """Undo ``item_record``."""
    sensors, lasers = (Tile(*corners) for corners in record["unit"])
    chunks = [StoredChunk(name, tuple(at), *rest) for name, at, *rest in record["chunks"]]
    return (sensors, lasers), chunks, Sums.from_json(record["sums"])


def items_of(
    records: Iterable[Mapping[str, Any]], generation: int
) -> Iterator[tuple[WorkItemKey, list[StoredChunk], Sums]]:
    """Yield the finished work items whose chunks lie in the file of a ``generation``."""
    for record in records:
        if record.get("generation") == generation:
            yield item_of(record)


def placed_checksum(at: tuple[int, ...], checksum: int) -> int:
    """Return a chunk's checksum mixed with its place: chunks that have changed places do not add up to the same."""
    place = 0
    for index in at:
        place = (place * 1_000_003 + index) % CHECKSUM_RANGE
    return (checksum + 1) * (2 * place + 1) % CHECKSUM_RANGE


class StoredChunks:
    """A file of samples open for reading; made by ``stored_chunks``. Its methods raise OSError from the disk.

    Chunks have a checksum each. Everything else in the file, the header and HDF5's tables, has one checksum that is
    taken when the file is closed: together they cover every byte. ISA-L computes the same CRC-32 as zlib, 8 times as
    fast.
    """

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        self.size = os.fstat(descriptor).st_size

    def content(self, chunk: StoredChunk) -> bytes | None:
        """Return the bytes of a chunk as they were written; None where the file has other ones."""
        if chunk.offset < 0 or not 0 <= chunk.length <= self.size - chunk.offset:
            return None
        content = os.pread(self._descriptor, chunk.length, chunk.offset)
        return content if isal_zlib.crc32(content) == chunk.checksum else None

    def has(self, chunks: Iterable[StoredChunk]) -> bool:
        """Return whether all of these chunks are as they were written."""
        return all(self.content(chunk) is not None for chunk in chunks)

    def closing(self, chunks: Iterable[StoredChunk]) -> Closing:
        """Return what tells whether anything but ``chunks`` has changed since: size, and checksum of the rest."""
        checksum = 0
        for start, stop in self._gaps(chunks):
            for position in range(start, stop, READ_BYTES):
                content = os.pread(self._descriptor, min(READ_BYTES, stop - position), position)
                checksum = isal_zlib.crc32(content, checksum)
        return Closing(self.size, checksum)

    def _gaps(self, chunks: Iterable[StoredChunk]) -> Iterator[tuple[int, int]]:
        """Yield (start, stop) of the ranges between the chunks."""
        # two numbers for each: there may be millions
        ranges = np.fromiter(((chunk.offset, chunk.length) for chunk in chunks), np.dtype((np.int64, 2)))
        end = 0
        for start, length in ranges[np.argsort(ranges[:, 0])]:
            if start > end:
                yield end, int(start)
            end = max(end, int(start + length))
        if end < self.size:
            yield end, self.size


@contextmanager
def stored_chunks(path: Path) -> Iterator[StoredChunks]:
    """Open a file of samples for reading; OSError where there is none, or a symbolic link."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        yield StoredChunks(descriptor)
    finally:
        os.close(descriptor)
