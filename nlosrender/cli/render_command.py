"""``nlosrender render``: the main job."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.cli.dataset_commands import print_packed
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, ConfigFile, Overrides, Quiet, refuse_folder, two_numbers
from nlosrender.cli.progress import reporting
from nlosrender.cli.tables import print_table
from nlosrender.readable import readable_duration

if TYPE_CHECKING:
    from nlosrender.api.configuration import Configuration
    from nlosrender.capture.part import Selection
    from nlosrender.rendering.dask_cluster import Cluster
    from nlosrender.rendering.render_report import RenderReport


class Executor(StrEnum):
    """Who renders."""

    LOCAL = "local"
    DASK = "dask"


def render(
    config: ConfigFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write, instead of output.path.", readable=False)
    ] = None,
    overrides: Overrides = None,
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
        int | None, typer.Option(min=1, help="dask: processes to start, or to wait for.", show_default="one per core")
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit 3 before rendering where light is missing that no technique samples.")
    ] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Render a capture and write it as one HDF5 file.

    What is finished survives Ctrl-C and kill: the same command goes on from there. A configuration with a sweep makes
    a folder of captures and an index.json; --shard then deals whole captures.

    Example: nlosrender render configs/z-letter.yaml -o out/z-letter.hdf5 (creates out/z-letter.hdf5, a capture of a
    hidden letter Z)
    """
    selection = _selection(shard, lasers)
    if executor is Executor.LOCAL and (scheduler is not None or workers is not None):
        hint = "--workers" if scheduler is None else "--scheduler"
        raise typer.BadParameter("needs --executor dask", param_hint=hint)

    from nlosrender.api.configuration import load
    from nlosrender.api.renders import output_change, render_single

    changes = list(overrides or [])
    if output is not None:
        refuse_folder(output, "capture.hdf5")
        changes += output_change(output)
    configuration = load(config, changes)
    if configuration.sweep is not None and lasers is not None:
        raise typer.BadParameter("cuts one capture, not a sweep; use --shard", param_hint="--lasers")
    with _cluster(executor, scheduler, workers) as cluster:
        if configuration.sweep is not None:
            how: dict[str, Any] = {"cluster": cluster, "strict": strict}
            _render_all(configuration, how, shard=selection.shard, resume=resume, quiet=quiet, as_json=as_json)
            return
        with reporting("render", quiet) as listeners:
            how = {"selection": selection, "cluster": cluster, "strict": strict}
            report = render_single(configuration, resume=resume, **listeners._asdict(), **how)
    if as_json:
        OUTPUT.print(dataclasses.asdict(report) | {"output": str(report.output)})
    elif not quiet:
        _print_report(report)


def _render_all(
    configuration: Configuration,
    how: Mapping[str, Any],
    *,
    shard: tuple[int, int] | None,
    resume: bool | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Render the captures of a sweep, and print the report."""
    from nlosrender.api.renders import refuse_failed, render_captures
    from nlosrender.errors import EXIT_FAILURE, EXIT_OK

    with reporting("sweep", quiet) as listeners:
        report, package = render_captures(configuration, shard=shard, resume=resume, **listeners._asdict(), **how)
    if as_json:
        told = dataclasses.asdict(report) | {"index": str(report.index), "package": package}
        OUTPUT.print(told, EXIT_FAILURE if report.failed else EXIT_OK)
    elif not quiet:
        typer.echo(f"wrote {report.index}: {report.captures} captures")
        rendered = f"{report.rendered}, finished by earlier runs {report.earlier}"
        print_table([("rendered", rendered), ("took", readable_duration(report.seconds))], indent=2)
        if package is not None:
            print_packed(package)
    refuse_failed(report)


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
    parts = two_numbers(shard, "/", "--shard", need_shard)
    chosen = two_numbers(lasers, ":", "--lasers", need_lasers)
    if parts is not None and not 1 <= parts[0] <= parts[1]:
        raise typer.BadParameter(f"got {shard!r}, need {need_shard}", param_hint="--shard")
    if chosen is not None and chosen[0] >= chosen[1]:
        raise typer.BadParameter(f"got {lasers!r}, need {need_lasers}", param_hint="--lasers")
    return Selection(shard=parts, lasers=chosen)


def _print_report(report: RenderReport) -> None:
    from nlosrender.analysis.stated_error import energies_by_bounce, errors_by_bounce, stated_error_rows

    is_view = report.engine == LINE_OF_SIGHT  # that engine renders nothing else
    typer.echo(f"wrote {report.output}" + (f", {report.part} of the capture" if report.part else ""))
    rows = []
    if report.resumed_units:
        rows.append(("resumed", f"{report.resumed_units} of {report.units} units were finished by an earlier run"))
    rows.append(("engine", f"{report.engine}: {report.reason}"))
    paths = f", {report.samples} paths per {'pixel' if is_view else 'sensor point'}" if report.samples else ""
    rows += stated_error_rows(report.error_estimate, report.unsampled_paths, report.zero_because, paths)
    errors = errors_by_bounce(report.error_estimate_per_bounce)
    rows.append(("per bounce", f"{errors} (relative L2; -: no light or unknown)"))
    energies = energies_by_bounce(report.energy, report.energy_error_per_bounce)
    outside = f"outside the time window: {report.out_of_window:.4g}"
    rows.append(("energy", f"{'interactions' if is_view else 'bounce'} {energies}; {outside}"))
    stages = {stage: readable_duration(seconds) for stage, seconds in report.seconds.items()}
    total = stages.pop("total")
    rows.append(("took", f"{total} ({', '.join(f'{stage} {spent}' for stage, spent in stages.items())})"))
    print_table(rows, indent=2)
