"""Commands about the config file: ``new``, ``validate``, ``schema``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.json_output import OUTPUT, issue_as_json
from nlosrender.cli.options import AsJson, Overrides
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, ConfigError, ValidationIssue

if TYPE_CHECKING:
    from nlosrender.config.document import Config
    from nlosrender.scene.meshes.mesh_report import MeshReport


class ScanTypeOption(StrEnum):
    """The values of ``new --scan-type``."""

    single = "single"
    confocal = "confocal"
    exhaustive = "exhaustive"
    line_of_sight = "line_of_sight"


def new(
    path: Annotated[str, typer.Argument(metavar="[PATH]", help="File to write; - for standard output.")] = "-",
    force: Annotated[bool, typer.Option("--force", help="Overwrite PATH.")] = False,
    scan_type: Annotated[
        ScanTypeOption | None, typer.Option(help="Scan the starter is for.", show_default="confocal")
    ] = None,
    example: Annotated[
        str | None, typer.Option(metavar="NAME", help="Instead: an example with its files; list: their names.")
    ] = None,
) -> None:
    """Write a commented starter config that can be rendered as it is.

    Example: nlosrender new z.yaml --scan-type single (writes z.yaml, ready to render)
    """
    import shlex

    from nlosrender.config.examples import Example, example_names, read_example
    from nlosrender.config.template import starter_config
    from nlosrender.errors import OptionError
    from nlosrender.files.atomic_write import replacing
    from nlosrender.files.file_kinds import CONFIG, FileKind

    if example == "list":
        typer.echo("\n".join(example_names()))
        return
    if example is not None and scan_type is not None:
        raise typer.BadParameter("has a scan type of its own; leave --scan-type away", param_hint="--example")
    target = Path("capture.yaml" if path == "-" else path)
    chosen = (
        Example(starter_config((scan_type or ScanTypeOption.confocal).value, target.stem, target.name), ())
        if example is None
        else read_example(example, target.name)
    )
    if path == "-":
        if chosen.files:
            raise OptionError(f"--example: {example} comes with {chosen.files[0].name}; name a file to write")
        typer.echo(chosen.text, nl=False)
        return
    kind = CONFIG if force else FileKind(lambda _: "exists already; --force overwrites it.")
    with replacing(path, kind) as partial:
        partial.write_text(chosen.text, encoding="utf-8")
    for file in chosen.files:
        beside = target.with_name(file.name)
        content = file.read_bytes()
        if not beside.is_file() or beside.read_bytes() != content:
            with replacing(beside, FileKind(lambda _: "exists already and is another file.")) as partial:
                partial.write_bytes(content)
            typer.echo(f"{beside}: written")
    typer.echo(f"{path}: written; nlosrender validate {shlex.quote(path)} checks it after changes.")


def validate(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG...", help="Config files.", readable=False)],
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Check config files and their meshes, and print every mistake with its place; nothing is rendered.

    Example: nlosrender validate z.yaml --set render.spp=64 (creates nothing; prints ok or every mistake with its
    line, exit code 3)
    """
    from nlosrender.api.configuration import validate as validate_one

    issues: list[ValidationIssue] = []
    warnings: list[str] = []
    meshes: list[MeshReport] = []
    for path in configs:
        try:
            found = validate_one(path, overrides or ())
        except ConfigError as error:
            issues += error.issues
            continue
        meshes += found.meshes
        warnings += [f"{path}: {warning}" for warning in found.warnings]
        if not as_json:
            sweep = found.configuration.sweep
            captures = "" if sweep is None else f"a sweep of {len(sweep)} captures in {sweep.output_folder}, such as "
            typer.echo(f"{path}: ok ({captures}{_summary(found.first)})")
            if found.meshes:  # NumPy is imported only for these
                from nlosrender.scene.meshes.mesh_report import mesh_lines

                for line in mesh_lines(found.meshes):
                    typer.echo(f"  mesh {line}")
            for warning in found.warnings:
                typer.echo(f"warning: {path}: {warning}", err=True)
    if as_json:
        verdict = {
            "valid": not issues,
            "problems": [issue_as_json(issue) for issue in issues],
            "warnings": warnings,
            "meshes": [dataclasses.asdict(mesh) for mesh in meshes],
        }
        OUTPUT.print(verdict, EXIT_BAD_INPUT if issues else EXIT_OK, indent=2)
        raise typer.Exit(EXIT_BAD_INPUT if issues else EXIT_OK)
    if issues:
        raise ConfigError(issues)


def schema() -> None:
    """Print the JSON Schema of the config.

    Example: nlosrender schema > nlosrender.schema.json (creates a schema for editors to check by)
    """
    import json

    from nlosrender.config.document import Config

    document = {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}
    typer.echo(json.dumps(document, indent=2))


def _summary(config: Config) -> str:
    """Return the capture in a few words: scan, sizes, bins, what is in the scene."""
    capture, n_bins = config.capture, config.time_axis.n_bins
    points = "pixels" if capture.is_line_of_sight else "sensors"
    parts: list[str] = [capture.scan_type]
    for name, grid, listed in (
        (points, capture.sensor_grid, capture.sensor_list),
        ("lasers", capture.laser_grid, capture.laser_list),
        ("laser spots at once", None, capture.spot_list),
    ):
        parts += [f"{grid.nx} x {grid.ny} {name}"] if grid is not None else []
        parts += [f"{len(listed)} listed {name}"] if listed is not None else []
    parts.append(f"{n_bins} bins of {config.time_axis.bin_width_opl:g} m")
    return ", ".join([*parts, *_contents(config)])


def _contents(config: Config) -> Iterator[str]:
    """Yield what a scene holds: its own items, and those of a Mitsuba scene."""
    from nlosrender.config.mitsuba_xml import read_mitsuba_xml

    scene, is_view = config.scene, config.capture.is_line_of_sight
    if scene.mitsuba is not None:
        root, _ = read_mitsuba_xml(scene.mitsuba)
        shapes, emitters = len(root.findall("shape")), sum(1 for _ in root.iter("emitter"))
        yield f"{scene.mitsuba.name} with {_counted(shapes, 'shape')} and {_counted(emitters, 'emitter')}"
    if scene.hidden_geometry or scene.mitsuba is None:
        yield _counted(len(scene.hidden_geometry), "item" if is_view else "hidden item")
    if scene.emitters:
        yield _counted(len(scene.emitters), "emitter")


def _counted(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"
