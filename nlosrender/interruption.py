"""Signals that end the program, deferred: past imports and HDF5 calls, and until a work item is finished."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, a batch system's notice, a closed terminal


@dataclass
class StopRequest:
    """Whether the user or the system has asked the program to end."""

    signal_name: str | None = None  # of the first signal that came

    @property
    def came(self) -> bool:
        """Whether a signal came."""
        return self.signal_name is not None


class _RequestHandler:
    """Records the first signal; the second one interrupts."""

    def __init__(self) -> None:
        self.request = StopRequest()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.request.came:
            raise KeyboardInterrupt
        self.request.signal_name = signal.Signals(number).name


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Record the first of ``SIGNALS`` inside the block instead of acting on it; the second one interrupts.

    A block inside another one shares its request. Outside the main thread no signal ever comes.

    Raises
    ------
    KeyboardInterrupt
        A second signal came inside the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield StopRequest()
        return
    outer = signal.getsignal(signal.SIGINT)
    if isinstance(outer, _RequestHandler):
        yield outer.request
        return
    handler = _RequestHandler()
    with _handled_by(handler):
        yield handler.request


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back ``SIGNALS`` inside the block and deliver the last of them right after it.

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

    with _handled_by(hold):
        yield
    if held:
        signal.raise_signal(held[-1])


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    # None: not installed by Python, which could not restore it. SIG_IGN: a background job of a shell ignores Ctrl-C.
    mine = [number for number in SIGNALS if handlers[number] not in (None, signal.SIG_IGN)]
    for number in mine:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, handlers[number])
