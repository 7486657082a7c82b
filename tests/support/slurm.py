"""A stand-in for Slurm on one machine: ``sbatch``, ``srun``, ``scontrol`` and ``scancel`` that keep jobs in a folder.

Jobs wait until a test starts them, so that it can look in between and kill them; with ``SLURM_STUB_START`` in the
environment ``sbatch`` starts a job at once. As Slurm does, ``SBATCH_ARRAY_INX`` takes the place of a script's
``#SBATCH --array``, and ``--dependency=afterok:ID`` holds a job until all tasks of another have ended with code 0.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

STATE = "SLURM_STUB_FOLDER"
START = "SLURM_STUB_START"


class Slurm:
    """The commands in a folder of their own, and the jobs that were submitted.

    Attributes
    ----------
    environment
        In which the commands are found, and ``nlosrender`` is the one that is tested.
    """

    def __init__(self, folder: Path, **variables: str):
        self.jobs, bin_folder = folder / "jobs", folder / "bin"
        for needed in (self.jobs, bin_folder):
            needed.mkdir(parents=True)
        script = f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        script += "from support.slurm import main\nmain()\n"
        commands = dict.fromkeys(("sbatch", "srun", "scontrol", "scancel"), script)
        commands["nlosrender"] = f'#!/bin/sh\nexec {sys.executable} -m nlosrender "$@"\n'
        commands["dask"] = f'#!/bin/sh\nexec {sys.executable} -m dask "$@"\n'
        commands["python"] = f'#!/bin/sh\nexec {sys.executable} "$@"\n'
        for name, text in commands.items():
            (bin_folder / name).write_text(text)
            (bin_folder / name).chmod(0o755)
        path = f"{bin_folder}{os.pathsep}{os.environ['PATH']}"
        # commands change folders: names in PYTHONPATH may be relative
        modules = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)
        self.environment = {**os.environ, "PATH": path, "PYTHONPATH": modules, STATE: str(self.jobs), **variables}

    def waiting(self) -> list[str]:
        """Return the tasks that may start, as ``ID`` or ``ID_TASK``, in the order they were submitted."""
        return [
            name for name in _tasks(self.jobs) if _load(self.jobs, name)["state"] == "waiting" and self._is_free(name)
        ]

    def start(self, name: str) -> subprocess.Popen[str]:
        """Start a task in a process group of its own; what it prints goes to the test."""
        return _started(self.jobs, name, self.environment)

    def end(self, name: str, process: subprocess.Popen[str]) -> int:
        """Wait for a task and note how it ended, unless it has put itself back into the queue; return its code."""
        code = process.wait(timeout=300)
        task = _load(self.jobs, name)
        if task["state"] == "running":
            _save(self.jobs, name, task | {"state": "done" if code == 0 else "failed"})
        return code

    def _is_free(self, name: str) -> bool:
        after = _load(self.jobs, name)["after"]
        return after is None or all(
            _load(self.jobs, other)["state"] == "done" for other in _tasks(self.jobs) if other.split("_")[0] == after
        )


def main() -> None:
    """Do what the command does that this script is called as."""
    jobs, command, arguments = Path(os.environ[STATE]), Path(sys.argv[0]).name, sys.argv[1:]
    if command == "srun":
        os.execvp(arguments[0], arguments)
    if command == "sbatch":
        _submit(jobs, arguments)
    elif command == "scontrol":
        action, job = arguments
        assert action == "requeue", arguments
        name = next(name for name in _tasks(jobs) if _load(jobs, name)["job"] == job)
        _save(jobs, name, _load(jobs, name) | {"state": "waiting"})
    elif command == "scancel":
        for name in _tasks(jobs):
            task = _load(jobs, name)
            if task["job"] in arguments and task["pid"]:
                with suppress(ProcessLookupError):
                    os.killpg(task["pid"], signal.SIGTERM)


def _submit(jobs: Path, arguments: list[str]) -> None:
    options = dict(re.findall(r"--([a-z]+)=(\S+)", " ".join(arguments)))
    if "--wrap" in arguments:
        text = f"#!/bin/sh\n{arguments[arguments.index('--wrap') + 1]}\n"
    else:
        text = Path(arguments[-1]).read_text()
    array = re.search(r"^#SBATCH --array=(\S+)", text, re.MULTILINE)
    chosen = os.environ.get("SBATCH_ARRAY_INX", array[1]) if array else None
    first = len(_tasks(jobs)) + 1
    after = options.get("dependency", "").removeprefix("afterok:") or None
    common: dict[str, Any] = {"state": "waiting", "after": after, "folder": os.getcwd(), "pid": None}
    if chosen is None:
        names = [str(first)]
        tasks = [common | {"job": str(first), "array": {}}]
    else:
        low, high = map(int, chosen.split("-"))
        names = [f"{first}_{task}" for task in range(low, high + 1)]
        counts = {"SLURM_ARRAY_TASK_COUNT": str(high - low + 1), "SLURM_ARRAY_JOB_ID": str(first)}
        tasks = [
            common | {"job": str(first + at), "array": {**counts, "SLURM_ARRAY_TASK_ID": str(low + at)}}
            for at in range(high - low + 1)
        ]
    for name, task in zip(names, tasks, strict=True):
        script = jobs / f"{name}.sh"
        script.write_text(text)
        script.chmod(0o755)
        _save(jobs, name, task)
        if os.environ.get(START):
            _started(jobs, name, dict(os.environ), quiet=True)
    print(first if "--parsable" in arguments else f"Submitted batch job {first}")


def _started(jobs: Path, name: str, environment: dict[str, str], quiet: bool = False) -> subprocess.Popen[str]:
    task = _load(jobs, name)
    variables = {**environment, **task["array"], "SLURM_JOB_ID": task["job"]}
    output = subprocess.DEVNULL if quiet else None
    script, folder = [str(jobs / f"{name}.sh")], task["folder"]
    process = subprocess.Popen(
        script, cwd=folder, env=variables, text=True, start_new_session=True, stdout=output, stderr=output
    )
    _save(jobs, name, task | {"state": "running", "pid": process.pid})
    return process


def _tasks(jobs: Path) -> list[str]:
    return [path.stem for path in sorted(jobs.glob("*.json"), key=lambda path: [*map(int, path.stem.split("_"))])]


def _load(jobs: Path, name: str) -> dict[str, Any]:
    task: dict[str, Any] = json.loads((jobs / f"{name}.json").read_text())
    return task


def _save(jobs: Path, name: str, task: dict[str, Any]) -> None:
    new = jobs / f"{name}.new"
    new.write_text(json.dumps(task))
    new.replace(jobs / f"{name}.json")
