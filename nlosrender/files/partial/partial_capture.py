"""A capture that is being rendered, on disk: every finished work item survives whatever happens to the process.

A folder ``.NAME.partial`` beside the output holds the samples, an HDF5 file, and a journal. HDF5 does not survive a
kill, its tables being in memory until it is closed, so nothing is read from them. The journal says for each finished
work item where the bytes of its chunks lie and what their checksums are; those bytes are written once, before the
journal's record, and never moved. From them a new HDF5 file, of the next generation, is built when the earlier one was
not closed properly. Work items are not fsynced: after a power failure a record may be there and its bytes not, or torn.
So a resumed render reads the file first: a work item whose bytes fail their checksums is rendered again, and a closed
file is opened again only when its other bytes have not changed either.

A file per work item, renamed into the folder, would need no generations and no offsets. But HDF5 cannot take chunks
from another file: all samples would be written, and lie on the disk, twice by the time the output is complete.
"""

from __future__ import annotations

import functools
import shutil
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py

from nlosrender.config.canonical import tree_hash
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.atomic_write import check_writable, explained_write, publish, synchronise
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.chunking import Chunker, PackedChunk
from nlosrender.files.file_kinds import CAPTURE, FileKind, same_capture
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.header_writer import add_attributes, create_capture
from nlosrender.files.identity import differences, listed
from nlosrender.files.partial.journal import Journal, claimed_journal
from nlosrender.files.partial.work_item_log import (
    Closing,
    JournalState,
    RenderState,
    StoredChunk,
    StoredChunks,
    WorkItemKey,
    closing_record,
    item_record,
    items_of,
    run_record,
    stored_chunks,
)
from nlosrender.files.partial.work_item_state import NEW, STATE_FORMAT, ItemState, states_in
from nlosrender.files.sums import Sums
from nlosrender.files.truth_datasets import NO_TRUTH, GroundTruth
from nlosrender.interruption import uninterrupted


class PartialCapture:
    """The unfinished render of one output; made by ``claim``, a context manager.

    Leaving the block releases the output. What was finished but not published is kept, so that the same render can go
    on, and so is the state of a work item in flight, in a file of its own; where there is neither, nothing is left.

    Attributes
    ----------
    damage
        What of the earlier render was damaged and is rendered again, in sentences.
    chunker
        Makes chunks of the file, once it is open.
    """

    chunker: Chunker

    def __init__(self, path: Path, target: Path, journal: Journal):
        self.path, self.target, self.folder = path, target, journal.path.parent
        self.damage: list[str] = []
        self._journal = journal
        self._state = self._read_journal()
        self._identity: dict[str, Any] = {}
        self._overwrites = False  # whether another capture may be replaced
        self._writer: HDF5Writer | None = None

    @property
    def finished(self) -> RenderState:
        """What is finished so far, by earlier runs and this one."""
        return self._state.finished

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
        self,
        header: CaptureHeader,
        attributes: Mapping[str, object],
        compression: str,
        store_variance: bool,
        truth: GroundTruth = NO_TRUTH,
    ) -> None:
        """Open the samples' file: a new one, made by ``create_capture``, or what the earlier render has left.

        Raises
        ------
        FileError
            The disk refuses.
        """
        self.chunker, self._header = Chunker(header, compression, store_variance), header
        create = functools.partial(
            create_capture,
            header=header,
            attributes=attributes,
            compression=compression,
            store_variance=store_variance,
            truth=truth,
        )
        if self.finished.items and self._state.closed and self._is_whole():
            # durable before HDF5 changes its tables: those of a file noted as closed are trusted
            self._note({"opened": True}, durable=True)
            self._open_samples()
        elif self.finished.items:
            self._rebuild(create)
        else:
            self._note({"identity": self._identity, "overwrite": self._overwrites})
            with explained_write(self.path):  # a file without a finished work item holds nothing of use
                self._samples().unlink(missing_ok=True)
            self._open_samples(create)

    def begin_run(self, units: int) -> None:
        """Note who renders now, and of how many work items in all: for those who look at the journal (FileError)."""
        self._note(run_record(units))

    def store(self, item: WorkItemKey, chunks: Iterable[PackedChunk], sums: Sums) -> tuple[float, float]:
        """Write the chunks of a work item, dark ones left out, and note that it is finished.

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
            with explained_write(self.path):
                offset = self._open_writer.put_chunk(self._datasets[chunk.dataset], chunk.at, chunk.content)
            length, checksum = len(chunk.content), zlib.crc32(chunk.content)
            stored.append(StoredChunk(chunk.dataset, chunk.at, offset, length, checksum))
            writing += time.perf_counter() - packed
        self._note(item_record(self._state.generation, item, stored, sums))
        self.finished.add(item, stored, sums)
        with suppress(OSError):
            ItemState.of(self.folder, item).path.unlink(missing_ok=True)
        return time.perf_counter() - begun - writing, writing

    @property
    def has_states(self) -> bool:
        """Whether there is a state of a work item in flight."""
        return any(not path.name.endswith(NEW) for path in states_in(self.folder))

    @property
    def is_resumable(self) -> bool:
        """Whether a later render can go on with something: finished work items, or a state of one in flight."""
        return bool(self.finished.items) or self.has_states

    def item_state(self, item: WorkItemKey, budget: Mapping[str, Any]) -> ItemState:
        """Return where the state of a work item with a budget (plain JSON values) is kept while it is in flight."""
        tag = tree_hash({"format": STATE_FORMAT, "identity": self._identity, "budget": dict(budget)})
        return ItemState.of(self.folder, item, tag)

    def extend(self, add: Callable[[HDF5Writer, Path], Mapping[str, object]]) -> Mapping[str, object]:
        """Let ``add`` write more datasets into the file, which has all samples by now, and return what it does.

        Raises
        ------
        FileError
            The disk refuses.
        """
        with explained_write(self.path):
            return add(self._open_writer, self.path)

    def publish(self, attributes: Mapping[str, object]) -> None:
        """Complete the file with its last attributes and put it in place.

        Raises
        ------
        FileError
            The disk refuses.
        """
        self._kind.refuse_others(self.path, self.target)  # before the file is closed: the render can still be resumed
        with explained_write(self.path):
            with self._open_writer.writing():
                add_attributes(self._open_writer.file, self._header, attributes)
            self._open_writer.close()
            with uninterrupted():
                publish(self.path, self._samples(), self.target, self._kind)
        self.discard()

    def discard(self) -> None:
        """Remove everything; nothing is raised."""
        with uninterrupted():
            self._abandon()
            self._state = JournalState()
            for leftover in self.folder.glob("samples.*"):  # samples first: without them a journal counts for nothing
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
        """Refuse what is not this render's; where there is nothing to go on with, clear the folder."""
        is_begun = self.has_states and bool(self._state.first)
        exists = self._samples().exists() if self.finished.items else is_begun
        if resume is True and not exists:
            hint = " It is complete: leave out --resume to render it again." if self.target.exists() else ""
            hint = f" {self._journal.path} is damaged: leave out --resume to begin anew." if self.damage else hint
            raise FileError(f"{self.path}: there is no unfinished render to resume.{hint}")
        if exists and resume is not False:
            self._refuse_other(identity)
            self._overwrites = bool(self._state.first.get("overwrite"))  # as the first run was allowed to
        self._identity, self._overwrites = identity, self._overwrites or resume is False
        self._kind.refuse_others(self.path, self.target)
        if not exists or resume is False:
            with explained_write(self.path):
                self._journal.clear()
                for leftover in (*self.folder.glob("samples.*"), *states_in(self.folder)):
                    leftover.unlink()
            self._state = JournalState()
            if resume is False:
                self.damage.clear()  # it was thrown away

    @property
    def _kind(self) -> FileKind:
        """What the output may replace."""
        if self._overwrites or not self._identity:
            return CAPTURE
        config = self._identity["config"]
        return same_capture(tree_hash(config), str(self._identity["part"]), config)

    def _refuse_other(self, identity: dict[str, Any]) -> None:
        found = differences(self._state.first.get("identity", {}), identity)
        texts = [f"{key}: {old} then, {new} now" for key, old, new in found]
        if texts:
            raise FileError(
                f"{self.path}: there is an unfinished render of something else ({listed(texts)}). "
                "Use --overwrite to throw it away and start anew, or name another output."
            )

    def _is_whole(self) -> bool:
        """Return whether the closed file is, to the last byte, what was written."""
        with explained_write(self.path), stored_chunks(self._samples()) as stored:
            if self._closing(stored) != self._state.closed:
                self.damage.append(f"{self._samples()}: is damaged; it is built anew from the units that are whole.")
                return False
            return all(stored.has(chunks) for _, chunks, _ in self._stored_items())

    def _closing(self, stored: StoredChunks) -> Closing:
        return stored.closing(chunk for _, chunks, _ in self._stored_items() for chunk in chunks)

    def _stored_items(self) -> Iterator[tuple[WorkItemKey, list[StoredChunk], Sums]]:
        return items_of(self._journal.records(), self._state.generation)

    def _open_samples(self, create: Callable[[h5py.File], None] | None = None) -> None:
        """Open the samples' file as it was closed, or a new one that ``create`` fills with everything but light."""
        with explained_write(self.path):
            self._writer = HDF5Writer(self._samples(), reopen=create is None)
            file = self._writer.file
            with self._writer.writing():
                if create is not None:
                    create(file)
                self._datasets = {name: file[name] for name in layout.sample_names(layout.VARIANCE in file)}

    @property
    def _open_writer(self) -> HDF5Writer:
        if self._writer is None:
            raise ValueError(f"{self.path}: is not open")
        return self._writer

    def _abandon(self) -> None:
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None

    def _rebuild(self, create: Callable[[h5py.File], None]) -> None:
        """Copy the work items whose bytes are whole into a new file."""
        old, earlier = self._samples(), self._state
        for leftover in self.folder.glob("samples.*"):  # of an attempt that failed
            if leftover != old:
                leftover.unlink()
        self._state = JournalState(earlier.first, generation=earlier.newest + 1, newest=earlier.newest + 1)
        try:
            self._open_samples(create)
            with explained_write(self.path), stored_chunks(old) as stored:
                for item, chunks, sums in items_of(self._journal.records(), earlier.generation):
                    if stored.has(chunks):
                        self.store(item, _copies(stored, chunks), sums)
            lost = len(earlier.finished.items) - len(self.finished.items)
            if lost:
                of_all = f"{lost} of {len(earlier.finished.items)} finished work items"
                self.damage.append(f"{old}: {of_all} are damaged on the disk and are rendered again.")
            with explained_write(self.path):
                synchronise(self._samples())  # before the old file is removed: a power failure must not lose both
            self._note({"switched_to": self._state.generation}, durable=True)
        except BaseException:
            # the old file is still the one that counts
            self._abandon()
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
            if self._writer is not None and self.finished.items:
                # where the disk refuses, the next render rebuilds the file from the journal
                with suppress(FileError), explained_write(self.path):
                    self._writer.close()
                    synchronise(self._samples())
                    with stored_chunks(self._samples()) as stored:
                        self._note(closing_record(self._closing(stored)), durable=True)
            self._abandon()
            self._journal.close()

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
