"""The summary of an unfinished capture, read from its journal."""

from __future__ import annotations

from pathlib import Path

from nlosrender.errors import FileError
from nlosrender.files.partial.journal import JOURNAL, read_records
from nlosrender.files.partial.work_item_log import JournalState
from nlosrender.files.reading.reader import explained_read


def is_unfinished(path: str | Path) -> bool:
    """Return whether a path is the folder of an unfinished capture.

    Raises
    ------
    FileError
        Folders above it may not be looked into.
    """
    with explained_read(Path(path)):
        return (Path(path) / JOURNAL).is_file()


def partial_summary(folder: str | Path) -> dict[str, object]:
    """Return what the journal of an unfinished capture holds, as plain values.

    Raises
    ------
    FileError
        There is no journal, or it is empty.
    """
    folder = Path(folder)
    with explained_read(folder):
        state = JournalState.from_records(read_records(folder / JOURNAL))
    if not state.first:
        raise FileError(f"{folder}: nothing has been rendered into it yet")
    tally, identity = state.finished, state.first["identity"]
    confocal = identity["config"].get("capture", {}).get("scan_type") == "confocal"
    pairs = sum(sensors.size * (1 if confocal else lasers.size) for sensors, lasers in tally.items)
    error = tally.sums.error_estimate
    return {
        "file": str(folder),
        "unfinished": True,
        "name": identity["config"].get("name"),
        "part": identity.get("part"),
        "finished_units": len(tally.items),
        "finished_pairs": pairs,
        "size_of_chunks": tally.n_bytes,
        "error_estimate": error if error < float("inf") else None,
        "render_seconds": tally.sums.seconds,
        "last_begun_by": f"process {state.first.get('process')} on {state.first.get('machine')}",
    }
