"""Work items: rendered here, packed and written by a thread of its own while the next one is rendered."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.capture.plan import WorkItem
from nlosrender.engine.launch.passes import Passes, Snapshot
from nlosrender.files import layout
from nlosrender.files.chunking import Chunker, PackedChunk
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.sums import Sums, sums_of
from nlosrender.interruption import uninterrupted
from nlosrender.rendering.render_report import Stopwatch

if TYPE_CHECKING:
    from nlosrender.engine.interface import Budget, Engine
    from nlosrender.engine.launch.histogram import Histogram


def render_item(engine: Engine, item: WorkItem, budget: Budget, passes: Passes) -> Histogram:
    """Render one work item, here or in another process.

    Parameters
    ----------
    engine, item, budget
        What to render, and when to stop.
    passes
        Told the share of the work item that is done, and asked for what an earlier render has saved of it.

    Returns
    -------
    Histogram
        Axes (channel, bounce, laser, sensor, bin), laser and sensor flattened row by row.

    Raises
    ------
    RenderError
        The result is not finite.
    """
    limit, count = budget.time_limit_s, len(item.batches)
    if count == 1:
        part = passes.stage("batch 0")
        whole = engine.render(item.batches[0], budget, part)
        part.finish(Snapshot())  # its parts are no longer needed
        return whole
    share_of = replace(budget, time_limit_s=None if limit is None else limit / count)
    pieces = []
    for number, batch in enumerate(item.batches):
        part = passes.stage(f"batch {number}", number / count, (number + 1) / count)
        if (earlier := part.resumed("mean")) is not None:  # the whole batch was done
            piece = _histogram(earlier)
        else:
            piece = engine.render(batch, share_of, part)
        part.finish(_snapshot(piece))
        pieces.append(piece)
    return joined_histogram(item, pieces)


def _snapshot(histogram: Histogram) -> Snapshot:
    arrays = {name: getattr(histogram, name) for name in ("mean", "variance", "outside", "contrasts")}
    return Snapshot(arrays, {"samples": histogram.samples})


def _histogram(saved: Snapshot) -> Histogram:
    from nlosrender.engine.launch.histogram import Histogram

    return Histogram(**saved.arrays, samples=saved.numbers["samples"])


def joined_histogram(item: WorkItem, pieces: list[Histogram]) -> Histogram:
    """Put the histograms of a work item's batches together, sensor points row by row."""
    from nlosrender.engine.launch.histogram import Histogram

    rows, columns = item.sensors.shape
    arrays = {}
    for name in ("mean", "variance", "outside"):
        first = getattr(pieces[0], name)
        whole = np.empty((*first.shape[:3], rows, columns, *first.shape[4:]))
        for batch, piece in zip(item.batches, pieces, strict=True):
            tile = batch.sensors
            inside = np.s_[
                tile.y0 - item.sensors.y0 : tile.y1 - item.sensors.y0,
                tile.x0 - item.sensors.x0 : tile.x1 - item.sensors.x0,
            ]
            values = getattr(piece, name)
            whole[(slice(None),) * 3 + inside] = values.reshape(*first.shape[:3], *tile.shape, *first.shape[4:])
        arrays[name] = whole.reshape(*first.shape[:3], rows * columns, *first.shape[4:])
    contrasts = sum((piece.contrasts for piece in pieces[1:]), pieces[0].contrasts)
    return Histogram(**arrays, samples=min(piece.samples for piece in pieces), contrasts=contrasts)


@dataclass(frozen=True, eq=False)
class FinishedItem:
    """A rendered work item on its way to the file."""

    item: WorkItem
    chunks: Iterable[PackedChunk]  # packed when they are asked for, or by the worker it came from
    sums: Sums
    seconds: Mapping[str, float] = field(default_factory=dict)  # per stage, spent on it by a worker


def render_timed(
    engine: Engine,
    item: WorkItem,
    budget: Budget,
    chunker: Chunker,
    stopwatch: Stopwatch,
    passes: Passes | None = None,
    earlier_seconds: float = 0.0,
) -> FinishedItem:
    """Render a work item; the engine's own arrays are gone when this returns.

    Parameters
    ----------
    engine, item, budget, passes
        As for ``render_item``.
    chunker
        Of the capture's file.
    stopwatch
        Told the seconds.
    earlier_seconds
        Spent on the work item by an earlier render.

    Raises
    ------
    RenderError
        The result is not finite.
    """
    compiled, begun = engine.compile_seconds, time.perf_counter()
    histogram = render_item(engine, item, budget, passes or Passes())
    seconds = time.perf_counter() - begun
    compiled = engine.compile_seconds - compiled
    stopwatch.seconds["compile"] += compiled
    stopwatch.seconds["render"] += seconds - compiled
    confocal = chunker.header.confocal
    channels, slots, _, _, n_bins = histogram.mean.shape
    axes = (channels, slots, *((1, 1) if confocal else item.lasers.shape), *item.sensors.shape, n_bins)
    # of Stokes components the intensity: the others have signs, and are no energy
    light = slice(0, 1) if layout.CHANNELS.get(channels) == layout.STOKES else slice(None)
    sums = sums_of(
        histogram.mean[light],
        histogram.variance[light],
        histogram.outside[light],
        histogram.samples,
        earlier_seconds + seconds,
        histogram.contrasts[:, light].sum(axis=1),
    )
    stored = {layout.DATA: histogram.mean} | ({layout.VARIANCE: histogram.variance} if chunker.has_variance else {})
    with np.errstate(over="ignore"):  # what overflows float32 is refused where it is cut into chunks
        samples = {name: values.astype(np.float32).reshape(axes) for name, values in stored.items()}
    laser_at = (0, 0) if confocal else (item.lasers.y0, item.lasers.x0)
    return FinishedItem(item, chunker.pack(samples, laser_at, (item.sensors.y0, item.sensors.x0)), sums)


class ItemWriter:
    """Stores work items in a thread of its own, one at a time; the render waits when it is a whole item ahead.

    Every call of HDF5 happens in one thread at a time: in this one until ``close``. FileError or RenderError of an item
    is raised by the next call.
    """

    def __init__(self, capture: PartialCapture, stopwatch: Stopwatch):
        self._capture, self._stopwatch = capture, stopwatch
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="writer")
        self._pending: Future[None] | None = None

    def store(self, finished: FinishedItem) -> None:
        """Hand over a work item, once the one before is stored."""
        self.wait()
        self._pending = self._thread.submit(self._store, finished)

    def wait(self) -> None:
        """Wait until everything is stored."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def close(self) -> None:
        """End the thread once it is done; what it could not store is lost."""
        with uninterrupted():
            self._thread.shutdown(wait=True)

    def _store(self, finished: FinishedItem) -> None:
        key = finished.item.sensors, finished.item.lasers
        packing, writing = self._capture.store(key, finished.chunks, finished.sums)
        self._stopwatch.seconds["compress"] += packing
        self._stopwatch.seconds["write"] += writing
