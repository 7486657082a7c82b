"""All captures of a sweep, one after the other in this process: the backend starts once, kernels are compiled once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from nlosrender.capture.part import WHOLE
from nlosrender.config.document import Config
from nlosrender.config.load import config_to_dict
from nlosrender.config.sweep_load import Sweep
from nlosrender.errors import ConfigError, FileError, InterruptedRender, OptionError, RenderError
from nlosrender.files.atomic_write import explained_write, partial_folder
from nlosrender.files.dataset_index import IndexEntry, entry_of, relative_name, stored_entry, write_index
from nlosrender.files.file_kinds import CAPTURE, same_capture
from nlosrender.files.identity import capture_hash
from nlosrender.files.reading.reader import read_header
from nlosrender.interruption import StopRequest, stop_request
from nlosrender.rendering.render_report import Progress, RenderReport, Standing, Warn, Watch

INDEX_SECONDS = 10.0  # between two writings of the index, which takes a while for a large dataset

RenderOne = Callable[[Config, Progress, Warn, bool | None], RenderReport]  # the last: resume, as for render_capture
Shard = tuple[int, int]  # I of N, counted from 1


@dataclass(frozen=True)
class SweepReport:
    """Report of a finished sweep."""

    index: Path  # the file that lists the captures
    captures: int  # of this run: all of the sweep, or of the shard
    rendered: int
    earlier: int  # finished by earlier runs
    failed: tuple[IndexEntry, ...]
    seconds: float


class _Dataset:
    """The entries of the captures of one run, and the index that is written of them."""

    def __init__(self, sweep: Sweep, shard: Shard | None):
        self.sweep, self.folder = sweep, sweep.output_folder
        self.chosen = chosen_captures(len(sweep), shard)
        # shards write at the same time, perhaps on different machines: each has an index of its own
        suffix = "" if shard is None else f"-{shard[0]}-of-{shard[1]}"
        self.path = self.folder / f"index{suffix}.json"
        self.entries: dict[int, IndexEntry] = {}
        self.warned: set[str] = set()
        self._written = 0.0

    def prepare(self) -> None:
        """Make the folders."""
        for folder in sorted({self.sweep.paths[index].absolute().parent for index in self.chosen} | {self.folder}):
            with explained_write(folder):
                folder.mkdir(parents=True, exist_ok=True)

    def look(self, index: int, anew: bool = False) -> IndexEntry:
        """Note and return what there is of a capture; with ``anew`` nothing counts.

        What nothing is there of is not asked for its hash: meshes of a large dataset would be read before the first
        render begins.
        """
        sweep, path = self.sweep, self.sweep.paths[index]
        self.entries[index] = entry_of(index, relative_name(path, self.folder), sweep.facts(index))
        if anew or not os.path.lexists(path):
            return self.entries[index]
        with suppress(ConfigError):  # such as of a mesh that cannot be read: the render says so
            config, facts = sweep.capture(index)
            entry = entry_of(index, relative_name(path, self.folder), facts, sweep.document.folder)
            entry = replace(entry, capture_hash=capture_hash(config_to_dict(config)))
            self.entries[index] = stored_entry(entry, path)
        return self.entries[index]

    def refuse_others(self, indices: Sequence[int], overwrite: bool) -> None:
        """Make sure that the captures replace nothing but themselves: before the first one, not hours later.

        Raises
        ------
        FileError
            One of the outputs exists and is something else.
        """
        for index in indices:
            path = self.sweep.paths[index]
            target = Path(os.path.realpath(path))
            if not os.path.lexists(target) or partial_folder(target).exists():  # the render checks what it began over
                continue
            expected = self.entries[index].capture_hash
            if overwrite or expected is None:  # None: its render will fail
                CAPTURE.refuse_others(path, target)
                continue
            config = config_to_dict(self.sweep.config(index))
            same_capture(expected, str(WHOLE), config).refuse_others(path, target)

    def write(self, at_once: bool = False) -> None:
        """Write the index, unless that was done a moment ago."""
        if at_once or time.monotonic() - self._written > INDEX_SECONDS:
            write_index(self.path, self.sweep, [self.entries[index] for index in self.chosen])
            self._written = time.monotonic()


def render_sweep(
    sweep: Sweep,
    render: RenderOne,
    *,
    shard: Shard | None = None,
    resume: bool | None = None,
    progress: Progress = lambda share: None,
    warn: Warn = lambda text: None,
    watch: Watch = lambda standing: None,
) -> SweepReport:
    """Render the captures of a sweep that are not there yet, and write their index.

    A capture that cannot be rendered is noted and the next one begun.

    Parameters
    ----------
    sweep
        What to render.
    render
        Renders one capture: the pipeline's ``render_capture``.
    shard
        Only every N-th capture, beginning with the I-th; None: all.
    resume
        None: go on where an earlier run stopped, or begin; True: there has to be something to go on with; False: render
        everything anew.
    progress, warn
        Told the share of the captures that are done, and warnings, each once, with the first capture they are about.
    watch
        Told how many captures are finished.

    Raises
    ------
    OptionError
        The sweep has fewer captures than shards.
    FileError
        A folder, the index or a capture cannot be written, or there is nothing to resume.
    BackendError, IncompleteRender, InterruptedRender
        As ``render_capture``; the same call goes on from there.
    """
    begun = time.perf_counter()
    dataset = _Dataset(sweep, shard)
    dataset.prepare()
    there = [index for index in dataset.chosen if dataset.look(index, anew=resume is False).status == "done"]
    if resume and not there and not any(partial_folder(sweep.paths[i].resolve()).exists() for i in dataset.chosen):
        raise FileError(f"{dataset.folder}: holds nothing of this sweep to resume. Leave --resume away to begin.")
    todo = sorted(set(dataset.chosen) - set(there))
    dataset.refuse_others(todo, overwrite=resume is False)
    dataset.write(at_once=True)
    with _index_kept(dataset), stop_request() as stop:
        for number, index in enumerate(todo):
            _stop_if_asked(stop, dataset, number)
            watch(Standing("captures", len(there) + number, len(dataset.chosen)))

            def report_progress(share: float, done: int = number) -> None:
                progress((len(there) + done + share) / len(dataset.chosen))

            _render_one(dataset, index, render, False if resume is False else None, report_progress, warn)
            report_progress(1.0)
            dataset.write()
        watch(Standing("captures", len(dataset.chosen), len(dataset.chosen)))
    failed = tuple(entry for entry in dataset.entries.values() if entry.status == "failed")
    rendered, earlier = len(todo) - len(failed), len(dataset.chosen) - len(todo)
    return SweepReport(dataset.path, len(dataset.chosen), rendered, earlier, failed, time.perf_counter() - begun)


def chosen_captures(n_captures: int, shard: Shard | None) -> range:
    """Return the captures of a shard: every N-th, so that costs that grow along the sweep are shared evenly.

    Raises
    ------
    OptionError
        There are fewer captures than shards, or no such shard.
    """
    if shard is None:
        return range(n_captures)
    number, count = shard
    if not 1 <= number <= count:
        raise OptionError(f"--shard {number}/{count}: need I/N with 1 <= I <= N.")
    if count > n_captures:
        message = f"this sweep has {n_captures} captures and can be cut into at most as many shards."
        raise OptionError(f"--shard {number}/{count}: {message}")
    return range(number - 1, n_captures, count)


def _render_one(
    dataset: _Dataset, index: int, render: RenderOne, resume: bool | None, progress: Progress, warn: Warn
) -> None:
    path = dataset.sweep.paths[index]

    def warn_once(text: str) -> None:  # thousands of captures of a family have most warnings in common
        if text not in dataset.warned:
            dataset.warned.add(text)
            warn(f"{path}: {text}")

    try:
        render(dataset.sweep.config(index), progress, warn_once, resume)
    except (
        ConfigError,
        RenderError,
    ) as error:  # errors of this capture; those of disk and machine would hit all others
        warn(f"{path}: failed: {error}")
        dataset.entries[index] = replace(dataset.entries[index], status="failed", message=str(error))
        return
    entry = dataset.look(index)
    if entry.status != "done":
        problem = "another process replaced it"
        try:
            read_header(path)
        except FileError as error:
            problem = str(error)
        message = f"{relative_name(path, dataset.folder)} does not hold what was rendered: {problem}"
        dataset.entries[index] = replace(entry, status="failed", message=message)


def _stop_if_asked(stop: StopRequest, dataset: _Dataset, number: int) -> None:
    if stop.came:
        raise InterruptedRender(
            f"{dataset.folder}: stopped by {stop.signal_name}; {number} captures were rendered by this run. "
            "The same command goes on from there."
        )


@contextmanager
def _index_kept(dataset: _Dataset) -> Iterator[None]:
    """Write the index whatever happens inside."""
    try:
        yield
    except BaseException as error:
        with suppress(FileError):  # the error on its way out is the one to report
            dataset.write(at_once=True)
        if isinstance(error, KeyboardInterrupt):
            raise InterruptedRender(f"{dataset.folder}: interrupted. The same command goes on from there.") from error
        raise
    dataset.write(at_once=True)
