"""Progress as lines of a log: how much is done, how large the error is, how long it takes yet, and where it runs."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

from nlosrender.readable import readable_duration

if TYPE_CHECKING:
    from nlosrender.rendering.render_report import Standing

FIRST_SECONDS = 5.0  # before the first line: a short command says what it has to say when it is done
LEAST_SECONDS = 10.0  # between two lines
LEAST_SHARE = 0.05  # of the work between two lines
MOST_SECONDS = 60.0  # without a line


class ProgressLog:
    """Prints a line every few per cent and, whatever happens, every minute; by a thread, since units take minutes.

    Parameters
    ----------
    label
        What every line begins with.
    write
        Takes a line.
    clock
        Seconds since some moment.
    """

    def __init__(self, label: str, write: Callable[[str], None], clock: Callable[[], float] = time.monotonic):
        self._label, self._write, self._clock = label, write, clock
        self._host = socket.gethostname()
        self._standings: dict[str, Standing] = {}
        self._share, self._first_share = 0.0, 0.0
        self._begun = clock()
        self._told_at, self._told_share = -math.inf, 0.0  # of the last line
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="progress", daemon=True)

    def progress(self, share: float) -> None:
        """Note the share of the work that is done."""
        self._share = max(self._share, min(share, 1.0))
        self.tell()

    def watch(self, standing: Standing) -> None:
        """Note what is finished, of units or captures."""
        if not self._standings and standing.total:
            # by earlier runs: no measure for the speed of this one
            self._first_share = self._share = standing.done / standing.total
        self._standings[standing.what] = standing
        self.tell()

    def tell(self) -> None:
        """Print a line if one is due."""
        with self._lock:
            now = self._clock()
            since = now - max(self._told_at, self._begun)
            moved = self._share - self._told_share >= LEAST_SHARE
            first = math.isinf(self._told_at)
            if first and since < FIRST_SECONDS:
                return
            if not first and since < (LEAST_SECONDS if moved else MOST_SECONDS):
                return
            self._told_at, self._told_share = now, self._share
            self._write(self.line(now - self._begun))

    def line(self, spent: float) -> str:
        """Return what there is to say ``spent`` seconds [s] after the beginning."""
        parts = [f"{each.done} of {each.total} {each.what}" for each in self._standings.values()]
        parts.append(f"{100 * self._share:.0f} %")
        parts += [f"error so far {_error(each.error)}" for each in self._standings.values() if each.error is not None]
        gained = self._share - self._first_share
        if self._share >= 1:
            parts.append(f"after {readable_duration(spent)}")
        elif gained > 0:
            parts.append(f"about {readable_duration(spent * (1 - self._share) / gained)} left")
        return f"{self._label}: {', '.join(parts)}, on {self._host}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        if error is None and not math.isinf(self._told_at):  # a log that has begun has an end
            self._share = 1.0
            self._write(self.line(self._clock() - self._begun))

    def _look(self) -> None:
        while not self._over.wait(1.0):
            self.tell()


def _error(error: float) -> str:
    return f"{100 * error:.2g} %" if math.isfinite(error) else "unknown"
