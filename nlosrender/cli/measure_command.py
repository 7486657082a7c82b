"""``nlosrender measure``: from an ideal capture to the counts of a detector."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, Overrides, Quiet, one_of, refuse_folder
from nlosrender.cli.progress import reporting
from nlosrender.cli.tables import print_table


def measure(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Capture in Z-NLOS HDF5, by any writer.", readable=False)
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="OUT", help="File to write.", readable=False)
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            metavar="PROFILE|YAML",
            help="A sensor that comes with the program, or a YAML file with the keys of one, or with a section sensor.",
            show_default="that of the capture's configuration",
        ),
    ] = None,
    overrides: Overrides = None,
    seed: Annotated[int | None, typer.Option(help="sensor.seed, of the random numbers.", show_default=False)] = None,
    correct: Annotated[
        list[str] | None,
        typer.Option(metavar="pile_up|background", help="Undo it in the counts, for checking; may be repeated."),
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the sensors that come with the program.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a capture that holds no counts.")] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Count the photons of a capture as a detector does: pulse and jitter, noise, dead time.

    The file written is a capture like the one read, with counts for samples, all bounces in one.

    Example: nlosrender measure z.hdf5 -o counts.hdf5 --sensor spad-532 --set sensor.exposure_time=1 --set
    sensor.photons_per_pulse.mean=0.05 (creates counts.hdf5, one second of a 532 nm laser per sensor point)
    """
    if listed:
        _list(as_json)
        return
    if file is None:
        raise typer.BadParameter("missing, a capture file", param_hint="FILE")
    if output is None:
        raise typer.BadParameter("missing, the file to write", param_hint="--output")

    from nlosrender.api.arguments import sensor_for
    from nlosrender.files.measured import CORRECTABLE, measure_capture

    refuse_folder(output, "counts.hdf5")
    corrections = tuple(dict.fromkeys(one_of(name, CORRECTABLE, "--correct") for name in correct or []))
    changes = [*(overrides or []), *([] if seed is None else [f"sensor.seed={seed}"])]
    config = sensor_for(file, sensor, changes)
    with reporting("measure", quiet) as (progress, warn, _):
        report = measure_capture(file, output, config, progress, warn, corrections=corrections, overwrite=overwrite)
    if as_json:
        OUTPUT.print(dataclasses.asdict(report) | {"output": str(report.output)})
    elif not quiet:
        from nlosrender.analysis.capture_table import measurement_rows

        typer.echo(f"wrote {report.output}")
        print_table([row for row in measurement_rows(report.measurement) if row[1]], indent=2)


def _list(as_json: bool) -> None:
    from nlosrender.config.sensor import PROFILES, profile_names

    texts = {name: (PROFILES / f"{name}.yaml").read_text(encoding="utf-8") for name in profile_names()}
    if as_json:
        OUTPUT.print({"profiles": texts})
        return
    for name, text in texts.items():
        typer.echo(f"{name}:")
        typer.echo("".join(f"  {line}\n" for line in text.splitlines()))
