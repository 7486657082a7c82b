"""Runs commands for ``containment``: one JSON list of arguments per line on stdin, one JSON outcome per line back.

A program of its own, so that a crash of native code, a hang or a hunger for memory ends it and not the tests.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
import traceback


def main(memory_bytes: int) -> None:
    """Answer until stdin ends, with at most ``memory_bytes`` of address space."""
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers = os.fdopen(os.dup(1), "w")  # native code prints to descriptor 1
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    from typer.testing import CliRunner

    from nlosrender.cli.app import app
    from nlosrender.errors import NlosError

    for line in sys.stdin:
        begun = time.perf_counter()
        result = CliRunner().invoke(app, json.loads(line))
        error = result.exception
        message, trace, code = result.output, "", result.exit_code
        if isinstance(error, NlosError):
            message, code = str(error), error.exit_code
        elif error is not None and not isinstance(error, SystemExit):
            trace = "".join(traceback.format_exception(error))
        answers.write(json.dumps([code, message[-2000:], trace[-2000:], time.perf_counter() - begun]) + "\n")
        answers.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
