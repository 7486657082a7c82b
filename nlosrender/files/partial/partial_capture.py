"""A capture that is being rendered, on disk: every finished work item survives whatever happens to the process.

A folder ``.NAME.partial`` beside the output holds the samples, an HDF5 file, and a journal. HDF5 does not survive a
kill, its tables being in memory until it is closed, so nothing is read from them. The journal says for each finished
work item where the bytes of its chunks lie and what their checksums are; those bytes are written once, before the
journal's record, and never moved. From them a new HDF5 file is built when the earlier one was not closed properly.
Work items are not fsynced: after a power failure a record may be there and its bytes not, or torn. So a resumed render
reads the file first: a work item whose bytes fail their checksums is rendered again, and a closed file is opened again
only when its other bytes have not changed either.
"""

from __future__ import annotations

import os
import shutil
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from nlosrender.config.canonical import tree_hash
from nlosrender.engine.launch.passes import SavedStages
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import check_writable, explained_write, publish, synchronise
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.chunking import Chunker, PackedChunk
from nlosrender.files.file_kinds import CAPTURE, FileKind, same_capture
from nlosrender.files.header_writer import root_attributes
from nlosrender.files.identity import differences
from nlosrender.files.partial.journal import Journal
from nlosrender.files.partial.partial_folder import claimed_journal
from nlosrender.files.partial.stored_chunks import StoredChunks, stored_chunks
from nlosrender.files.partial.work_item_log import (
    JournalState,
    RenderState,
    StoredChunk,
    WorkItemKey,
    closing_record,
    item_record,
    items_of,
)
from nlosrender.files.partial.work_item_state import PREFIX, has_states, read_state, state_path, write_state
from nlosrender.files.sink import CaptureSink, new_capture, sample_names
from nlosrender.files.sums import Sums
from nlosrender.interruption import uninterrupted

MAX_DIFFERENCES = 6  # that are listed


class PartialCapture:
    """The unfinished render of one output; made by ``claim``, a context manager.

    Leaving the block releases the output. What was finished but not published is kept, so that the same render can go
    on, and so is the state of a work item in flight, in a file of its own; where there is neither, nothing is left.
    """

    def __init__(self, path: Path, target: Path, journal: Journal):
        self.path, self.target, self.folder = path, target, journal.path.parent
        self.damage: list[str] = []  # what of the earlier render was damaged and is rendered again, in sentences
        self._journal = journal
        self._state = self._read_journal()
        self._identity: dict[str, Any] = {}
        self._replaces_others = False
        self._sink: CaptureSink | None = None
        self._chunker: Chunker | None = None

    @property
    def tally(self) -> RenderState:
        """What is finished so far, by earlier runs and this one."""
        return self._state.tally

    @property
    def sink(self) -> CaptureSink:
        """The open file.

        Raises
        ------
        ValueError
            It is not open.
        """
        if self._sink is None:
            raise ValueError(f"{self.path}: is not open")
        return self._sink

    @property
    def chunker(self) -> Chunker:
        """What makes chunks of the open file.

        Raises
        ------
        ValueError
            It is not open.
        """
        if self._chunker is None:
            raise ValueError(f"{self.path}: is not open")
        return self._chunker

    @classmethod
    def claim(cls, path: str | Path, identity: Mapping[str, Any], resume: bool | None = None) -> PartialCapture:
        """Reserve an output, and find what there is of it.

        Parameters
        ----------
        path
            The output.
        identity
            What has to agree with an earlier render for this one to go on with it; plain JSON values.
        resume
            True: there has to be something to go on with. False: what there is is thrown away, and another capture
            that is finished may be replaced. None: go on if there is something.

        Raises
        ------
        FileError
            The output cannot be written, another process is writing it, there is nothing to resume, or what there is
            belongs to another render; or the output exists and is another capture, or none.
        """
        path = Path(path)
        target = check_writable(path, CAPTURE)
        partial = cls(path, target, claimed_journal(path, target))
        try:
            partial._begin(dict(identity), resume)
        except BaseException:
            partial._leave()
            raise
        return partial

    def open(
        self, header: CaptureHeader, attributes: Mapping[str, object], compression: str, store_variance: bool
    ) -> None:
        """Open the samples' file: a new one, or what the earlier render has left.

        Parameters
        ----------
        header, attributes, compression, store_variance
            As for ``CaptureWriter``.

        Raises
        ------
        FileError
            The disk refuses.
        """
        self._chunker = Chunker(header, compression)

        def create() -> CaptureSink:
            sink = new_capture(self._samples(), self.path, header, compression, store_variance)
            try:
                sink.set_attributes(attributes)
            except BaseException:
                sink.abandon()
                raise
            return sink

        if self.tally.items and self._state.closed and self._is_whole():
            # on the disk before HDF5 changes its tables: a closed file's are believed
            self._note({"opened": True}, durable=True)
            names = sample_names(store_variance)
            self._sink = CaptureSink(self._samples(), self.path, names, reserved=root_attributes(header))
            return
        if not self.tally.items:
            self._note(
                {
                    "identity": self._identity,
                    "overwrite": self._replaces_others,
                    "process": os.getpid(),
                    "machine": socket.gethostname(),
                }
            )
            with explained_write(self.path):  # without a finished work item it means nothing
                self._samples().unlink(missing_ok=True)
            self._sink = create()
            return
        self._rebuild(create)

    def store(self, item: WorkItemKey, chunks: Iterable[PackedChunk], sums: Sums) -> tuple[float, float]:
        """Write a work item and note that it is finished.

        Parameters
        ----------
        item
            Its sensors and lasers.
        chunks
            Its chunks; dark ones are left out.
        sums
            What is summed over the work item.

        Returns
        -------
        tuple
            Seconds spent on making the chunks, and on writing them.

        Raises
        ------
        RenderError
            From ``chunks``: a sample is not finite.
        FileError
            The disk refuses.
        """
        stored: list[StoredChunk] = []
        begun = time.perf_counter()
        writing = 0.0
        for chunk in chunks:
            packed = time.perf_counter()
            stored.append(self.sink.put(chunk))
            writing += time.perf_counter() - packed
        self._note(item_record(self._state.generation, item, stored, sums))
        self.tally.add(item, stored, sums)
        with suppress(OSError):
            state_path(self.folder, item).unlink(missing_ok=True)
        return time.perf_counter() - begun - writing, writing

    @property
    def has_states(self) -> bool:
        """Whether there is a state of a work item in flight."""
        return has_states(self.folder)

    @property
    def is_resumable(self) -> bool:
        """Whether a later render can go on with something: finished work items, or a state of one in flight."""
        return bool(self.tally.items) or self.has_states

    def keep_state(self, item: WorkItemKey, budget: Mapping[str, Any], kept: SavedStages) -> None:
        """Write what there is of a work item in flight, instead of what was written of it before.

        Parameters
        ----------
        item, budget
            What is rendered, until when; plain JSON values.
        kept
            The state.

        Raises
        ------
        FileError
            The disk refuses.
        """
        with uninterrupted(), explained_write(self.path):
            write_state(state_path(self.folder, item), self._tag(budget), kept)

    def has_state(self, item: WorkItemKey) -> bool:
        """Return whether something was kept of a work item in flight, usable or not."""
        return state_path(self.folder, item).exists()

    def kept_state(self, item: WorkItemKey, budget: Mapping[str, Any]) -> SavedStages | None:
        """Return what an earlier render has kept of a work item with the same budget, if it is whole."""
        return read_state(state_path(self.folder, item), self._tag(budget))

    def publish(self, attributes: Mapping[str, object]) -> None:
        """Complete the file with its last attributes and put it in place.

        Raises
        ------
        FileError
            The disk refuses.
        """
        self._kind.refuse_others(self.path, self.target)  # while there is still something to go on with
        self.sink.set_attributes(attributes)
        self.sink.close()
        with uninterrupted(), explained_write(self.path):
            publish(self.path, self._samples(), self.target, self._kind)
        self.discard()

    def discard(self) -> None:
        """Remove everything; nothing is raised."""
        with uninterrupted():
            if self._sink is not None:
                self._sink.abandon()
                self._sink = None
            self._state = JournalState()
            for leftover in self.folder.glob("samples.*"):  # first: without them the journal means nothing
                with suppress(OSError):
                    leftover.unlink()
            shutil.rmtree(self.folder, ignore_errors=True)
            self._journal.close()

    def __enter__(self) -> PartialCapture:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leave()

    def _read_journal(self) -> JournalState:
        if self._journal.lost_bytes:
            self.damage.append(
                f"{self._journal.path}: is damaged; the units it told of from there on are rendered again."
            )
        try:
            return JournalState.from_records(self._journal.records())
        except ValueError:
            self.damage = [f"{self._journal.path}: is damaged; everything is rendered again."]
            return JournalState()

    def _begin(self, identity: dict[str, Any], resume: bool | None) -> None:
        is_begun = self.has_states and bool(self._state.first)
        exists = self._samples().exists() if self.tally.items else is_begun
        if resume is True and not exists:
            hint = " It is complete: leave out --resume to render it again." if self.target.exists() else ""
            hint = f" {self._journal.path} is damaged: leave out --resume to begin anew." if self.damage else hint
            raise FileError(f"{self.path}: there is no unfinished render to resume.{hint}")
        if exists and resume is not False:
            self._refuse_other(identity)
            self._replaces_others = bool(self._state.first.get("overwrite"))  # as the first run was allowed to
        self._identity, self._replaces_others = identity, self._replaces_others or resume is False
        self._kind.refuse_others(self.path, self.target)
        if not exists or resume is False:
            with explained_write(self.path):
                self._journal.clear()
                for leftover in (*self.folder.glob("samples.*"), *self.folder.glob(f"{PREFIX}*")):
                    leftover.unlink()
            self._state = JournalState()
            if resume is False:
                self.damage.clear()  # it was thrown away

    @property
    def _kind(self) -> FileKind:
        """What the output may replace."""
        if self._replaces_others or not self._identity:
            return CAPTURE
        config = self._identity["config"]
        return same_capture(tree_hash(config), str(self._identity["part"]), config)

    def _refuse_other(self, identity: dict[str, Any]) -> None:
        found = list(differences(self._state.first.get("identity", {}), identity))
        if found:
            listed = "; ".join(f"{key}: {old} then, {new} now" for key, old, new in found[:MAX_DIFFERENCES])
            more = f"; and {len(found) - MAX_DIFFERENCES} more" if len(found) > MAX_DIFFERENCES else ""
            raise FileError(
                f"{self.path}: there is an unfinished render of something else ({listed}{more}). "
                "Use --overwrite to throw it away and start anew, or name another output."
            )

    def _is_whole(self) -> bool:
        """Return whether the closed file is, to the last byte, what was written."""
        chunks = (chunk for _, chunks, _ in self._stored_units() for chunk in chunks)
        with explained_write(self.path), stored_chunks(self._samples()) as stored:
            if stored.closing(chunks) != self._state.closed:
                self.damage.append(f"{self._samples()}: is damaged; it is built anew from the units that are whole.")
                return False
            return all(stored.has(chunks) for _, chunks, _ in self._stored_units())

    def _stored_units(self) -> Iterator[tuple[WorkItemKey, list[StoredChunk], Sums]]:
        return items_of(self._journal.records(), self._state.generation)

    def _rebuild(self, create: Callable[[], CaptureSink]) -> None:
        """Copy the work items whose bytes are whole into a new file."""
        old, earlier = self._samples(), self._state
        state = JournalState(earlier.first, generation=earlier.newest + 1, newest=earlier.newest + 1)
        for leftover in self.folder.glob("samples.*"):  # of an attempt that failed
            if leftover != old:
                leftover.unlink()
        self._state = state
        try:
            self._sink = create()
            with explained_write(self.path), stored_chunks(old) as stored:
                for item, chunks, sums in items_of(self._journal.records(), earlier.generation):
                    if stored.has(chunks):
                        self.store(item, _copies(stored, chunks), sums)
            lost = len(earlier.tally.items) - len(self.tally.items)
            if lost:
                of_all = f"{lost} of {len(earlier.tally.items)} finished units"
                self.damage.append(f"{old}: {of_all} are damaged on the disk and are rendered again.")
            with explained_write(self.path):
                synchronise(self._samples())  # before the old file goes: its work items would have to be done again
            self._note({"switched_to": state.generation}, durable=True)
        except BaseException:
            # the old file still counts
            if self._sink is not None:
                self._sink.abandon()
                self._sink = None
            self._state = earlier
            raise
        with suppress(OSError):
            old.unlink()

    def _leave(self) -> None:
        """Close what is open and give the output free; keep what is finished."""
        with uninterrupted():
            if not self.is_resumable:
                self.discard()
                return
            if self._sink is not None and not self.tally.items:
                self._sink.abandon()  # it is begun anew
                self._sink = None
            if self._sink is not None:
                try:
                    self._sink.close()
                    with explained_write(self.path):
                        synchronise(self._samples())
                        self._note(self._closing(), durable=True)
                except FileError:  # the journal knows enough to build the file anew
                    self._sink.abandon()
                self._sink = None
            self._journal.close()

    def _closing(self) -> dict[str, Any]:
        chunks = (chunk for _, chunks, _ in self._stored_units() for chunk in chunks)
        with stored_chunks(self._samples()) as stored:
            return closing_record(stored.closing(chunks))

    def _tag(self, budget: Mapping[str, Any]) -> str:
        return tree_hash({"identity": self._identity, "budget": dict(budget)})

    def _note(self, record: Mapping[str, Any], *, durable: bool = False) -> None:
        with uninterrupted(), explained_write(self.path):
            self._journal.append(record, durable=durable)

    def _samples(self) -> Path:
        return self.folder / f"samples.{self._state.generation}.hdf5"


def _copies(stored: StoredChunks, chunks: Iterable[StoredChunk]) -> Iterator[PackedChunk]:
    for chunk in chunks:
        content = stored.content(chunk)
        if content is None:
            raise FileError(f"{chunk.dataset}: changes while it is read. Does another program write it?")
        yield PackedChunk(chunk.dataset, chunk.at, content)
