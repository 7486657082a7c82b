"""Passes: the short kernels that a render is cut into, for progress, interruption and saved states in between.

An engine renders a batch in stages (the gather of patches, the VPL subpaths or paths), and a stage in passes of about
``PASS_SECONDS``. The state between two passes is a ``Snapshot``; a process that resumes from it gets the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

PASS_SECONDS = 0.5  # of a kernel: Ctrl-C and the progress bar wait no longer; a launch costs about 10 ms, 2 % of it


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
    saved: SavedStages  # of an earlier run: finished stages, and the unfinished one
    finished: SavedStages = field(default_factory=dict)


class Passes:
    """Callbacks between passes: progress, saved states and interruption.

    Parameters
    ----------
    progress
        Called with the share of the work that is done, in [0, 1].
    look
        Called between passes with a function that makes the state; what it raises ends the render.
    saved
        State of an earlier render of the same batch, as ``look`` got it; empty: start from the beginning.
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
        """Return, once, the saved state of this stage; None: there is none, or none with that array."""
        saved = self._store.saved.get(self._name)
        return self._store.saved.pop(self._name) if saved is not None and array in saved.arrays else None

    def between(self, share: float, take: Callable[[], Snapshot]) -> None:
        """Report that ``share`` of the stage is done; ``take`` makes the state if it is to be saved.

        Raises
        ------
        Exception
            Whatever the caller ends the render with.
        """
        self._progress(share)
        self._store.look(lambda: self._store.finished | {self._name: take()})

    def finish(self, result: Snapshot) -> None:
        """Keep the result of a finished stage for later states, in place of the states of its parts."""
        self._progress(1.0)
        for saved in (self._store.finished, self._store.saved):
            for name in [name for name in saved if name.startswith(f"{self._name}/")]:
                del saved[name]
        self._store.finished[self._name] = result


@dataclass
class PassSize:
    """Number of loop steps of a kernel, adapted so that it takes about ``PASS_SECONDS``; results do not depend on it.

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
        """Stop the clock and set the steps of the next kernel."""
        factor = PASS_SECONDS / max(time.perf_counter() - self.begun, 1e-6)
        self.steps = max(1, int(self.steps * min(max(factor, 0.1), 4.0)))
