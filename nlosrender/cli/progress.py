"""A progress bar on stderr, and warnings that are printed above it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[float], None]  # told the share of the work that is done
Warn = Callable[[str], None]


@contextmanager
def progress_bar(label: str, hidden: bool) -> Iterator[tuple[Progress, Warn]]:
    """Show a bar while the block runs, on a terminal that can redraw a line; ``hidden`` silences warnings, too."""
    from tqdm import tqdm

    no_bar = True if hidden or os.environ.get("TERM") == "dumb" else None  # None: shown on a terminal alone
    layout = "{l_bar}{bar}| {elapsed}<{remaining}"
    with tqdm(total=1.0, disable=no_bar, desc=label, bar_format=layout, leave=False) as bar:

        def progress(share: float) -> None:
            bar.update(max(0.0, min(share, 1.0) - bar.n))

        def warn(text: str) -> None:
            if not hidden:
                tqdm.write(f"warning: {text}", file=sys.stderr)

        yield progress, warn
