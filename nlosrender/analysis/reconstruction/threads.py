"""Independent parts of a reconstruction in threads: numpy and the FFTs release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed

from threadpoolctl import threadpool_limits

from nlosrender.rendering.render_report import Progress


def in_threads(work: Callable[[int], None], count: int, progress: Progress = lambda share: None) -> None:
    """Run ``work(i)`` for every i below ``count`` on all processors this program may use.

    Raises
    ------
    Exception
        Whatever ``work`` raises; what has not begun by then is left out.
    """
    # The matrix products are small: threads of BLAS would wait for each other, 25 times as long as the work takes
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        jobs = [pool.submit(work, number) for number in range(count)]
        try:
            for done, job in enumerate(as_completed(jobs)):
                job.result()
                progress((done + 1) / count)
        finally:
            for job in jobs:
                job.cancel()


def portion(progress: Progress, done: float, share: float) -> Progress:
    """Return the progress of one piece of work that is ``share`` of the whole, of which ``done`` is done before."""
    return lambda part: progress(done + share * part)
