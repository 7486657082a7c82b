"""``nlosrender render``: the main job."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.cli.json_output import OUTPUT
from nlosrender.readable import readable_duration

if TYPE_CHECKING:
    from nlosrender.capture.part import Selection
    from nlosrender.rendering.dask_cluster import Cluster
    from nlosrender.rendering.render_report import RenderReport


class Executor(StrEnum):
    """Who renders."""

    LOCAL = "local"
    DASK = "dask"


def register(app: typer.Typer) -> None:
    """Add ``render`` to ``app``."""
    app.command(
        epilog="Example: nlosrender render configs/z-letter.yaml -o out/z-letter.hdf5   (creates out/z-letter.hdf5, a "
        "capture of a hidden letter Z)"
    )(render)


def render(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG", help="The YAML file that describes the capture.", readable=False)
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write, instead of output.path.", readable=False)
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key; may be repeated.")
    ] = None,
    lasers: Annotated[
        str | None, typer.Option(metavar="A:B", help="Render laser points A to B - 1 only, counted row by row from 0.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Render the I-th of N parts, counted from 1; see merge.")
    ] = None,
    resume: Annotated[
        bool | None,
        typer.Option(
            "--resume/--overwrite",
            help="Demand an unfinished render to go on with / throw it away, and replace another capture there.",
            show_default="go on with one if there is one",
        ),
    ] = None,
    executor: Annotated[
        Executor, typer.Option(help="Who renders: this process, or the workers of a dask cluster.")
    ] = Executor.LOCAL,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS|FILE", help="dask: scheduler to use.", show_default="start one on this machine"),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="dask: processes to start, or to wait for.", show_default="one per core"),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Exit 3 before rendering where light is missing that no technique samples."),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no report; warnings stay.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as one JSON object.")] = False,
) -> None:
    """Render a capture and write it as one HDF5 file.

    What is finished survives Ctrl-C and kill: the same command goes on from there. A configuration with a sweep makes
    a folder of captures and an index.json; --shard then deals whole captures.
    """
    selection = _selection(shard, lasers)
    if executor is Executor.LOCAL and (scheduler is not None or workers is not None):
        hint = "--workers" if scheduler is None else "--scheduler"
        raise typer.BadParameter("needs --executor dask", param_hint=hint)

    from nlosrender.cli.progress import progress_bar
    from nlosrender.cli.sweep_command import render_all
    from nlosrender.config.load import load_config
    from nlosrender.config.places import with_places
    from nlosrender.config.sweep_load import load_sweep
    from nlosrender.errors import ConfigError, FileError
    from nlosrender.files.atomic_write import refuse_sources
    from nlosrender.pipeline import render_capture

    changes = list(overrides or [])
    if output is not None and output.name in ("", ".."):
        raise FileError(f"{output}: is a folder. Name a file in it, such as {output / 'capture.hdf5'}")
    if output is not None:
        changes.append(f"output.path={_quoted(output)}")
    sweep = load_sweep(config, changes)
    if sweep is not None:
        if lasers is not None:
            raise typer.BadParameter("cuts one capture, not a sweep; use --shard", param_hint="--lasers")
        with _cluster(executor, scheduler, workers) as cluster:
            render_all(
                sweep,
                changes,
                shard=selection.shard,
                resume=resume,
                quiet=quiet,
                as_json=as_json,
                cluster=cluster,
                strict=strict,
            )
        return
    loaded = load_config(config, changes)
    refuse_sources(loaded.output.path, [config])
    try:
        with (
            _cluster(executor, scheduler, workers) as cluster,
            progress_bar("render", hidden=quiet) as telling,
        ):
            report = render_capture(
                loaded, **telling._asdict(), selection=selection, resume=resume, cluster=cluster, strict=strict
            )
    except ConfigError as error:
        raise with_places(error, config, changes) from error
    if as_json:
        _print_json(report)
    elif not quiet:
        _print_report(report)


def _cluster(
    executor: Executor, scheduler: str | None, workers: int | None
) -> AbstractContextManager[Cluster] | nullcontext[None]:
    if executor is Executor.LOCAL:
        return nullcontext()
    from nlosrender.rendering.dask_cluster import joined_cluster

    return joined_cluster(scheduler, workers)


def _selection(shard: str | None, lasers: str | None) -> Selection:
    from nlosrender.capture.part import Selection

    if shard is not None and lasers is not None:
        raise typer.BadParameter("takes no --shard beside it", param_hint="--lasers")
    need_shard, need_lasers = "I/N with 1 <= I <= N, such as 2/8", "A:B with A < B, such as 0:8"
    selection = Selection(
        shard=_two_numbers(shard, "/", "--shard", need_shard), lasers=_two_numbers(lasers, ":", "--lasers", need_lasers)
    )
    if selection.shard is not None and not 1 <= selection.shard[0] <= selection.shard[1]:
        raise typer.BadParameter(f"got {shard!r}, need {need_shard}", param_hint="--shard")
    if selection.lasers is not None and selection.lasers[0] >= selection.lasers[1]:
        raise typer.BadParameter(f"got {lasers!r}, need {need_lasers}", param_hint="--lasers")
    return selection


def _two_numbers(text: str | None, separator: str, option: str, need: str) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(rf"([0-9]{{1,9}}){separator}([0-9]{{1,9}})", text.strip(), re.ASCII)
    if match is None:
        raise typer.BadParameter(f"got {text!r}, need {need}", param_hint=option)
    return int(match[1]), int(match[2])


def _quoted(path: Path) -> str:
    import json

    return json.dumps(str(path))  # a JSON string is a YAML string: names such as "1e3" or "yes" stay text


def _print_json(report: RenderReport) -> None:
    import dataclasses

    OUTPUT.print(dataclasses.asdict(report) | {"output": str(report.output)})


def _print_report(report: RenderReport) -> None:
    from nlosrender.cli.stated_error import energies_by_bounce, errors_by_bounce, stated_error_lines

    seconds = report.seconds
    typer.echo(f"wrote {report.output}" + (f", {report.part} of the capture" if report.part else ""))
    if report.resumed_units:
        typer.echo(f"  resumed         {report.resumed_units} of {report.units} units were finished by an earlier run")
    typer.echo(f"  engine          {report.engine}: {report.reason}")
    is_view = report.engine == LINE_OF_SIGHT  # that engine renders nothing else
    paths = f", {report.samples} paths per {'pixel' if is_view else 'sensor point'}" if report.samples else ""
    for line in stated_error_lines(report.error_estimate, report.unsampled_paths, report.zero_because, paths):
        typer.echo(line)
    typer.echo(
        f"  per bounce      {errors_by_bounce(report.error_estimate_per_bounce)} (relative L2; -: no light or unknown)"
    )
    energies = energies_by_bounce(report.energy, report.energy_error_per_bounce)
    counted = "interactions" if is_view else "bounce"
    typer.echo(f"  energy          {counted} {energies}; outside the time window: {report.out_of_window:.4g}")
    stages = ", ".join(f"{stage} {readable_duration(spent)}" for stage, spent in seconds.items() if stage != "total")
    typer.echo(f"  took            {readable_duration(seconds['total'])} ({stages})")
