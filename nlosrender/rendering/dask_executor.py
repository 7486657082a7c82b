"""Renders the work items of a plan on the workers of a dask cluster; this process alone writes them.

dask hands out the items, also again those of workers that die; here the number on the way is bounded.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

from nlosrender.capture.plan import WorkItem
from nlosrender.errors import BackendError, IncompleteRender, InterruptedRender, RenderError
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.interruption import StopRequest
from nlosrender.rendering.dask_cluster import Cluster
from nlosrender.rendering.dask_worker import Job, RemoteError, render_remotely
from nlosrender.rendering.local_executor import saved_suffix, standing
from nlosrender.rendering.render_report import Monitor, Warn
from nlosrender.rendering.work_items import FinishedItem, ItemWriter

if TYPE_CHECKING:
    from distributed import Future, as_completed

    from nlosrender.engine.interface import Budget

STOP_SECONDS = 20.0  # grace for work items in flight after a signal: batch systems kill after 30 s
PER_WORKER = 2  # work items on the way for each worker: the one it renders, and the next or the last
LOOK_SECONDS = 0.02  # polling interval for arrivals and signals
WORKER_LOOK_SECONDS = 5.0  # polling interval for the number of workers


def render_on_cluster(
    items: Sequence[WorkItem],
    job: Job,
    budget: Budget,
    partial: PartialCapture,
    stop: StopRequest,
    cluster: Cluster,
    monitor: Monitor,
) -> None:
    """Render work items on a cluster and store each as it comes.

    Parameters
    ----------
    items, job
        What is left to do, of which capture.
    budget
        When to stop, calibrated; ``time_limit_s`` is dealt out to the work items as if all workers were always busy.
    partial, cluster
        Where they go, open; who renders.
    stop
        When it comes no more work items are begun; those that are being rendered have ``STOP_SECONDS``.
    monitor
        Told the seconds (render and compress: summed over the workers), the share that is done, what is odd, and what
        is finished.

    Raises
    ------
    InterruptedRender
        A stop was requested before the last work item.
    IncompleteRender
        The scheduler is gone, or a work item took several workers down with it; RenderError where none is finished.
    BackendError, RenderError, FileError
        A worker cannot render, a work item cannot be rendered or stored.
    """
    workers = cluster.processes.workers
    if len(items) < workers:
        monitor.warn(
            f"--workers: the capture is cut into {len(items)} work items: some of {workers} workers have no work."
        )
    if budget.time_limit_s is not None and items:
        left = max(0.0, budget.time_limit_s - partial.finished.sums.seconds / workers)
        budget = replace(budget, time_limit_s=left * workers / len(items))
    total = len(partial.finished.items) + len(items)
    flight = _Flight(items, job, budget, cluster)
    writer = ItemWriter(partial, monitor.stopwatch)
    done = len(partial.finished.items)
    so_far = partial.finished.sums
    monitor.watch(standing(so_far, done, total))
    try:
        for arrived in flight.arrivals(stop, monitor.warn):
            for stage, spent in arrived.seconds.items():
                monitor.stopwatch.seconds[stage] += spent
            writer.store(arrived)
            done, so_far = done + 1, so_far + arrived.sums
            monitor.progress(done / total)
            monitor.watch(standing(so_far, done, total))
        writer.wait()
    except (BackendError, IncompleteRender) as error:
        writer.wait()
        begins_anew = isinstance(error, IncompleteRender) and not partial.finished.items
        kind = RenderError if begins_anew else type(error)
        raise kind(f"{partial.path}: {error} The render stopped{saved_suffix(partial, total)}") from error
    finally:
        writer.close()
        flight.cancel()
    if done < total:
        raise InterruptedRender(f"{partial.path}: stopped by {stop.signal_name}{saved_suffix(partial, total)}")


class _Flight:
    """The work items on their way to the workers and back: never more than ``PER_WORKER`` for each."""

    def __init__(self, items: Sequence[WorkItem], job: Job, budget: Budget, cluster: Cluster):
        self._left, self._client = iter(items), cluster.client
        self._arguments = (asdict(budget), cluster.threads)
        self._job = job
        self._out: dict[Future[Any], None] = {}  # the oldest first: the order in which they are begun
        self._recalled = False
        self._given_up_at = math.inf  # s of the monotonic clock, after a stop

    def arrivals(self, stop: StopRequest, warn: Warn) -> Iterator[FinishedItem]:
        """Yield work items as they come; after a stop only those that were begun."""
        from distributed import as_completed

        flying = as_completed([])
        looked = time.monotonic()
        if not stop.came:  # a signal may have come while the workers started
            self._top_up(flying)
        while not flying.is_empty():
            if stop.came and not self._recalled:
                warn(
                    f"{stop.signal_name}: the work items in flight have {STOP_SECONDS:g} s to be finished; once more "
                    "stops at once."
                )
                self._recall()
                self._given_up_at = time.monotonic() + STOP_SECONDS
            if time.monotonic() > self._given_up_at:
                return
            if time.monotonic() - looked > WORKER_LOOK_SECONDS:
                looked = time.monotonic()
                if not self._client.scheduler_info()["workers"]:
                    if self._recalled:  # the signal reached them, too
                        return
                    warn("no worker is left; waiting for one to join. Ctrl-C saves what is finished.")
            if not flying.has_ready():
                time.sleep(LOOK_SECONDS)
                continue
            future = next(flying)
            if future not in self._out:  # recalled
                continue
            arrived = self._arrived(future)
            del self._out[future], future  # the worker may forget it now
            yield arrived  # which waits for the writer, so that results stay with the workers
            if not self._recalled:
                self._top_up(flying)

    def cancel(self) -> None:
        """Take back what is still out."""
        with suppress(OSError, TimeoutError, CancelledError):  # the scheduler is gone, and everything with it
            self._client.cancel(list(self._out))
        self._out.clear()

    def _top_up(self, flying: as_completed) -> None:
        bound = PER_WORKER * max(1, len(self._client.scheduler_info()["workers"]))
        for item in islice(self._left, max(0, bound - len(self._out))):
            # not pure: dask would take work items of equal arguments for one
            future = self._client.submit(render_remotely, self._job, item, *self._arguments, pure=False)
            self._out[future] = None
            flying.add(future)

    def _recall(self) -> None:
        """Take back the work items that wait behind those that are being rendered."""
        self._recalled = True
        running = max(1, len(self._client.scheduler_info()["workers"]))
        waiting = [future for future in list(self._out)[running:] if not future.done()]
        self._client.cancel(waiting)
        for future in waiting:
            del self._out[future]

    def _arrived(self, future: Future[Any]) -> FinishedItem:
        from distributed import KilledWorker

        try:
            result: FinishedItem | RemoteError = future.result()
        except KilledWorker as error:
            raise IncompleteRender(
                "a work item has ended every worker process it was given to. Lower render.memory_limit if they ran out "
                "of memory; the workers' logs tell."
            ) from error
        except (CancelledError, OSError) as error:
            raise IncompleteRender("the dask scheduler is gone, and the work items in flight with it.") from error
        except ImportError as error:
            raise BackendError(f"a worker lacks a package ({error}). Install nlosrender on every machine.") from error
        if isinstance(result, RemoteError):
            raise result.error()
        return result
