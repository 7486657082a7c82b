"""The work item that is being rendered: its state is saved now and then, and when the render has to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from nlosrender.capture.plan import WorkItem
from nlosrender.engine.launch.passes import Passes, SavedStages, Snapshot
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import explained_write
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.interruption import StopRequest, uninterrupted
from nlosrender.rendering.render_report import Progress, Warn

if TYPE_CHECKING:
    from nlosrender.engine.interface import Budget

OF_ITEM = "unit"  # stage under which the seconds are saved


@dataclass(frozen=True)
class SavePolicy:
    """When the state of a work item in flight is saved."""

    seconds: float = 30.0  # between two states: a kill costs about a minute at most, and quick work items write none
    max_cost: float = 0.1  # largest share of the time spent on writing states, which may have gigabytes
    grace_seconds: float = 5.0  # in which a work item may still end after a signal


SAVING = SavePolicy()


class ItemStopped(Exception):
    """A stop was requested, and the work item in flight has come to the end of a pass."""


class ItemInFlight:
    """Keeps the state of a work item while it is rendered.

    Parameters
    ----------
    partial, item, budget
        Where states go; of what; when it is done (a limit of time does not count: it is another one every time).
    stop, policy
        When a stop comes the work item has ``policy.grace_seconds`` to end; then it is saved as it is.
    progress, warn
        Told the share that is done, and what cannot be kept.
    """

    def __init__(
        self,
        partial: PartialCapture,
        item: WorkItem,
        budget: Budget,
        stop: StopRequest,
        progress: Progress,
        warn: Warn,
        policy: SavePolicy,
    ):
        self._partial, self._stop, self._warn, self._policy = partial, stop, warn, policy
        comparable_budget = asdict(budget) | {"time_limit_s": budget.time_limit_s is not None}
        self._state = partial.item_state((item.sensors, item.lasers), comparable_budget)
        kept = self._state.read() or {}
        if not kept and self._state.path.exists():
            warn(
                f"{partial.path}: the saved state of the work item in flight is damaged, or of another target "
                "or version; it begins anew."
            )
        self.earlier_seconds = float(kept[OF_ITEM].numbers["seconds"]) if OF_ITEM in kept else 0.0
        self.passes = Passes(progress, self._look, kept)
        self._begun = self._kept_at = time.perf_counter()
        self._pause = policy.seconds
        self._signal_at: float | None = None  # when the stop was noticed

    @property
    def seconds(self) -> float:
        """Spent rendering the work item, by earlier runs and this one."""
        return self.earlier_seconds + time.perf_counter() - self._begun

    def _look(self, take: Callable[[], SavedStages]) -> None:
        now = time.perf_counter()
        if self._stop.came:
            self._signal_at = self._signal_at or now
            if now - self._signal_at >= self._policy.grace_seconds:
                self._keep(take())
                raise ItemStopped
        elif now - self._kept_at >= self._pause:
            self._keep(take())
            self._kept_at = time.perf_counter()
            self._pause = max(self._pause, (self._kept_at - now) / self._policy.max_cost)

    def _keep(self, kept: SavedStages) -> None:
        noted = Snapshot(numbers={"seconds": self.seconds})
        try:
            with uninterrupted(), explained_write(self._partial.path):
                self._state.write(kept | {OF_ITEM: noted})
        except FileError as error:  # a full disk: an earlier state is left as it was
            self._warn(f"{error} What is done of the work item in flight cannot be kept.")
            self._pause *= 4
