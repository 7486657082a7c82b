"""``nlosrender paper``: the paper's figures and tables, reproduced."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.options import one_of
from nlosrender.cli.tables import print_table

if TYPE_CHECKING:
    from nlosrender.bench.paper.figure import PaperFigure


def paper(
    figure: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Figure or table such as 4 or table1; may be repeated.", show_default="all"),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer points and paths: minutes instead of an hour.")] = False,
    meshes_only: Annotated[
        bool, typer.Option("--meshes-only", help="Write the generated meshes of the room configurations and stop.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of every render.")] = 0,
    configs: Annotated[Path, typer.Option(help="Folder of the paper's configurations.", readable=False)] = Path(
        "configs/paper"
    ),
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write.", readable=False)
    ] = Path("out/paper"),
) -> None:
    """Reproduce the figures and tables of Royo et al. 2022 into one HTML page.

    Example: nlosrender paper --quick --figure 4 -o out/paper (creates out/paper/index.html, a page with the Z
    letter's capture and its wavefronts)
    """
    from nlosrender.bench.paper.reproduce import FIGURES, reproduce
    from nlosrender.bench.paper.rooms import write_meshes
    from nlosrender.bench.paper.study import Study
    from nlosrender.errors import EXIT_FAILURE

    for name in figure or ():
        one_of(name, FIGURES, "--figure")
    if not configs.is_dir():
        raise typer.BadParameter(f"{configs}: there is no such folder", param_hint="--configs")
    study = Study(configs, output, quick, seed, lambda what: typer.echo(what, err=True))
    if meshes_only:
        for path in write_meshes(study):
            typer.echo(f"mesh: {path}")
        return
    figures, page = reproduce(study, figure or FIGURES, _print_figure)
    typer.echo(f"page: {page}")
    if not all(found.holds for found in figures):
        raise typer.Exit(EXIT_FAILURE)


def _print_figure(figure: PaperFigure) -> None:
    typer.echo(f"\n{figure.name}: {figure.title} ({figure.seconds:.1f} s)\n  {figure.measured}")
    for check in figure.checks:
        typer.echo(f"  {'holds' if check.holds else 'FAILS'}: {check.statement}")
    for table in figure.tables:
        print_table([table.columns, *table.rows], indent=2)
