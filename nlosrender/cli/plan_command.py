"""``nlosrender plan``: what a render would do, skip, cost and write, without doing it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.cli.json_output import OUTPUT
from nlosrender.readable import readable_duration, readable_size

if TYPE_CHECKING:
    from nlosrender.analysis.render_plan import RenderPlan

NOTABLE_BYTES = 50e6  # of a scene's triangles
KEEP_SECONDS = 30.0  # units that take longer are kept on the way, see ``rendering.unit_in_flight``


def register(app: typer.Typer) -> None:
    """Add ``plan`` to ``app``."""
    app.command(
        "plan",
        epilog="Example: nlosrender plan configs/z-letter.yaml --set render.target_error=0.001   "
        "(writes nothing; prints the engine and why, what is skipped, memory, file size and an estimate of the time)",
    )(plan)


def plan(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="The YAML file that describes the capture.", readable=False)
    ],
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key; may be repeated.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the plan as one JSON object.")] = False,
) -> None:
    """Say what a render will do, what it skips and why, and what it costs; a short pilot measures the speed."""
    from nlosrender.analysis.render_plan import plan_render
    from nlosrender.cli.sweep_command import plan_all
    from nlosrender.config.load import load_config
    from nlosrender.config.places import with_places
    from nlosrender.config.sweep_load import load_sweep
    from nlosrender.errors import ConfigError

    changes = list(overrides or [])
    sweep = load_sweep(config, changes)
    if sweep is not None:
        plan_all(sweep, changes, as_json)
        return
    loaded = load_config(config, changes)
    try:
        forecast = plan_render(loaded)
    except ConfigError as error:
        raise with_places(error, config, changes) from error
    if as_json:
        OUTPUT.print(forecast.as_json())
        return
    for line in _lines(forecast):
        typer.echo(line)
    for warning in forecast.warnings:
        typer.echo(f"warning: {warning}", err=True)


def _lines(forecast: RenderPlan) -> Iterator[str]:
    from nlosrender.scene.mesh_report import mesh_lines

    yield f"engine   {forecast.engine}: {forecast.reason} ({forecast.variant})"
    for item in forecast.skipped:
        yield f"skipped  {item.what}: {item.why}"
    for paths in forecast.unsampled_paths:
        yield f"missing  {paths}: sampled by no technique, the stated error will be unknown"
    hidden = "" if forecast.scan_type == LINE_OF_SIGHT else "hidden "
    yield f"scan     {_scan(forecast)}, {forecast.n_triangles} {hidden}triangles"
    yield from (f"mesh     {line}" for line in mesh_lines(forecast.meshes))
    start, end = forecast.window_opl
    yield f"time     {forecast.n_bins} bins of {forecast.bin_width_opl:g} m, from {start:.6g} to {end:.6g} m"
    plural = "" if forecast.batches == 1 else "es"
    beside = ""
    if forecast.scene_bytes >= NOTABLE_BYTES:
        beside = f", and about {readable_size(forecast.scene_bytes)} for the triangles"
    yield f"memory   {forecast.batches} batch{plural} of up to {readable_size(forecast.bytes_per_batch)}{beside}"
    size = forecast.file
    yield (
        f"file     {forecast.output}: {readable_size(size.logical_bytes)} for a reader, about "
        f"{readable_size(size.disk_bytes_estimate)} on disk ({size.assumption})"
    )
    if forecast.seconds_estimate is None:
        yield f"takes    a time that cannot be told ({forecast.estimate_basis})"
    else:
        yield (
            f"takes    about {readable_duration(forecast.seconds_estimate)} for the whole command, of which rendering "
            f"{readable_duration(forecast.seconds_rendering or 0.0)} ({forecast.estimate_basis})"
        )
        yield _units(forecast)


def _units(forecast: RenderPlan) -> str:
    seconds = forecast.seconds_per_unit or 0.0
    count = "1 unit" if forecast.units == 1 else f"{forecast.units} units"
    if seconds < KEEP_SECONDS:
        kept = "SIGTERM ends the render with the one in flight, or seconds later; SIGKILL costs that one"
    else:
        kept = "SIGTERM ends the render within seconds and keeps the one in flight; SIGKILL costs about a minute"
    return f"units    {count} of about {readable_duration(seconds)} each: {kept}"


def _scan(forecast: RenderPlan) -> str:
    points = "pixels" if forecast.scan_type == LINE_OF_SIGHT else "sensor points"
    sensors = "{} x {} ".format(*forecast.sensor_grid) + points
    if forecast.scan_type != "exhaustive":
        return f"{forecast.scan_type}, {sensors}"
    return "exhaustive, {}, {} x {} laser points".format(sensors, *forecast.laser_grid)
