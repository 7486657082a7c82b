"""Commands run where their death is an observation: exit code, message, traceback, seconds, signal, time-out."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

WORKER = Path(__file__).parent / "worker.py"
MEMORY = 4 * 2**30  # bytes of address space; Mitsuba, LLVM and a small render take 2.5 GiB of it
SECONDS = 60.0  # for one command; the machine may be busy with others


@dataclass(frozen=True)
class Outcome:
    """What came of one command."""

    exit_code: int | None  # None: the process died
    message: str  # of the error, or what was printed
    trace: str  # of an exception that the program did not explain
    seconds: float
    death: str = ""  # signal or time-out

    @property
    def fault(self) -> str:
        """What no input may bring about; empty when there is nothing to complain of."""
        if self.death:
            return self.death
        if self.trace:
            return "traceback: " + self.trace.strip().splitlines()[-1]
        if self.exit_code not in (0, 1, 2, 3, 4, 5):
            return f"exit code {self.exit_code}"
        return "" if self.exit_code == 0 or self.message.strip() else "an error without a message"


class Containment:
    """A worker that is started again when it dies."""

    def __init__(self, memory: int = MEMORY, seconds: float = SECONDS):
        self.memory, self.seconds = memory, seconds
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, *arguments: str | Path) -> Outcome:
        """Run one command line."""
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps([str(argument) for argument in arguments]) + "\n")
        process.stdin.flush()
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            if not selector.select(self.seconds):
                self._end()
                return Outcome(None, "", "", self.seconds, f"no answer within {self.seconds:g} s")
        answer = process.stdout.readline()
        if not answer:
            code = process.wait()
            self._end()
            name = signal.Signals(-code).name if code < 0 else f"exit {code}"
            return Outcome(None, "", "", 0.0, f"the process died: {name}")
        return Outcome(*json.loads(answer))

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            command: Sequence[str] = (sys.executable, str(WORKER), str(self.memory))
            environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env=environment,
            )
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
