"""Independent parts of a reconstruction in threads: numpy and the FFTs release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable

from nlosrender.files.thread_pool import in_order
from nlosrender.rendering.render_report import Progress


def in_threads(work: Callable[[int], None], count: int, progress: Progress = lambda share: None) -> None:
    """Run ``work(i)`` for every i below ``count`` on all processors this program may use.

    Raises
    ------
    Exception
        Whatever ``work`` raises; what has not begun by then is left out.
    """
    for done, _ in enumerate(in_order(work, range(count))):
        progress((done + 1) / count)


def portion(progress: Progress, done: float, share: float) -> Progress:
    """Return the progress of one piece of work that is ``share`` of the whole, of which ``done`` is done before."""
    return lambda part: progress(done + share * part)
