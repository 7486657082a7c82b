"""Ctrl-C waits while HDF5 works: an exception raised inside its callbacks leaves its objects in ruins."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back SIGINT and SIGTERM inside the block and deliver the last of them right after it.

    An exception that leaves the block takes precedence. Outside the main thread nothing needs to be held back:
    Python delivers signals to the main thread only.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C was pressed inside the block (or whatever else the installed handler raises).
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        held.append(number)

    # None: installed by something other than Python, and not to be restored by it
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    mine = [number for number in SIGNALS if handlers[number] is not None]
    for number in mine:
        signal.signal(number, hold)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, handlers[number])
    if held:
        signal.raise_signal(held[-1])
