"""The units of a plan, rendered one after the other in this process; what is finished survives whatever happens."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from nlosrender.capture.plan import WorkItem
from nlosrender.engine.launch.passes import Passes
from nlosrender.errors import FileError, IncompleteRender, InterruptedRender, RenderError
from nlosrender.files.partial_capture import PartialCapture
from nlosrender.files.sums import Sums
from nlosrender.interruption import StopRequest, stop_request
from nlosrender.rendering.report import Progress, Standing, Stopwatch, Warn, Watch
from nlosrender.rendering.unit_in_flight import UnitInFlight, UnitStopped
from nlosrender.rendering.units import RenderedUnit, UnitWriter, finished_unit, render_unit

if TYPE_CHECKING:
    from nlosrender.engine.path.engine import Budget
    from nlosrender.rendering.units import Engine


@contextmanager
def resumable(partial: PartialCapture) -> Iterator[StopRequest]:
    """Let the first signal to stop inside the block be a request, and say what is left after a failure.

    Raises
    ------
    InterruptedRender
        A second signal came.
    IncompleteRender
        A file could not be written, but units are finished and saved.
    """
    try:
        with stop_request() as stop:
            yield stop
    except KeyboardInterrupt as error:
        raise InterruptedRender(f"{partial.path}: interrupted{kept(partial)}") from error
    except FileError as error:
        if not partial.is_resumable:
            raise
        raise IncompleteRender(f"{error} The render stopped{kept(partial)}") from error
    except RenderError:
        partial.discard()  # the same would come out again
        raise


def render_units(
    units: Sequence[WorkItem],
    engine: Engine,
    budget: Budget,
    partial: PartialCapture,
    stop: StopRequest,
    *,
    store_variance: bool,
    stopwatch: Stopwatch,
    progress: Progress,
    warn: Warn,
    watch: Watch,
) -> None:
    """Render units and store each as it is done.

    Parameters
    ----------
    units
        What is left to do.
    engine, budget
        What renders them; when to stop, ``time_limit_s`` being the limit for all units, earlier runs' included.
    partial
        Where they go; open.
    stop
        Looked at between passes: a unit that takes long is kept as it is.
    store_variance
        Whether the file has the variance.
    stopwatch, progress, warn, watch
        Told the seconds, the share that is done, that the user has to wait, and what is finished.

    Raises
    ------
    InterruptedRender
        A stop was requested before the last unit.
    RenderError, FileError
        A unit cannot be rendered or stored.
    """
    earlier = len(partial.tally.units)
    total = earlier + len(units)
    spent = partial.tally.sums.seconds
    begun = time.perf_counter()
    writer = UnitWriter(partial, stopwatch)
    so_far = partial.tally.sums  # which the writer is a unit behind of, later on
    watch(standing(so_far, earlier, total))
    try:
        for number, unit in enumerate(units):
            limit = budget.time_limit_s
            if limit is not None:  # what is left of the time, shared by the units that are left
                limit = max(0.0, limit - spent - (time.perf_counter() - begun)) / (len(units) - number)

            def told(share: float, done: int = earlier + number) -> None:
                progress((done + share) / total)
                if stop.came:
                    warn(
                        f"{stop.signal_name}: the unit in flight is finished, or kept as it is after a few seconds; "
                        "once more stops at once."
                    )

            own_budget = replace(budget, time_limit_s=limit)
            flight = UnitInFlight(partial, unit, own_budget, stop, told, warn)
            finished = rendered(
                engine, unit, own_budget, store_variance, stopwatch, flight.passes, flight.earlier_seconds
            )
            spent += flight.earlier_seconds
            so_far += finished.sums
            writer.store(finished)
            del finished, flight  # its arrays are the writer's now
            told(1.0)
            watch(standing(so_far, earlier + number + 1, total))
            if stop.came and number + 1 < len(units):
                raise UnitStopped
        writer.wait()
    except UnitStopped as stopped:
        writer.wait()
        raise InterruptedRender(f"{partial.path}: stopped by {stop.signal_name}{kept(partial, total)}") from stopped
    finally:
        writer.close()


def rendered(
    engine: Engine,
    unit: WorkItem,
    budget: Budget,
    store_variance: bool,
    stopwatch: Stopwatch,
    passes: Passes | None = None,
    earlier_seconds: float = 0.0,
) -> RenderedUnit:
    """Render a unit; the engine's own arrays are gone when this returns.

    Parameters
    ----------
    engine, unit, budget, passes
        As for ``render_unit``.
    store_variance
        Whether the file has the variance.
    stopwatch
        Told the seconds.
    earlier_seconds
        Spent on the unit by an earlier render.

    Raises
    ------
    RenderError
        The result is not finite.
    """
    compiled, begun = engine.compile_seconds, time.perf_counter()
    histogram = render_unit(engine, unit, budget, passes or Passes())
    seconds = time.perf_counter() - begun
    compiled = engine.compile_seconds - compiled
    stopwatch.seconds["compile"] += compiled
    stopwatch.seconds["render"] += seconds - compiled
    confocal = engine.capture.scan_type == "confocal"
    seconds += earlier_seconds
    return finished_unit(unit, histogram, confocal=confocal, store_variance=store_variance, seconds=seconds)


def standing(sums: Sums, done: int, total: int) -> Standing:
    """Return where a render stands whose finished units have these sums."""
    return Standing("units", done, total, sums.error_estimate if done and sums.squares else None)


def kept(partial: PartialCapture, total: int | None = None) -> str:
    """Return the end of a sentence: what is saved, of ``total`` units."""
    finished = len(partial.tally.units)
    if not partial.is_resumable:
        return " before anything was finished; nothing is kept."
    of_all = "" if total is None else f" of {total}"
    begun = ", and so is what was done of the one in flight" if partial.has_states else ""
    return f"; {finished}{of_all} units are finished and saved{begun}. The same command goes on from there."
