"""``nlosrender merge``: the parts of a capture into one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, Quiet
from nlosrender.cli.tables import print_table


def merge(
    parts: Annotated[
        list[Path],
        typer.Argument(
            metavar="PART...", help="Files rendered with --shard or --lasers, in any order.", readable=False
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write.", readable=False)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that holds another capture.")] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Put the parts of a capture together; what is missing, there twice, damaged or not its own is named.

    Example: nlosrender merge part*.hdf5 -o whole.hdf5 (creates whole.hdf5, the capture that one render without
    --shard would have written)
    """
    from nlosrender.analysis.stated_error import energies_by_bounce, stated_error_rows
    from nlosrender.cli.progress import reporting
    from nlosrender.files.parts.merge import merge_captures

    with reporting("merge", quiet) as (progress, warn, _):
        report = merge_captures(parts, output, progress, warn, overwrite=overwrite)
    if as_json:
        import dataclasses

        OUTPUT.print(dataclasses.asdict(report) | {"output": str(report.output)})
    elif not quiet:
        typer.echo(f"wrote {report.output} from {report.parts} parts")
        energies = energies_by_bounce(report.energy, report.energy_error_per_bounce)
        rows = stated_error_rows(report.error_estimate, report.unsampled_paths, report.zero_because)
        outside = f"outside the time window: {report.out_of_window:.4g}"
        print_table([*rows, ("energy", f"bounce {energies}; {outside}")], indent=2)
