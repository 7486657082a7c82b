"""How several processes share one capture: the memory of each, and the size of a work item."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from nlosrender.capture.plan import MAX_ITEM_SAMPLES
from nlosrender.engine.backend.start import PROCESS_BYTES, physical_memory
from nlosrender.errors import ConfigError

# of a work item that travels: 64 MB with the variance before packing, which a network carries and a dying worker loses
MAX_SHIPPED_SAMPLES = 2**23
MIN_ITEMS_PER_WORKER = 4  # so that all workers are busy until near the end
_KEY = "render.memory_limit"
MIN_PROCESS_BYTES = 1.5 * PROCESS_BYTES  # of a process, where the user sets no limit


@dataclass(frozen=True)
class ProcessLayout:
    """How many processes render a capture."""

    workers: int = 0  # processes that render, each one work item at a time; 0: this process does
    memory_shares: int = 1  # processes that share ``render.memory_limit``; 1: each may take all of it

    def memory_limit(self, limit: int | None) -> int | None:
        """Return the limit of one process [bytes], from the user's for all that share it; None: none given.

        Raises
        ------
        ConfigError
            The share of one is below what the program itself takes.
        """
        if self.memory_shares == 1:
            return limit
        if limit is None:
            return int(max(MIN_PROCESS_BYTES, physical_memory() // 4 / self.memory_shares))
        share, least = limit // self.memory_shares, self.memory_shares * PROCESS_BYTES
        if share <= PROCESS_BYTES:
            message = (
                f"got {limit / 1e6:.0f} MB, of which the program takes {PROCESS_BYTES / 1e6:.0f} MB in each process "
                f"before any histogram: need more than {least / 1e6:.0f} MB, or fewer --workers."
            )
            raise ConfigError.at(_KEY, message)
        return share

    @contextmanager
    def named(self, limit: int | None) -> Iterator[None]:
        """Add to issues of the memory limit that it is shared, and how large the share of one process is."""
        try:
            yield
        except ConfigError as error:
            if self.memory_shares == 1 or limit is None:
                raise
            share = f"{limit // self.memory_shares / 1e6:.0f} MB"
            shared = f"It is shared by {self.workers} workers and this process, {share} each."
            raise ConfigError(
                [
                    replace(found, message=f"{found.message} {shared}") if found.key == _KEY else found
                    for found in error.issues
                ]
            ) from error

    @property
    def max_item_samples(self) -> int:
        """Samples of a work item at most."""
        return MAX_SHIPPED_SAMPLES if self.workers else MAX_ITEM_SAMPLES

    @property
    def min_items(self) -> int:
        """Work items a capture is cut into, where it can be."""
        return max(1, MIN_ITEMS_PER_WORKER * self.workers)


ONE_PROCESS = ProcessLayout()
