"""Progress of a long call: a bar where one is asked for, and warnings that point at the user's own line."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeAlias

from nlosrender.errors import NlosWarning

if TYPE_CHECKING:
    from tqdm import tqdm

    from nlosrender.rendering.render_report import Progress

Wanted: TypeAlias = "bool | Callable[[float], None]"  # True: a bar; a function: called with the share of the work done
LAYOUT = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"


@contextmanager
def progress_bar(label: str, bar_type: type[tqdm[Any]]) -> Iterator[Progress]:
    """Draw a bar while the block runs; what it yields is called with the share of the work done, in [0, 1]."""
    with bar_type(total=1.0, desc=label, bar_format=LAYOUT, leave=False) as bar:

        def progress(share: float) -> None:
            with suppress(OSError):  # the terminal is gone: no reason to stop working
                bar.update(max(0.0, min(share, 1.0) - bar.n))

        yield progress


@contextmanager
def reported(wanted: Wanted, label: str) -> Iterator[Progress]:
    """Yield what a computation calls with its progress; a notebook gets a bar of its own kind."""
    if callable(wanted):
        yield wanted
    elif not wanted:
        yield lambda share: None
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # tqdm's advice to install ipywidgets; its bar of text will do
            from tqdm import auto
        with progress_bar(label, auto.tqdm) as progress:
            yield progress


def warn_caller(text: str) -> None:
    """Emit a warning of the program at the line that called it."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and _is_inner(frame.f_globals.get("__name__", "")):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, NlosWarning, stacklevel=level)


def _is_inner(module: str) -> bool:
    return module.partition(".")[0] in ("nlosrender", "contextlib")
