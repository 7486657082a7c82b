"""Commands that look at capture files: info, plot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.capture_table import printable, summary_rows
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, CaptureFile, beside, two_numbers
from nlosrender.cli.tables import print_table


def info(
    file: CaptureFile,
    as_json: AsJson = False,
    check: Annotated[
        bool, typer.Option("--check", help="Also check the layout and every sample; exit code 3 if anything is wrong.")
    ] = False,
) -> None:
    """Show what a capture file holds, from its metadata alone.

    Example: `nlosrender info z.hdf5 --check` prints the grids, the time axis, the bounces and where the file comes
    from, then reads all samples to see that third-party loaders will accept it, or, for a file by another program,
    that it is read right. It creates nothing.
    """
    from nlosrender.analysis.summary import summarise
    from nlosrender.analysis.unfinished import is_unfinished, summarise_unfinished
    from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, FileError

    if is_unfinished(file):
        unfinished = summarise_unfinished(file)
        if as_json:
            OUTPUT.print(unfinished)
        else:
            print_table((label.replace("_", " "), printable(value)) for label, value in unfinished.items())
        return
    summary, violations = summarise(file), ()  # type: dict[str, object], tuple[str, ...]
    if check:
        from nlosrender.files.validation import check_file

        found = check_file(file)
        violations = found.violations
        summary |= {
            "violations": list(violations),
            "deviations": list(found.deviations),
            "readable": found.is_ours or not violations,
            "complete": not (violations or found.deviations),
        }
    if as_json:
        OUTPUT.print(summary, EXIT_BAD_INPUT if violations else EXIT_OK)
    else:
        print_table(summary_rows(summary))
    if violations:
        listed = "\n".join(f"{file}: {printable(violation)}" for violation in violations)
        raise FileError(f"{listed}\nThe file deviates from the Z-NLOS layout: other loaders may refuse or misread it.")


def plot(
    file: CaptureFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="OUT.png", help="Picture to write.", show_default="FILE.png", readable=False
        ),
    ] = None,
    laser: Annotated[
        str | None,
        typer.Option(
            metavar="IY,IX", help="Laser point (row, column) of an exhaustive capture.", show_default="the middle"
        ),
    ] = None,
    pixel: Annotated[
        str | None,
        typer.Option(
            metavar="IY,IX", help="Sensor point (row, column) of the histogram.", show_default="the brightest"
        ),
    ] = None,
) -> None:
    """Draw a capture: the relay wall over time, one histogram, the light of each bounce, one row over time.

    Example: `nlosrender plot z.hdf5 --pixel 6,8` creates z.png and prints its path.
    """
    from nlosrender.analysis.plots import plot_capture

    need = "a row and a column counted from 0, such as 6,8"
    laser_at, pixel_at = two_numbers(laser, ",", "--laser", need), two_numbers(pixel, ",", "--pixel", need)
    picture = output or beside(file, ".png")
    typer.echo(str(plot_capture(file, picture, laser=laser_at, pixel=pixel_at)))
