"""Commands about a folder of captures: what it holds, a picture of all of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson
from nlosrender.cli.tables import print_table
from nlosrender.readable import readable_duration, readable_size

Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder that a sweep was rendered into.", readable=False)
]


def sheet(
    folder: Folder,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT.png",
            help="Picture to write.",
            show_default="FOLDER/sheet.png",
            readable=False,
        ),
    ] = None,
    captures: Annotated[int, typer.Option(min=1, help="At most so many, evenly chosen.")] = 100,
    columns: Annotated[int, typer.Option(min=1, help="Captures side by side.")] = 5,
) -> None:
    """Draw a contact sheet of a data set: of each capture the scene, the wall at its peak, a histogram, drawn values.

    Example: `nlosrender sheet letters -o sheet.png` creates sheet.png and prints its path.
    """
    from nlosrender.analysis.contact_sheet import contact_sheet

    picture = output or folder / "sheet.png"
    contact_sheet(folder, picture, captures, columns)
    typer.echo(str(picture))


def info(folder: Folder, as_json: AsJson = False) -> None:
    """Show what a data set holds: counts, splits, sizes, failures, spreads of energy, stated error and seconds.

    Example: `nlosrender dataset info letters` prints a table. It creates nothing.
    """
    from nlosrender.analysis.dataset_summary import dataset_summary

    found = dataset_summary(folder)
    if as_json:
        OUTPUT.print(found)
        return
    rows = [
        ("source", found["source"]),
        ("captures", f"{found['captures']}: {_counts(found['status'])}"),
        ("splits", _counts(found["splits"]) or "none"),
        ("labels", _counts(found["labels"]) or "none"),
        ("keys", ", ".join(found["keys"])),
        ("drawn files", str(found["files_drawn"])),
        ("size", f"{readable_size(found['bytes'])}; each {_spread(found['bytes_per_capture'], readable_size)}"),
        ("energy", _spread(found["energy"])),
        ("stated error", _spread(found["error_estimate"]) + _others(found)),
        ("seconds", f"{readable_duration(found['seconds_in_all'])}; each {_spread(found['seconds'])}"),
    ]
    rows += [("in two splits", name) for name in found["in_two_splits"]]
    rows += [("failed", f"{failure['file']}: {failure['message']}") for failure in found["failures"]]
    print_table(rows)


def pack(
    folder: Folder,
    file_format: Annotated[
        str | None,
        typer.Option("--format", metavar="webdataset|lfe|nlos3d", help="Which.", show_default="the configuration's"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the finished captures of a data set once more as training programs read them, in a folder beside them.

    Example: `nlosrender dataset pack letters --format webdataset` creates letters/webdataset with tar shards.
    """
    from nlosrender.files.packages.package import pack as pack_folder

    found = pack_folder(folder, file_format)
    if as_json:
        OUTPUT.print(found)
    else:
        print_packed(found)


def print_packed(found: dict[str, Any]) -> None:
    """Print what a package holds, and notes on stderr."""
    typer.echo(f"wrote {found['path']}: {found['captures']} captures")
    for note in found["notes"]:
        typer.echo(f"note: {note}", err=True)


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _others(found: dict[str, Any]) -> str:
    missed, unknown = found["target_missed"], found["error_unknown"]
    return f"; above the target in {missed}" * bool(missed) + f"; unknown in {unknown}" * bool(unknown)


def _spread(spread: dict[str, float] | None, written: Any = lambda value: f"{value:.3g}") -> str:
    if spread is None:
        return "-"
    return f"{written(spread['median'])} ({written(spread['lowest'])} to {written(spread['highest'])})"
