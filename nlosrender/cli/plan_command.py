"""``nlosrender plan``: what a render would do, skip, cost and write, without doing it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import typer

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, ConfigFile, Overrides
from nlosrender.cli.tables import print_table
from nlosrender.readable import readable_duration, readable_size

if TYPE_CHECKING:
    from nlosrender.analysis.render_plan import RenderPlan
    from nlosrender.config.sweep_load import Sweep

PILOTS = 3  # captures of a sweep whose cost is measured: the first, the last and those between
NOTABLE_BYTES = 50e6  # of a scene's triangles: less is lost in the program's own 400 MB


def plan(config: ConfigFile, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Say what a render will do, what it skips and why, and what it costs; a short pilot measures the speed.

    Example: nlosrender plan configs/z-letter.yaml --set render.target_error=0.001 (writes nothing; prints the engine
    and why, what is skipped, memory, file size and an estimate of the time)
    """
    from nlosrender.api.configuration import load
    from nlosrender.api.configuration import plan as plan_single

    configuration = load(config, overrides or ())
    if configuration.sweep is not None:
        with configuration.document.placing_issues():
            _plan_all(configuration.sweep, as_json)
        return
    found = plan_single(configuration)
    if as_json:
        OUTPUT.print(found.as_json())
        return
    print_table(_rows(found))
    for warning in found.warnings:
        typer.echo(f"warning: {warning}", err=True)


def _rows(plan: RenderPlan) -> Iterator[tuple[str, str]]:
    from nlosrender.scene.meshes.mesh_report import mesh_lines

    yield "engine", f"{plan.engine}: {plan.reason} ({plan.variant})"
    for item in plan.skipped:
        yield "skipped", f"{item.what}: {item.why}"
    for paths in plan.unsampled_paths:
        yield "missing", f"{paths}: sampled by no technique, the stated error will be unknown"
    hidden = "" if plan.scan_type == LINE_OF_SIGHT else "hidden "
    yield "scan", f"{_scan(plan)}, {plan.n_triangles} {hidden}triangles"
    yield from (("mesh", line) for line in mesh_lines(plan.meshes))
    start, end = plan.window_opl
    yield "time", f"{plan.n_bins} bins of {plan.bin_width_opl:g} m, from {start:.6g} to {end:.6g} m"
    batches = "1 batch" if plan.batches == 1 else f"{plan.batches} batches"
    is_large = plan.scene_bytes >= NOTABLE_BYTES
    triangles = f", and about {readable_size(plan.scene_bytes)} for the triangles" if is_large else ""
    yield "memory", f"{batches} of up to {readable_size(plan.bytes_per_batch)}{triangles}"
    size = plan.file
    yield (
        "file",
        f"{plan.output}: {readable_size(size.logical_bytes)} for a reader, about "
        f"{readable_size(size.disk_bytes_estimate)} on disk ({size.assumption})",
    )
    if plan.seconds_estimate is None:
        yield "takes", f"an unknown time ({plan.estimate_basis})"
    else:
        yield (
            "takes",
            f"about {readable_duration(plan.seconds_estimate)} for the whole command, of which rendering "
            f"{readable_duration(plan.seconds_rendering or 0.0)} ({plan.estimate_basis})",
        )
        yield "units", _units(plan)


def _units(plan: RenderPlan) -> str:
    from nlosrender.rendering.item_in_flight import SAVING

    seconds = plan.seconds_per_unit or 0.0
    count = "1 unit" if plan.units == 1 else f"{plan.units} units"
    if seconds < SAVING.seconds:
        on_stop = "SIGTERM ends the render with the one in flight, or seconds later; SIGKILL costs that one"
    else:
        on_stop = "SIGTERM ends the render within seconds and keeps the one in flight; SIGKILL costs about a minute"
    return f"{count} of about {readable_duration(seconds)} each: {on_stop}"


def _scan(plan: RenderPlan) -> str:
    points = "pixels" if plan.scan_type == LINE_OF_SIGHT else "sensor points"
    counts = {
        name: f"{grid[0]} listed" if name in plan.point_lists else f"{grid[0]} x {grid[1]}"
        for name, grid in (("sensor", plan.sensor_grid), ("laser", plan.laser_grid))
    }
    lasers = f", {counts['laser']} laser points" if plan.scan_type == "exhaustive" else ""
    return f"{plan.scan_type}, {counts['sensor']} {points}{lasers}"


def _plan_all(sweep: Sweep, as_json: bool) -> None:
    """Print what a sweep will take, measured on a few of its captures."""
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
        ("keys", ", ".join(sweep.keys)),
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
        "keys": list(sweep.keys),
        "measured_captures": list(indices),
        "logical_bytes": round(share * sum(plan.file.logical_bytes for plan in plans)),
        "disk_bytes_estimate": round(share * sum(plan.file.disk_bytes_estimate for plan in plans)),
        "seconds_estimate": share * sum(seconds) if len(seconds) == len(plans) else None,
    }
