"""Renders the work items of a plan one after the other in this process; what is finished survives whatever happens."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from nlosrender.capture.plan import WorkItem
from nlosrender.errors import FileError, IncompleteRender, InterruptedRender, RenderError
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.sums import Sums
from nlosrender.interruption import StopRequest, stop_request
from nlosrender.rendering.item_in_flight import SAVING, ItemInFlight, ItemStopped, SavePolicy
from nlosrender.rendering.render_report import Monitor, Standing
from nlosrender.rendering.work_items import ItemWriter, render_timed

if TYPE_CHECKING:
    from nlosrender.engine.interface import Budget, Engine


@contextmanager
def resumable(partial: PartialCapture) -> Iterator[StopRequest]:
    """Let the first signal to stop inside the block be a request, and say what is left after a failure.

    Raises
    ------
    InterruptedRender
        A second signal came.
    IncompleteRender
        A file could not be written, but work items are finished and saved.
    """
    try:
        with stop_request() as stop:
            yield stop
    except KeyboardInterrupt as error:
        raise InterruptedRender(f"{partial.path}: interrupted{saved_suffix(partial)}") from error
    except FileError as error:
        if not partial.is_resumable:
            raise
        raise IncompleteRender(f"{error} The render stopped{saved_suffix(partial)}") from error
    except RenderError:
        partial.discard()  # rendering again would give the same
        raise


def render_items(
    items: Sequence[WorkItem],
    engine: Engine,
    budget: Budget,
    partial: PartialCapture,
    stop: StopRequest,
    monitor: Monitor,
    saving: SavePolicy = SAVING,
) -> None:
    """Render work items and store each as it is done.

    Parameters
    ----------
    items
        What is left to do.
    engine, budget
        What renders them; when to stop, ``time_limit_s`` being the limit for all work items, earlier runs' included.
    partial, stop
        Where they go, open; looked at between passes: a work item that takes long is saved as it is.
    monitor, saving
        Told the seconds, the share that is done, that the user has to wait, and what is finished; when the state of an
        item in flight is saved.

    Raises
    ------
    InterruptedRender
        A stop was requested before the last work item.
    RenderError, FileError
        A work item cannot be rendered or stored.
    """
    earlier = len(partial.finished.items)
    total = earlier + len(items)
    spent = partial.finished.sums.seconds
    begun = time.perf_counter()
    writer = ItemWriter(partial, monitor.stopwatch)
    so_far = partial.finished.sums  # counts the item that is still being written
    monitor.watch(standing(so_far, earlier, total))
    try:
        for number, item in enumerate(items):
            limit = budget.time_limit_s
            if limit is not None:  # what is left of the time, shared by the work items that are left
                limit = max(0.0, limit - spent - (time.perf_counter() - begun)) / (len(items) - number)

            def report_progress(share: float, done: int = earlier + number) -> None:
                monitor.progress((done + share) / total)
                if stop.came:
                    monitor.warn(
                        f"{stop.signal_name}: the work item in flight is finished, or saved as it is after a few "
                        "seconds; once more stops at once."
                    )

            own_budget = replace(budget, time_limit_s=limit)
            flight = ItemInFlight(partial, item, own_budget, stop, report_progress, monitor.warn, saving)
            finished = render_timed(
                engine, item, own_budget, partial.chunker, monitor.stopwatch, flight.passes, flight.earlier_seconds
            )
            spent += flight.earlier_seconds
            so_far += finished.sums
            writer.store(finished)
            del finished, flight  # only the writer holds its arrays now
            report_progress(1.0)
            monitor.watch(standing(so_far, earlier + number + 1, total))
            if stop.came and number + 1 < len(items):
                raise ItemStopped
        writer.wait()
    except ItemStopped as stopped:
        writer.wait()
        raise InterruptedRender(
            f"{partial.path}: stopped by {stop.signal_name}{saved_suffix(partial, total)}"
        ) from stopped
    finally:
        writer.close()


def standing(sums: Sums, done: int, total: int) -> Standing:
    """Return where a render stands whose finished work items have these sums."""
    return Standing("units", done, total, sums.error_estimate if done and sums.squares else None)


def saved_suffix(partial: PartialCapture, total: int | None = None) -> str:
    """Return the end of a sentence: what is saved, of ``total`` work items."""
    finished = len(partial.finished.items)
    if not partial.is_resumable:
        return " before anything was finished; nothing is kept."
    of_all = "" if total is None else f" of {total}"
    begun = ", and so is what was done of the one in flight" if partial.has_states else ""
    return f"; {finished}{of_all} work items are finished and saved{begun}. The same command goes on from there."
