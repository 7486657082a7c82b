"""The typer application and its one error handler.

Command modules import what they need inside the command: ``--help`` must not wait for Mitsuba, numpy or pydantic.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Annotated, NoReturn

import typer

from nlosrender import __version__
from nlosrender.cli import (
    bench_command,
    check_engines_command,
    compare_command,
    config_commands,
    export_command,
    file_commands,
    frames_command,
    machine_commands,
    merge_command,
    paper_command,
    plan_command,
    reconstruct_command,
    render_command,
)
from nlosrender.cli.interrupt_watch import InterruptWatch
from nlosrender.cli.json_output import OUTPUT, issues_of
from nlosrender.cli.streams import open_closed_streams, print_any_name
from nlosrender.errors import EXIT_FAILURE, EXIT_INTERRUPTED, NlosError, ValidationIssue

app = typer.Typer(
    name="nlosrender",
    help="Simulate non-line-of-sight captures: one YAML in, one Z-NLOS HDF5 file out.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
render_command.register(app)
merge_command.register(app)
plan_command.register(app)
config_commands.register(app)
file_commands.register(app)
frames_command.register(app)
reconstruct_command.register(app)
export_command.register(app)
machine_commands.register(app)
compare_command.register(app)
check_engines_command.register(app)
bench_command.register(app)
paper_command.register(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Simulate non-line-of-sight captures: one YAML in, one Z-NLOS HDF5 file out."""


def main() -> None:
    """Run the command line; turn every explained error into a message on stderr and its exit code."""
    open_closed_streams()
    print_any_name()
    try:
        with InterruptWatch():
            app()
    except NlosError as error:
        message = f"error: {error}" if "\n" not in str(error) else f"errors:\n{error}"
        _end(message, error.exit_code, str(error).splitlines(), issues_of(error))
    except KeyboardInterrupt:
        _end("interrupted", EXIT_INTERRUPTED, ["interrupted"])
    except OSError as error:  # commands explain those of their files: what is left is standard output, mostly
        message = f"{error}. Check the disk, and where the output goes."
        _end(f"error: {message}", EXIT_FAILURE, [message])
    except SystemExit as error:  # of mistakes in the arguments, which typer has printed
        if error.code:
            told = getattr(error.__context__, "format_message", str)()
            _end(None, error.code if isinstance(error.code, int) else EXIT_FAILURE, told.splitlines())
        raise


def _end(message: str | None, exit_code: int, parts: Iterable[str], issues: Iterable[ValidationIssue] = ()) -> NoReturn:
    with suppress(OSError):  # nobody listens any more: the exit code still tells
        if message is not None:
            typer.echo(message, err=True)
    with suppress(OSError):
        OUTPUT.print_failure(parts, exit_code, issues)
    sys.exit(exit_code)
