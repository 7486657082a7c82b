"""How several processes share one capture: the memory of each, and the size of what one of them renders at a time."""

from __future__ import annotations

from dataclasses import dataclass

from nlosrender.capture.plan import UNIT_SAMPLES
from nlosrender.engine.backend import PROCESS_BYTES, physical_memory

# 64 MB with the variance, before it is packed: a message a network carries, and a loss a dying worker may cause
SHIPPED_SAMPLES = 2**23
UNITS_PER_WORKER = 4  # at least, where the capture can be cut so: the last units end at different times
LEAST_BYTES = 1.5 * PROCESS_BYTES  # of a process, where the user sets no limit


@dataclass(frozen=True)
class Sharing:
    """How many processes render a capture.

    Parameters
    ----------
    workers
        That render, each a unit at a time; 0: this process does.
    memory_shares
        Processes that share ``render.memory_limit``; 1: each may take all of it.
    """

    workers: int = 0
    memory_shares: int = 1

    def memory_limit(self, limit: int | None) -> int | None:
        """Return the limit of one process [bytes], from the user's for all that share it; None: none given."""
        if self.memory_shares == 1:
            return limit
        if limit is None:
            return int(max(LEAST_BYTES, physical_memory() // 4 / self.memory_shares))
        return limit // self.memory_shares

    @property
    def unit_samples(self) -> int:
        """Samples of a unit at most."""
        return SHIPPED_SAMPLES if self.workers else UNIT_SAMPLES

    @property
    def least_units(self) -> int:
        """Units a capture is cut into, where it can be."""
        return max(1, UNITS_PER_WORKER * self.workers)


ALONE = Sharing()
