"""Signals end a command as KeyboardInterrupt, whatever exception the interrupted code makes of them."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Self

from nlosrender.cli.early_interrupt import leave_at_once
from nlosrender.errors import IncompleteRender, InterruptedRender
from nlosrender.interruption import SIGNALS


class InterruptWatch:
    """Inside its block, ``SIGNALS`` become KeyboardInterrupt, and so does every error that comes after one.

    InterruptedRender, IncompleteRender and success pass unchanged: renders hold the signals back while they save.
    After the block a signal ends the process at once.
    """

    def __init__(self) -> None:
        self._came = False
        self._watched: list[int] = []

    def __enter__(self) -> Self:
        for number in SIGNALS:
            # anything else is another program's wish: shells let background jobs ignore Ctrl-C
            if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL, leave_at_once):
                signal.signal(number, self._interrupt)  # not the system's way: it would leave half-written files
                self._watched.append(number)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number in self._watched:  # the rest is Python's way out, which shows a traceback of what interrupts it
            signal.signal(number, signal.SIG_DFL)
        explained = isinstance(error, (InterruptedRender, IncompleteRender))
        succeeded = error is None or (isinstance(error, SystemExit) and not error.code)
        if self._came and not explained and not succeeded:
            raise KeyboardInterrupt from error

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self._came = True
        raise KeyboardInterrupt
