"""``render`` and ``plan`` of a configuration with a sweep: many captures at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import config_places
from nlosrender.cli.tables import print_table
from nlosrender.readable import readable_duration, readable_size

if TYPE_CHECKING:
    from nlosrender.analysis.render_plan import RenderPlan
    from nlosrender.config.document import Config
    from nlosrender.config.sweep_load import Sweep
    from nlosrender.rendering.render_report import Progress, RenderReport, Warn

PILOTS = 3  # captures whose cost `plan` measures: the first, the last and those between


def render_all(
    sweep: Sweep,
    overrides: Sequence[str],
    render_capture: Callable[..., RenderReport],
    *,
    shard: tuple[int, int] | None,
    resume: bool | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Render the captures of a sweep, each by ``render_capture``, and print the report.

    Raises
    ------
    RenderError
        Captures failed; the others are rendered.
    ConfigError, BackendError, FileError, IncompleteRender, InterruptedRender
        As ``rendering.sweep_render.render_sweep``.
    """
    from nlosrender.cli.progress import reporting
    from nlosrender.errors import EXIT_FAILURE, EXIT_OK, RenderError
    from nlosrender.rendering.sweep_render import render_sweep

    with reporting("sweep", quiet) as listeners:

        def render(config: Config, progress: Progress, warn: Warn, resume: bool | None) -> RenderReport:
            with config_places(Path(sweep.source), overrides):  # a capture that fails is reported by the sweep
                return render_capture(config, progress, warn, resume=resume, watch=listeners.watch)

        report = render_sweep(sweep, render, shard=shard, resume=resume, **listeners._asdict())
    if as_json:
        OUTPUT.print(asdict(report) | {"index": str(report.index)}, EXIT_FAILURE if report.failed else EXIT_OK)
    elif not quiet:
        typer.echo(f"wrote {report.index}: {report.captures} captures")
        rendered = f"{report.rendered}, finished by earlier runs {report.earlier}"
        print_table([("rendered", rendered), ("took", readable_duration(report.seconds))], indent=2)
    if report.failed:
        listed = "\n".join(f"{entry.file}: {entry.message}" for entry in report.failed)
        raise RenderError(f"{listed}\n{len(report.failed)} of {report.captures} captures failed.")


def plan_all(sweep: Sweep, as_json: bool) -> None:
    """Print what a sweep will take, measured on a few of its captures.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As ``analysis.render_plan.plan_render``.
    """
    from nlosrender.analysis.render_plan import plan_render

    indices = pilot_captures(len(sweep))
    plans = [plan_render(sweep.config(index)) for index in indices]
    total = _total(sweep, indices, plans)
    if as_json:
        OUTPUT.print(total | {"pilots": [plan.as_json() for plan in plans]})
        return
    basis = f"measured on {len(indices)} of them"
    seconds = total["seconds_estimate"]
    logical, disk = readable_size(total["logical_bytes"]), readable_size(total["disk_bytes_estimate"])
    rows = [
        ("captures", f"{len(sweep)}, in {sweep.output_folder}"),
        ("keys", ", ".join(sweep.values(0))),
        ("engine", f"{', '.join(sorted({plan.engine for plan in plans}))} ({basis})"),
        ("files", f"{logical} for a reader, about {disk} on disk ({basis})"),
        ("takes", f"{'unknown time' if seconds is None else f'about {readable_duration(seconds)}'} ({basis})"),
    ]
    print_table(rows)
    for warning in dict.fromkeys(warning for plan in plans for warning in plan.warnings):
        typer.echo(f"warning: {warning}", err=True)


def pilot_captures(n_captures: int) -> list[int]:
    """Return up to ``PILOTS`` captures spread over a sweep."""
    return sorted({round((n_captures - 1) * step / (PILOTS - 1)) for step in range(PILOTS)})


def _total(sweep: Sweep, indices: Sequence[int], plans: Sequence[RenderPlan]) -> dict[str, Any]:
    """Return the sums over all captures, by the mean of those that were looked at."""
    share = len(sweep) / len(plans)
    seconds = [plan.seconds_estimate for plan in plans if plan.seconds_estimate is not None]
    return {
        "captures": len(sweep),
        "folder": str(sweep.output_folder),
        "keys": list(sweep.values(0)),
        "measured_captures": list(indices),
        "logical_bytes": round(share * sum(plan.file.logical_bytes for plan in plans)),
        "disk_bytes_estimate": round(share * sum(plan.file.disk_bytes_estimate for plan in plans)),
        "seconds_estimate": share * sum(seconds) if len(seconds) == len(plans) else None,
    }
