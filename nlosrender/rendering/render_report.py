"""Progress, warnings and reports of a render."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from nlosrender.files.capture_results import CaptureResults

Progress = Callable[[float], None]  # share of the work that is done, in [0, 1]
Warn = Callable[[str], None]  # one warning


@dataclass(frozen=True)
class Standing:
    """How many work items of a render, or captures of a sweep, are finished."""

    what: str  # they are: "units" (work items), "captures"
    done: int
    total: int
    error: float | None = None  # relative L2 error of H over what is finished; None: nothing is, or it is not known


Watch = Callable[[Standing], None]  # after every work item

STAGES = ("scene", "compile", "render", "compress", "write")


@dataclass
class Stopwatch:
    """Seconds spent per stage; compressing and writing overlap with the rendering of the next work item."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    begun: float = field(default_factory=time.perf_counter)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def report(self) -> dict[str, float]:
        """Return seconds per stage and ``total`` since the stopwatch was made."""
        return self.seconds | {"total": time.perf_counter() - self.begun}


@dataclass(frozen=True)
class Monitor:
    """Where a render reports its seconds, progress, warnings and finished items."""

    stopwatch: Stopwatch
    progress: Progress
    warn: Warn
    watch: Watch


@dataclass(frozen=True, kw_only=True)
class RenderReport(CaptureResults):
    """Report of a finished render."""

    output: Path
    engine: str
    reason: str  # why this engine
    variant: str  # Mitsuba variant
    part: str | None  # which part of the capture; None: all of it
    units: int  # work items it was cut into
    resumed_units: int  # of them, finished by an earlier run
    n_bins: int
    n_triangles: int
    seconds: dict[str, float]  # of this run
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Warnings:
    """Warnings, each emitted once."""

    warn: Warn
    emitted: dict[str, None] = field(default_factory=dict)  # in the order they were emitted

    def emit(self, texts: Iterable[str]) -> None:
        """Pass on those that are new."""
        for text in texts:
            if text not in self.emitted:
                self.emitted[text] = None
                self.warn(text)
