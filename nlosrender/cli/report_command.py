"""``nlosrender report``: one capture, or a folder of them, as a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.options import refuse_folder


def report(
    path: Annotated[
        Path, typer.Argument(metavar="FILE|FOLDER", help="Capture, or folder of captures.", readable=False)
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="OUT.html", help="Page to write.", show_default=False, readable=False),
    ],
    captures: Annotated[
        int, typer.Option(min=0, help="Of a folder: pictures of at most so many, outliers first, others evenly chosen.")
    ] = 100,
) -> None:
    """Write a page about a capture or a data set that needs no network: pictures, energies, errors, warnings, time.

    Of a capture also what was skipped and why, its configuration and where it comes from; of a folder a contact sheet,
    a table that sorts, outliers and failures.

    Example: `nlosrender report z.hdf5 -o z.html` creates z.html and prints its path.
    """
    from nlosrender.analysis.pages.capture_page import write_capture_page
    from nlosrender.analysis.pages.dataset_page import write_dataset_page

    refuse_folder(output, "report.html")
    if path.is_dir():
        write_dataset_page(path, output, captures)
    else:
        write_capture_page(path, output)
    typer.echo(str(output))
