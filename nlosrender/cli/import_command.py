"""``nlosrender import``: scene files of mitransient and y-tal."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.json_output import OUTPUT, issue_as_json
from nlosrender.cli.options import AsJson, refuse_folder
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, ConfigError

if TYPE_CHECKING:
    from nlosrender.files.importing.translation import KeyLine


def import_(
    scene: Annotated[Path, typer.Argument(metavar="FILE", help="mitransient's XML or y-tal's YAML.", readable=False)],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="CONFIG", help="Config file to write.", readable=False)
    ],
    laser: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Where the laser hits, m from the wall's centre.", show_default="as FILE"),
    ] = None,
    meshes: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Where y-tal's mesh names start.",
            show_default="FILE's folder, the one above, the current one",
            readable=False,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite CONFIG.")] = False,
    as_json: AsJson = False,
) -> None:
    """Make a config of a scene file of mitransient (XML) or y-tal (YAML), and say what became of every key of it.

    A key is taken, changed, dropped with the reason, or refused: then nothing is written, exit code 3.

    Example: nlosrender import nlos-z.xml -o z.yaml --laser 0,0 (creates z.yaml, with the laser on the wall's centre)
    """
    from nlosrender.files.atomic_write import check_writable, replacing
    from nlosrender.files.file_kinds import CONFIG, FileKind
    from nlosrender.files.importing.import_scene import import_scene

    refuse_folder(output, "capture.yaml")
    kind = CONFIG if force else FileKind(lambda _: "exists already; --force overwrites it.")
    check_writable(output, kind, [scene])
    translation, content = import_scene(scene, output, _point(laser), meshes)
    issues = translation.issues
    if as_json:
        found = {
            "output": None if issues else str(output),
            "keys": [dataclasses.asdict(line) for line in translation.lines],
            "problems": [issue_as_json(issue) for issue in issues],
        }
    else:
        for line in sorted(translation.lines, key=_reading_order):
            typer.echo(f"{line.verdict:8}" + ": ".join(filter(None, (line.place, line.key, line.value, line.remark))))
    if not issues:
        with replacing(output, kind, [scene]) as partial:
            partial.write_text(content, encoding="utf-8")
    if as_json:
        exit_code = EXIT_BAD_INPUT if issues else EXIT_OK
        OUTPUT.print(found, exit_code, indent=2)
        raise typer.Exit(exit_code)
    if issues:
        raise ConfigError(issues)
    typer.echo(f"{output}: written; nlosrender plan {output} says what it costs.")


def _reading_order(line: KeyLine) -> tuple[int, int]:
    """Keys as the file has them, then those that it leaves out, then notes."""
    found = re.search(r":(\d+)(:\d+)?$", line.place)
    return (0, int(found[1])) if found else (2 if line.verdict == "note" else 1, 0)


def _point(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError
    except ValueError:
        raise typer.BadParameter(f"got {text!r}, need two numbers such as 0.1,-0.2", param_hint="--laser") from None
    return x, y
