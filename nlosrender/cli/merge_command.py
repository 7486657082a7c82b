"""``nlosrender merge``: the parts of a capture into one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT


def register(app: typer.Typer) -> None:
    """Add ``merge`` to ``app``."""
    app.command(
        "merge",
        epilog="Example: nlosrender merge part*.hdf5 -o whole.hdf5   "
        "(creates whole.hdf5, the capture that one render without --shard would have written)",
    )(merge)


def merge(
    parts: Annotated[
        list[Path],
        typer.Argument(
            metavar="PART...", help="Files rendered with --shard or --lasers, in any order.", readable=False
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.", readable=False)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that holds another capture.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no report; warnings stay.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as one JSON object.")] = False,
) -> None:
    """Put the parts of a capture together; what is missing, there twice, damaged or not its own is named."""
    from nlosrender.cli.progress import progress_bar
    from nlosrender.cli.stated_error import energies_by_bounce, stated_error_lines
    from nlosrender.files.parts.merge import merge_captures

    with progress_bar("merge", hidden=quiet) as (progress, _, _):
        report = merge_captures(parts, output, progress, overwrite=overwrite)
    if as_json:
        import dataclasses

        OUTPUT.print(dataclasses.asdict(report) | {"output": str(report.output)})
    elif not quiet:
        typer.echo(f"wrote {report.output} from {report.parts} parts")
        for line in stated_error_lines(report.error_estimate, report.unsampled_paths, report.zero_because):
            typer.echo(line)
        energies = energies_by_bounce(report.energy, report.energy_error_per_bounce)
        typer.echo(f"  energy          bounce {energies}; outside the time window: {report.out_of_window:.4g}")
