"""Ctrl-C ends a command in one way, whatever it hits: an import, for instance, turns it into errors of its own."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Self

from nlosrender.errors import IncompleteRender, InterruptedRender


class InterruptWatch:
    """Inside its block, Ctrl-C becomes KeyboardInterrupt, and so does every error that comes after it.

    Renders hold the signal back while they save; what they say of it passes, and so does success.
    """

    def __init__(self) -> None:
        self._came = False

    def __enter__(self) -> Self:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # shells let background jobs ignore it
            signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        explained = isinstance(error, (InterruptedRender, IncompleteRender))
        succeeded = error is None or (isinstance(error, SystemExit) and not error.code)
        if self._came and not explained and not succeeded:
            raise KeyboardInterrupt from error

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self._came = True
        raise KeyboardInterrupt
