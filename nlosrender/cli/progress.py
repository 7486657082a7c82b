"""A progress bar on stderr, and warnings that are printed above it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[float], None]  # told the share of the work that is done
Warn = Callable[[str], None]


@contextmanager
def progress_bar(label: str, hidden: bool) -> Iterator[tuple[Progress, Warn]]:
    """Show a bar (only on a terminal) while the block runs; ``hidden`` silences it and the warnings."""
    from tqdm import tqdm

    layout = "{l_bar}{bar}| {elapsed}<{remaining}"
    with tqdm(total=1.0, disable=True if hidden else None, desc=label, bar_format=layout, leave=False) as bar:

        def progress(share: float) -> None:
            bar.update(max(0.0, min(share, 1.0) - bar.n))

        def warn(text: str) -> None:
            if not hidden:
                tqdm.write(f"warning: {text}", file=sys.stderr)

        yield progress, warn
