"""Ctrl-C during the import of the command line, which takes a fifth of a second.

Imported before everything else, so it imports next to nothing.
"""

from __future__ import annotations

import os
import signal
from types import FrameType

EXIT_INTERRUPTED = 130  # as in errors, whose import would come too early


def leave_at_once(number: int, frame: FrameType | None) -> None:
    """End the process: nothing has begun, and an exception would come out of the middle of an import."""
    os.write(2, b"interrupted\n")
    os._exit(EXIT_INTERRUPTED)


def leave_on_interrupt() -> None:
    """Let Ctrl-C end the process until ``InterruptWatch`` takes over; where it is ignored, it stays so."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, leave_at_once)
