"""``nlosrender status``: how far renders have come, here or on a cluster, by their files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson
from nlosrender.cli.tables import print_table
from nlosrender.readable import printable, readable_duration

MAX_LISTED = 60  # renders in the table; --json has all


def status(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FOLDER|FILE...", help="Folders of captures, or captures, finished or not.", readable=False
        ),
    ],
    stale: Annotated[
        float, typer.Option(metavar="MINUTES", min=0, help="A render that writes nothing for so long is stale.")
    ] = 15.0,
    as_json: AsJson = False,
) -> None:
    """Show how far renders have come: units done, running, stopped, stale, failed, time left, shards that are missing.

    It reads the files alone, from any machine that sees them, and disturbs no render. Running: a process has the
    capture open; stale: it has, but writes nothing; stopped: none has, and the same render command goes on.

    Example: `nlosrender status parts` prints a line for each render. It creates nothing.
    """
    from nlosrender.analysis.run_status import status_of, status_report

    report = status_report(status_of(paths, 60 * stale))
    if as_json:
        OUTPUT.print(report)
        return
    rows = [_row(render) for render in report["renders"][:MAX_LISTED]]
    print_table(rows, header=("file", "state", "units", "time left", "last written", "part", "by"))
    if len(report["renders"]) > MAX_LISTED:
        typer.echo(f"and {len(report['renders']) - MAX_LISTED} more, which --json has")
    for render in report["renders"]:
        if render["message"]:
            name = "" if render["file"] in render["message"] else f"{printable(render['file'])}: "
            typer.echo(f"failed: {name}{printable(render['message'], 400)}")
    for text in report["missing"]:
        typer.echo(f"not begun: {printable(text, 400)}")
    typer.echo(_total(report))


def _row(render: dict[str, Any]) -> tuple[str, ...]:
    done, units = render["finished_units"], render["units"]
    if done is None:
        shown = ""
    elif units is None:
        shown = f"{done}" if done else "none yet"
    else:
        shown = f"{done} of {units}, {100 * done // max(units, 1)} %"
    left, silent = render["seconds_left"], render["silent_seconds"]
    return (
        printable(render["file"]),
        render["state"],
        shown,
        "" if left is None else f"about {readable_duration(left)}",
        "" if silent is None else f"{readable_duration(silent)} ago",
        printable(render["part"] or ""),
        printable(render["run_by"]),
    )


def _total(report: dict[str, Any]) -> str:
    states = ", ".join(f"{count} {state}" for state, count in report["states"].items())
    parts = [f"{report['files']} files: {states}" if report["files"] else "no captures, finished or not"]
    if report["units"]:
        parts.append(f"{report['finished_units']} of {report['units']} units of unfinished files")
    if report["seconds_left"] is not None:
        parts.append(f"about {readable_duration(report['seconds_left'])} left for those that run")
    return "; ".join(parts)
