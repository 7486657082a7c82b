"""``nlosrender export``: captures for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, CaptureFile, beside


def export(
    file: CaptureFile,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="tal (y-tal), fk (f-k migration), lct, phasor_mat (diffraction), or learned (for networks).",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="File to write.",
            show_default="FILE-FORMAT.hdf5 or .mat",
            readable=False,
        ),
    ] = None,
    bounces: Annotated[str, typer.Option(metavar="3|all", help="Light to export; bounces are summed.")] = "all",
    legs: Annotated[
        str | None,
        typer.Option(
            metavar="remove|keep",
            help="tal: whether time is counted from the wall, or the legs to the wall are left in.",
            show_default="remove",
        ),
    ] = None,
    key: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="learned: name of the variable, such as final_meas or data (t, row, column).",
            show_default="measlr",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a capture in the format of another program; what that cannot hold is refused or reported.

    Example: `nlosrender export z.hdf5 --format fk --bounces 3` creates z-fk.mat with `meas` and `tofgrid`, the third
    bounce of a confocal capture for f-k migration.
    """
    from nlosrender.errors import OptionError
    from nlosrender.files.export.export import export_capture, suffix_of

    if bounces not in ("3", "all"):
        raise OptionError(f"--bounces: got {bounces!r}, need 3 or all")
    ending = f"-{file_format}{suffix_of(file_format)}"
    target = output or beside(file, ending)
    report = export_capture(file, target, file_format, bounces, legs=legs, key=key)
    if as_json:
        OUTPUT.print({"written": str(report.path), "losses": report.losses})
        return
    typer.echo(f"wrote {report.path}")
    for loss in report.losses:
        typer.echo(f"note: {loss}", err=True)
