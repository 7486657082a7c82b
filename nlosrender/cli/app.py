"""The typer application and its one error handler.

Command modules import what they need inside the command: ``--help`` must not wait for Mitsuba, numpy or pydantic.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Annotated, Any, NoReturn

import typer

from nlosrender import __version__
from nlosrender.cli import dataset_commands
from nlosrender.cli.bench_command import bench
from nlosrender.cli.check_command import check
from nlosrender.cli.check_engines_command import check_engines
from nlosrender.cli.compare_command import compare
from nlosrender.cli.config_commands import new, schema, validate
from nlosrender.cli.dataset_commands import sheet
from nlosrender.cli.file_commands import export, frames, info, plot
from nlosrender.cli.import_command import import_
from nlosrender.cli.interrupt_watch import InterruptWatch
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.machine_commands import doctor
from nlosrender.cli.measure_command import measure
from nlosrender.cli.merge_command import merge
from nlosrender.cli.paper_command import paper
from nlosrender.cli.plan_command import plan
from nlosrender.cli.reconstruct_command import reconstruct
from nlosrender.cli.render_command import render
from nlosrender.cli.report_command import report
from nlosrender.cli.status_command import status
from nlosrender.cli.streams import give_up_stderr, open_closed_streams, print_any_name
from nlosrender.errors import EXIT_FAILURE, EXIT_INTERRUPTED, ConfigError, NlosError, ValidationIssue

app = typer.Typer(
    name="nlosrender",
    help="Simulate non-line-of-sight captures: one YAML in, one Z-NLOS HDF5 file out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


datasets = typer.Typer(help="Data sets: folders of captures.", no_args_is_help=True, rich_markup_mode=None)


def _add(command: Callable[..., Any], to: typer.Typer = app) -> None:
    """Add a command by its function's name; the last paragraph of the docstring, its example, follows the options."""
    text, _, example = inspect.cleandoc(command.__doc__ or "").rpartition("\n\nExample: ")
    to.command(command.__name__.rstrip("_").replace("_", "-"), help=text, epilog=f"Example: {example}")(command)


_COMMANDS: tuple[Callable[..., Any], ...] = (
    *(render, status, measure, merge, plan, new, import_, validate, schema, info, plot, frames, reconstruct, export),
    *(doctor, report, compare, check, check_engines, bench, paper, sheet),
)
for _command in _COMMANDS:
    _add(_command)
_add(dataset_commands.info, datasets)
_add(dataset_commands.pack, datasets)
app.add_typer(datasets, name="dataset")


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
        issues = error.issues if isinstance(error, ConfigError) else ()
        _end(message, error.exit_code, str(error).splitlines(), issues)
    except KeyboardInterrupt:
        _end("interrupted", EXIT_INTERRUPTED, ["interrupted"])
    except OSError as error:  # commands explain those of their files: what is left is standard output, mostly
        message = f"{error}. Check the disk, and where the output goes."
        _end(f"error: {message}", EXIT_FAILURE, [message])
    except SystemExit as error:  # of mistakes in the arguments, which typer has printed
        if error.code:
            printed = getattr(error.__context__, "format_message", str)()
            _end(None, error.code if isinstance(error.code, int) else EXIT_FAILURE, printed.splitlines())
        raise


def _end(message: str | None, exit_code: int, parts: Iterable[str], issues: Iterable[ValidationIssue] = ()) -> NoReturn:
    try:
        if message is not None:
            typer.echo(message, err=True)
    except OSError:  # standard error is closed or full; the exit code still reports the failure
        give_up_stderr()
    with suppress(OSError):
        OUTPUT.print_failure(parts, exit_code, issues)
    sys.exit(exit_code)
