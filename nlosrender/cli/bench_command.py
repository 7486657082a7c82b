"""``nlosrender bench``: run time against error."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT


def register(app: typer.Typer) -> None:
    """Add ``bench`` to ``app``."""
    app.command(
        epilog="Example: nlosrender bench --scene plate --part curves --seconds 30 -o out/bench   "
        "(prints a table, creates out/bench.json and out/bench.png)"
    )(bench)


def bench(
    scene: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Scene to race on; may be repeated.", show_default="all"),
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PART", help="curves, scaling, rates, skips or process; may be repeated.", show_default="all"
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for all of it, compilation on top.")] = 300.0,
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="Mesh about 0.8 m high, such as the Stanford bunny: adds the bunny's three scenes.", readable=False
        ),
    ] = None,
    peer: Annotated[
        str | None,
        typer.Option(metavar="COMMAND", help="Also race another renderer, see 'make bench-peers'."),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="OUTPUT.json and OUTPUT.png are written.", readable=False)
    ] = Path("out/bench"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Measure run time against error on scenes with known truth, scaling, and rates."""

    from nlosrender.bench.benchmark import PARTS, run_benchmark
    from nlosrender.bench.report import table, write_json, write_plot
    from nlosrender.bench.scenes import built_in_scenes
    from nlosrender.engine.backend.start import start_backend

    if mesh is not None and not mesh.is_file():
        raise typer.BadParameter(f"{mesh}: there is no such file", param_hint="--mesh")
    known = built_in_scenes(mesh)
    # a real mesh tells more than the letters, which stand in for one
    names = scene or [name for name in known if mesh is None or name != "letters"]
    scenes = [known[_one_of(name, known, "--scene")] for name in names]
    parts = [_one_of(name, PARTS, "--part") for name in part or PARTS]
    json_path, png_path = _outputs(output)
    start_backend()
    found = run_benchmark(scenes, seconds, parts, peer, lambda what: typer.echo(what, err=True))
    report = found.report()
    write_json(json_path, report)
    if report["scenes"]:
        write_plot(png_path, report)
    if as_json:
        OUTPUT.print(report)
    else:
        typer.echo(table(report))


def _outputs(output: Path) -> tuple[Path, Path]:
    """Return the names of report and plot, once it is sure that they can be written: before the work, not after it."""
    from nlosrender.errors import FileError
    from nlosrender.files.atomic_write import check_writable, explained_write
    from nlosrender.files.file_kinds import PNG, REPORT

    if output.name in ("", ".."):
        raise FileError(f"{output}: is a folder. Name files in it, such as {output / 'bench'}")
    with explained_write(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    report, plot = output.with_name(output.name + ".json"), output.with_name(output.name + ".png")
    check_writable(report, REPORT)
    check_writable(plot, PNG)
    return report, plot


def _one_of(name: str, known: Iterable[str], option: str) -> str:
    from nlosrender.errors import nearest

    names = list(known)
    if name not in names:
        close = nearest(name, names)
        hint = f" Did you mean {close}?" if close else ""
        needs_mesh = " The bunny's scenes need --mesh." if name.startswith("bunny") else ""
        raise typer.BadParameter(f"got {name!r}, need one of {', '.join(names)}.{hint}{needs_mesh}", param_hint=option)
    return name
