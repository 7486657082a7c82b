"""An unfinished capture, read from its journal: what is finished, whether a process goes on with it, the time left."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nlosrender.errors import FileError
from nlosrender.files.partial.journal import JOURNAL, is_in_use, read_records
from nlosrender.files.partial.work_item_log import JournalState
from nlosrender.files.reading.reader import explained_read

STALE_SECONDS = 900.0  # without a byte written: states of work items in flight come every minute or so
UnfinishedState = Literal["running", "stale", "stopped"]


@dataclass(frozen=True, eq=False)
class Unfinished:
    """The journal of an unfinished capture, and what the files beside it say."""

    folder: Path
    journal: JournalState
    in_use: bool | None  # whether a process has it open; None: the file system does not say
    silent_seconds: float  # since anything was written

    def state(self, stale_after: float = STALE_SECONDS) -> UnfinishedState:
        """Return ``running``, ``stopped``, or ``stale``: a process has it open, or may have, but writes nothing."""
        if self.in_use is False:
            return "stopped"
        return "stale" if self.silent_seconds > stale_after else "running"

    @property
    def finished_units(self) -> int:
        """Work items that are finished."""
        return len(self.journal.finished.items)

    @property
    def units(self) -> int | None:
        """Work items in all; None: no run has told yet."""
        units = self.journal.run.get("units")
        return units if isinstance(units, int) else None

    @property
    def seconds_left(self) -> float | None:
        """The time that the units left will take at the pace of this run; None: it has none yet, or is not known."""
        begun, done, now = self.journal.run.get("begun"), self.journal.n_in_run, time.time()
        if self.units is None or self.in_use is False or not done or not isinstance(begun, (int, float)):
            return None
        pace = max(now - self.silent_seconds - begun, 0.0) / done
        return max(pace * (self.units - self.finished_units) - self.silent_seconds, 0.0)

    @property
    def run_by(self) -> str:
        """Process and machine of the newest run."""
        run = self.journal.run
        return f"process {run['process']} on {run['machine']}" if {"process", "machine"} <= run.keys() else ""


def is_unfinished(path: str | Path) -> bool:
    """Return whether a path is the folder of an unfinished capture.

    Raises
    ------
    FileError
        Folders above it may not be looked into.
    """
    with explained_read(Path(path)):
        return (Path(path) / JOURNAL).is_file()


def read_unfinished(folder: Path) -> Unfinished:
    """Read the journal of an unfinished capture, which may be in use.

    Raises
    ------
    FileError
        There is none, or it is damaged.
    """
    with explained_read(folder):
        in_use = is_in_use(folder / JOURNAL)
        state = JournalState.from_records(read_records(folder / JOURNAL))
        newest = max((entry.stat().st_mtime for entry in folder.iterdir()), default=0.0)
    return Unfinished(folder, state, in_use, max(time.time() - newest, 0.0))


def partial_summary(folder: str | Path) -> dict[str, Any]:
    """Return what the journal of an unfinished capture holds, as plain values.

    Raises
    ------
    FileError
        There is no journal, or it is empty.
    """
    folder = Path(folder)
    found = read_unfinished(folder)
    if not found.journal.first:
        raise FileError(f"{folder}: nothing has been rendered into it yet")
    tally, identity = found.journal.finished, found.journal.first["identity"]
    confocal = identity["config"].get("capture", {}).get("scan_type") == "confocal"
    pairs = sum(sensors.size * (1 if confocal else lasers.size) for sensors, lasers in tally.items)
    error = tally.sums.error_estimate
    return {
        "file": str(folder),
        "unfinished": True,
        "state": found.state(),
        "name": identity["config"].get("name"),
        "part": identity.get("part"),
        "finished_units": found.finished_units,
        "units": found.units,
        "finished_pairs": pairs,
        "size_of_chunks": tally.n_bytes,
        "error_estimate": error if error < float("inf") else None,
        "render_seconds": tally.sums.seconds,
        "seconds_left": found.seconds_left,
        "last_begun_by": found.run_by,
    }
