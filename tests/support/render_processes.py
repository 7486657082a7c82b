"""``nlosrender`` in processes of its own, and how far their renders have come: for tests that stop or damage them."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from nlosrender.files.partial.journal import read_records
from nlosrender.files.partial.work_item_log import JournalState

Process = subprocess.Popen[str]


def plate_scene(rest: str) -> str:
    """Return the text of a configuration: a plate before the wall, and ``rest`` below it."""
    return f"""
scene:
  relay_wall: {{type: rectangle, width: 2.0, height: 1.6}}
  hidden_geometry:
    - {{type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9], normal: [0, 0, -1]}}
{rest}"""


# 14 units of a fraction of a tenth of a second
INTERRUPTED = plate_scene("""\
capture:
  scan_type: exhaustive
  sensor_grid: {nx: 4, ny: 3}
  laser_grid: {nx: 2, ny: 7}
  account_first_and_last_bounces: false
time_axis: {start_opl: 1.6, bin_width_opl: 0.01, n_bins: 300}
render: {max_bounces: 4, engine: path, spp: 4000, memory_limit: 402MB}
output: {path: a.hdf5}
""")
N_UNITS = 14
PARTIAL = ".a.hdf5.partial"


def start(folder: Path, *arguments: object, file_limit: int | None = None, own_group: bool = False) -> Process:
    """Start ``nlosrender ARGUMENTS`` in ``folder``.

    Parameters
    ----------
    file_limit
        Bytes that a file may have: writes beyond it fail as on a full disk.
    own_group
        As a terminal gives it: a signal to the group reaches the processes that this one starts.
    """

    def bounded() -> None:
        if file_limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, resource.RLIM_INFINITY))

    command = [sys.executable, "-m", "nlosrender", *map(str, arguments)]
    return subprocess.Popen(
        command,
        cwd=folder,
        text=True,
        preexec_fn=bounded,
        start_new_session=own_group,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def start_render(folder: Path, *options: object, **how: Any) -> Process:
    """Start a render of ``scene.yaml``; ``how`` as for ``start``."""
    return start(folder, "render", "scene.yaml", *options, **how)


def ended(process: Process) -> tuple[int, str]:
    """Return the exit code and what was printed on stderr, which is no traceback."""
    _, errors = process.communicate(timeout=300)
    assert "Traceback" not in errors, errors
    return process.returncode, errors


def report_of(process: Process) -> dict[str, Any]:
    """Return the report of a render with ``--json`` that ends well."""
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    report: dict[str, Any] = json.loads(output)
    return report


def saved_units(folder: Path) -> int:
    """Return how many units of ``a.hdf5`` are saved; a journal without samples is left over from a finished render."""
    partial = folder / PARTIAL
    with suppress(FileNotFoundError):  # not yet, or no longer
        if any(partial.glob("samples.*")):
            return len(JournalState.from_records(read_records(partial / "journal")).finished.items)
    return 0


def wait_for_units(folder: Path, process: Process, count: int) -> int:
    """Wait until so many units of ``a.hdf5`` are saved, or the process ends; return how many are."""
    units = saved_units(folder)
    while units < count and process.poll() is None:
        time.sleep(0.005)
        units = saved_units(folder)
    return units
