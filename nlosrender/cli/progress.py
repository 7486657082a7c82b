"""What a command reports on stderr while it works: a bar on a terminal, lines in a log, and warnings in both."""

from __future__ import annotations

import math
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, Self

from nlosrender.api.progress_bar import progress_bar
from nlosrender.readable import readable_duration

if TYPE_CHECKING:
    from nlosrender.rendering.render_report import Progress, Standing, Warn


class Listeners(NamedTuple):
    """What a computation calls with its progress, its warnings and what is finished."""

    progress: Progress
    warn: Warn
    watch: Callable[[Standing], None]


@dataclass(frozen=True)
class LogIntervals:
    """How often a log gets a line; the defaults keep the log of a day's render below 1500 lines."""

    first_seconds: float = 5.0  # before the first line: a short command reports when it is done
    min_seconds: float = 10.0  # between two lines
    min_share: float = 0.05  # of the work between two lines
    max_seconds: float = 60.0  # without a line


@contextmanager
def reporting(label: str, quiet: bool, intervals: LogIntervals = LogIntervals()) -> Iterator[Listeners]:
    """Report the work inside the block; ``quiet`` silences everything but warnings.

    A terminal that can redraw a line gets a bar; anything else, such as the log of a batch job, gets lines.
    """
    if quiet:
        yield Listeners(lambda share: None, _warn, lambda standing: None)
    elif _can_redraw():
        with _bar(label) as listeners:
            yield listeners
    else:
        with ProgressLog(label, _print_line, intervals) as log:
            yield Listeners(log.progress, _warn, log.watch)


def _can_redraw() -> bool:
    """Return whether stderr is a terminal whose width is known and that goes back to the beginning of a line."""
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return False
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns > 0  # 0: not set, as in some containers
    except (OSError, ValueError):  # not a file, yet says that it is a terminal
        return True


@contextmanager
def _bar(label: str) -> Iterator[Listeners]:
    from tqdm import tqdm

    with progress_bar(label, tqdm) as progress:

        def warn(text: str) -> None:
            with suppress(OSError):
                tqdm.write(f"warning: {text}", file=sys.stderr)

        yield Listeners(progress, warn, lambda standing: None)


def _warn(text: str) -> None:
    _print_line(f"warning: {text}")


def _print_line(line: str) -> None:
    with suppress(OSError):  # a full disk under the log, a closed pipe: no reason to stop working
        print(line, file=sys.stderr, flush=True)


class ProgressLog:
    """Prints a line every few per cent and at least every minute; by a thread, since work items take minutes.

    ``write`` takes each line, which begins with ``label``; ``clock`` returns seconds since some moment.
    """

    def __init__(
        self,
        label: str,
        write: Callable[[str], None],
        intervals: LogIntervals,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._label, self._write, self._intervals, self._clock = label, write, intervals, clock
        self._host = socket.gethostname()
        self._standings: dict[str, Standing] = {}
        self._share, self._first_share = 0.0, 0.0
        self._begun = clock()
        self._last_at, self._last_share = -math.inf, 0.0  # of the last line
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._write_regularly, name="progress", daemon=True)

    def progress(self, share: float) -> None:
        """Note the share of the work that is done."""
        self._share = max(self._share, min(share, 1.0))
        self.write_if_due()

    def watch(self, standing: Standing) -> None:
        """Note how many units, or captures, are finished."""
        if not self._standings and standing.total:
            # by earlier runs: no measure for the speed of this one
            self._first_share = self._share = standing.done / standing.total
        self._standings[standing.what] = standing
        self.write_if_due()

    def write_if_due(self) -> None:
        """Print a line unless the last one is recent."""
        with self._lock:
            now = self._clock()
            if math.isinf(self._last_at):
                due = now - self._begun >= self._intervals.first_seconds
            else:
                moved = self._share - self._last_share >= self._intervals.min_share
                wait = self._intervals.min_seconds if moved else self._intervals.max_seconds
                due = now - self._last_at >= wait
            if due:
                self._last_at, self._last_share = now, self._share
                self._write(self._line(now - self._begun))

    def _line(self, seconds: float) -> str:
        parts = [f"{each.done} of {each.total} {each.what}" for each in self._standings.values()]
        parts.append(f"{100 * self._share:.0f} %")
        parts += [f"error so far {_error(each.error)}" for each in self._standings.values() if each.error is not None]
        gained = self._share - self._first_share
        if self._share >= 1:
            parts.append(f"after {readable_duration(seconds)}")
        elif gained > 0:
            parts.append(f"about {readable_duration(seconds * (1 - self._share) / gained)} left")
        return f"{self._label}: {', '.join(parts)}, on {self._host}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        if error is None and not math.isinf(self._last_at):  # a log that has begun has an end
            self._share = 1.0
            self._write(self._line(self._clock() - self._begun))

    def _write_regularly(self) -> None:
        while not self._over.wait(1.0):
            self.write_if_due()


def _error(error: float) -> str:
    return f"{100 * error:.2g} %" if math.isfinite(error) else "unknown"
