"""``render`` and ``plan`` of a configuration with a sweep: many captures at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.readable import readable_duration, readable_size

if TYPE_CHECKING:
    from nlosrender.analysis.render_plan import RenderPlan
    from nlosrender.config.document import Config
    from nlosrender.config.sweep_load import Sweep
    from nlosrender.rendering.dask_cluster import Cluster
    from nlosrender.rendering.render_report import Progress, RenderReport, Warn
    from nlosrender.rendering.sweep_render import SweepReport

PILOTS = 3  # captures whose cost `plan` measures: the first, the last and those between


def render_all(
    sweep: Sweep,
    overrides: Sequence[str],
    *,
    shard: tuple[int, int] | None,
    resume: bool | None,
    quiet: bool,
    as_json: bool,
    cluster: Cluster | None = None,
    strict: bool = False,
) -> None:
    """Render the captures of a sweep and print what came of it.

    Raises
    ------
    RenderError
        Captures failed; the others are rendered.
    ConfigError, BackendError, FileError, IncompleteRender, InterruptedRender
        As ``rendering.sweep_render.render_sweep``.
    """
    from nlosrender.cli.progress import progress_bar
    from nlosrender.config.places import with_places
    from nlosrender.errors import ConfigError, RenderError
    from nlosrender.pipeline import render_capture
    from nlosrender.rendering.sweep_render import render_sweep

    def render(config: Config, progress: Progress, warn: Warn, resume: bool | None) -> RenderReport:
        try:
            return render_capture(
                config, progress, warn, resume=resume, cluster=cluster, watch=telling.watch, strict=strict
            )
        except ConfigError as error:
            raise with_places(error, Path(sweep.source), overrides) from error

    with progress_bar("sweep", hidden=quiet) as telling:
        report = render_sweep(sweep, render, shard=shard, resume=resume, **telling._asdict())
    if as_json:
        _print_json(report)
    elif not quiet:
        typer.echo(f"wrote {report.index}: {report.captures} captures")
        typer.echo(f"  rendered        {report.rendered}, finished by earlier runs {report.earlier}")
        typer.echo(f"  took            {readable_duration(report.seconds)}")
    if report.failed:
        listed = "\n".join(f"{entry.file}: {entry.message}" for entry in report.failed)
        raise RenderError(f"{listed}\n{len(report.failed)} of {report.captures} captures failed.")


def plan_all(sweep: Sweep, overrides: Sequence[str], as_json: bool) -> None:
    """Print what a sweep will take, measured on a few of its captures.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As ``analysis.render_plan.plan_render``.
    """
    from nlosrender.analysis.render_plan import plan_render
    from nlosrender.config.places import with_places
    from nlosrender.errors import ConfigError

    indices = pilot_captures(len(sweep))
    try:
        forecasts = [plan_render(sweep.config(index)) for index in indices]
    except ConfigError as error:
        raise with_places(error, Path(sweep.source), overrides) from error
    total = _total(sweep, indices, forecasts)
    if as_json:
        OUTPUT.print(total | {"pilots": [forecast.as_json() for forecast in forecasts]})
        return
    basis = f"measured on {len(indices)} of them"
    typer.echo(f"captures {len(sweep)}, in {sweep.output_folder}")
    typer.echo(f"keys     {', '.join(sweep.values(0))}")
    typer.echo(f"engine   {', '.join(sorted({forecast.engine for forecast in forecasts}))} ({basis})")
    logical, disk = readable_size(total["logical_bytes"]), readable_size(total["disk_bytes_estimate"])
    typer.echo(f"files    {logical} for a reader, about {disk} on disk ({basis})")
    seconds = total["seconds_estimate"]
    told = "a time that cannot be told" if seconds is None else f"about {readable_duration(seconds)}"
    typer.echo(f"takes    {told} ({basis})")
    for warning in dict.fromkeys(warning for forecast in forecasts for warning in forecast.warnings):
        typer.echo(f"warning: {warning}", err=True)


def pilot_captures(n_captures: int) -> list[int]:
    """Return up to ``PILOTS`` captures spread over a sweep."""
    last = n_captures - 1
    return sorted({round(last * step / max(PILOTS - 1, 1)) for step in range(PILOTS)})


def _total(sweep: Sweep, indices: Sequence[int], forecasts: Sequence[RenderPlan]) -> dict[str, Any]:
    """Return the sums over all captures, by the mean of those that were looked at."""
    share = len(sweep) / len(forecasts)
    seconds = [forecast.seconds_estimate for forecast in forecasts if forecast.seconds_estimate is not None]
    return {
        "captures": len(sweep),
        "folder": str(sweep.output_folder),
        "keys": list(sweep.values(0)),
        "measured_captures": list(indices),
        "logical_bytes": round(share * sum(forecast.file.logical_bytes for forecast in forecasts)),
        "disk_bytes_estimate": round(share * sum(forecast.file.disk_bytes_estimate for forecast in forecasts)),
        "seconds_estimate": share * sum(seconds) if len(seconds) == len(forecasts) else None,
    }


def _print_json(report: SweepReport) -> None:
    from dataclasses import asdict

    from nlosrender.errors import EXIT_FAILURE, EXIT_OK

    OUTPUT.print(asdict(report) | {"index": str(report.index)}, EXIT_FAILURE if report.failed else EXIT_OK)
