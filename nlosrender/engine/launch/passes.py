"""Passes of a unit: between two kernels its caller hears how far it is, may stop it, and may keep what there is so far.

An engine renders in stages (the gather of patches, the walks or paths), a stage in passes of about a second. The state
between two passes is a ``Snapshot``; from it another process goes on and ends with the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

PASS_SECONDS = 0.5  # kernels are kept about this short, for the progress bar and signals


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What a stage has so far: arrays as they are, not copied, and numbers that JSON can hold."""

    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    numbers: Mapping[str, Any] = field(default_factory=dict)


SavedStages = dict[str, Snapshot]  # by stage
Look = Callable[[Callable[[], SavedStages]], None]  # called between passes with what makes the state; may raise


def _no_progress(share: float) -> None:
    pass


def _no_look(take: Callable[[], SavedStages]) -> None:
    pass


@dataclass
class _Store:
    look: Look
    saved: SavedStages  # of an earlier run: finished stages, and the one that was under way
    finished: SavedStages = field(default_factory=dict)


class Passes:
    """What an engine tells its caller between passes; by itself it only passes the progress on.

    Parameters
    ----------
    progress
        Told the share of the work that is done, in [0, 1].
    look
        Called between passes; what it raises ends the render.
    saved
        The state that a call of ``look`` was given by an earlier render of the same unit; empty: there is none.
    """

    def __init__(
        self, progress: Callable[[float], None] = _no_progress, look: Look = _no_look, saved: SavedStages | None = None
    ):
        self._progress, self._name = progress, ""
        self._store = _Store(look, dict(saved or {}))

    def stage(self, name: str, begin: float = 0.0, end: float = 1.0) -> Passes:
        """Return the passes of a stage, or of a part of one, that takes the work from share ``begin`` to ``end``."""
        part = Passes(lambda share: self._progress(begin + (end - begin) * share))
        part._name, part._store = f"{self._name}/{name}" if self._name else name, self._store
        return part

    def resumed(self, array: str) -> Snapshot | None:
        """Return, once, what an earlier render had of this stage when it ended; None: no state with that array."""
        saved = self._store.saved.get(self._name)
        return self._store.saved.pop(self._name) if saved is not None and array in saved.arrays else None

    def between(self, share: float, take: Callable[[], Snapshot]) -> None:
        """Tell that ``share`` of the stage is done; ``take`` makes the state, should it be asked for.

        Raises
        ------
        Exception
            Whatever the caller ends the render with.
        """
        self._progress(share)
        self._store.look(lambda: self._store.finished | {self._name: take()})

    def finish(self, result: Snapshot) -> None:
        """Keep the result of a finished stage for later states, instead of those of its parts."""
        self._progress(1.0)
        for saved in (self._store.finished, self._store.saved):
            for name in [name for name in saved if name.startswith(f"{self._name}/")]:
                del saved[name]
        self._store.finished[self._name] = result


@dataclass
class PassSize:
    """How many steps of a loop a kernel takes so that it lasts about ``PASS_SECONDS``; the results do not depend on it.

    Parameters
    ----------
    steps
        Of the first kernel.
    """

    steps: int
    begun: float = field(default_factory=time.perf_counter)

    def begin(self) -> None:
        """Start the clock of a kernel."""
        self.begun = time.perf_counter()

    def end(self) -> None:
        """Note that the kernel is done."""
        factor = PASS_SECONDS / max(time.perf_counter() - self.begun, 1e-6)
        self.steps = max(1, int(self.steps * min(max(factor, 0.1), 4.0)))
