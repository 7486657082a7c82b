"""Run the command line in this process: nothing is imported, and no kernel compiled, twice."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.errors import NlosError


@dataclass(frozen=True)
class Done:
    """What a command left behind."""

    returncode: int
    stdout: str
    stderr: str


def run(folder: Path, *arguments: object) -> Done:
    """Run ``nlosrender ARGUMENTS`` in ``folder``; explained errors end as ``cli.app.main`` ends them."""
    with contextlib.chdir(folder):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    error = result.exception
    if isinstance(error, NlosError):
        return Done(error.exit_code, result.stdout, f"{result.stderr}error: {error}\n")
    if error is not None and not isinstance(error, SystemExit):
        raise error
    return Done(result.exit_code, result.stdout, result.stderr)
