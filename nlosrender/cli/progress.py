"""What a command tells on stderr while it works: a bar on a terminal, lines in a log, and warnings in both."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nlosrender.rendering.render_report import Progress, Standing, Warn


class Telling(NamedTuple):
    """Whom a command tells what."""

    progress: Progress
    warn: Warn
    watch: Callable[[Standing], None]


@contextmanager
def progress_bar(label: str, hidden: bool) -> Iterator[Telling]:
    """Tell of the work inside the block; ``hidden`` silences everything but warnings.

    A terminal that can redraw a line gets a bar; anything else, such as the log of a batch job, gets lines.
    """
    if hidden:
        yield Telling(lambda share: None, _warn, lambda standing: None)
    elif _can_redraw():
        with _bar(label) as telling:
            yield telling
    else:
        from nlosrender.cli.progress_log import ProgressLog

        with ProgressLog(label, _print) as log:
            yield Telling(log.progress, _warn, log.watch)


def _can_redraw() -> bool:
    """Tell whether stderr is a terminal whose width is known and that goes back to the beginning of a line."""
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return False
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns > 0  # 0: nobody told it, as in some containers
    except (OSError, ValueError):  # not a file, yet says that it is a terminal
        return True


@contextmanager
def _bar(label: str) -> Iterator[Telling]:
    from tqdm import tqdm

    layout = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"
    with tqdm(total=1.0, desc=label, bar_format=layout, leave=False) as bar:

        def progress(share: float) -> None:
            with suppress(OSError):  # the terminal is gone: no reason to stop working
                bar.update(max(0.0, min(share, 1.0) - bar.n))

        def warn(text: str) -> None:
            with suppress(OSError):
                tqdm.write(f"warning: {text}", file=sys.stderr)

        yield Telling(progress, warn, lambda standing: None)


def _warn(text: str) -> None:
    _print(f"warning: {text}")


def _print(line: str) -> None:
    with suppress(OSError):  # a full disk under the log, a pipe nobody reads: no reason to stop working
        print(line, file=sys.stderr, flush=True)
