"""``nlosrender bench``: run time against error."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, one_of, refuse_folder


def bench(
    scene: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Scene to race on; may be repeated.", show_default="all")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PART",
            help="curves, scaling, rates, skips, process, measure or factory; may be repeated.",
            show_default="all but factory",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Time for all of it, compilation on top.")] = 300.0,
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="Mesh about 0.8 m high, such as the Stanford bunny: adds the bunny's nine scenes.", readable=False
        ),
    ] = None,
    peer: Annotated[
        str | None, typer.Option(metavar="COMMAND", help="Also race another renderer, see 'make bench-peers'.")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="OUTPUT.json and OUTPUT.png are written.", readable=False)
    ] = Path("out/bench"),
    as_json: AsJson = False,
) -> None:
    """Measure run time against error on scenes with known truth, scaling, and rates.

    Example: nlosrender bench --scene plate --part curves --seconds 30 -o out/bench (prints a table, creates
    out/bench.json and out/bench.png)
    """
    from nlosrender.bench.bench_report import table, write_json, write_plot
    from nlosrender.bench.benchmark import DEFAULT_PARTS, PARTS, run_benchmark
    from nlosrender.bench.scenes import built_in_scenes
    from nlosrender.engine.backend.start import start_backend

    if mesh is not None and not mesh.is_file():
        raise typer.BadParameter(f"{mesh}: there is no such file", param_hint="--mesh")
    known = built_in_scenes(mesh, output.parent)
    # a real mesh tells more than the letters, which stand in for one
    names = scene or [name for name in known if mesh is None or name != "letters"]
    scenes = [known[one_of(name, known, "--scene", _remark(name))] for name in names]
    parts = [one_of(name, PARTS, "--part") for name in part or DEFAULT_PARTS]
    json_path, png_path = _outputs(output)
    start_backend()
    report = run_benchmark(scenes, seconds, parts, peer, lambda what: typer.echo(what, err=True))
    write_json(json_path, report)
    if report["scenes"]:
        write_plot(png_path, report)
    if as_json:
        OUTPUT.print(report)
    else:
        typer.echo(table(report))


def _outputs(output: Path) -> tuple[Path, Path]:
    """Return the names of report and plot, once it is sure that they can be written: before the work, not after it."""
    from nlosrender.files.atomic_write import check_writable, explained_write
    from nlosrender.files.file_kinds import PNG, REPORT

    refuse_folder(output, "bench")
    with explained_write(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    report, plot = output.with_name(output.name + ".json"), output.with_name(output.name + ".png")
    check_writable(report, REPORT)
    check_writable(plot, PNG)
    return report, plot


def _remark(scene: str) -> str:
    return " The bunny's scenes need --mesh." if scene.startswith("bunny") else ""
