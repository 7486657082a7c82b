"""``nlosrender frames``: the pictures of a line-of-sight capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.cli.options import beside


def frames(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Capture of scan type line_of_sight.", readable=False)],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="DIR|OUT.gif",
            help="Folder to fill, or the animation alone.",
            show_default="FILE-frames",
            readable=False,
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option("--format", metavar="exr|png|gif", help="What to write.", show_default="exr, or gif by -o"),
    ] = None,
    every: Annotated[
        int | None, typer.Option(metavar="BINS", help="Bins per picture.", show_default="about 120 pictures")
    ] = None,
    start: Annotated[
        float | None, typer.Option("--from", metavar="M", help="First optical path length [m].", show_default="light")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", metavar="M", help="Last optical path length [m].", show_default="light")
    ] = None,
    frames_per_second: Annotated[float, typer.Option("--fps", help="Pictures per second of a gif.")] = 12.0,
    exposure: Annotated[float, typer.Option(help="Brightness of png and gif, in stops.")] = 0.0,
) -> None:
    """Write what a camera saw as pictures: one per range of bins, and the steady picture.

    Frames that an earlier run left in the folder are replaced.

    Example: `nlosrender frames cornell-box.hdf5 -o box --format gif` creates box/frames.gif, box/steady.exr and
    box/steady.png and prints the folder; with `-o box.gif` it creates that file alone.
    """
    from nlosrender.analysis.frames import FrameOptions, is_animation, write_frames

    kind = kind or ("gif" if output is not None and is_animation(output) else "exr")
    options = FrameOptions(kind, every, start, end, frames_per_second, exposure)
    target = output or beside(file, "-frames")
    written = write_frames(file, target, options)
    typer.echo(f"wrote {target}" if written == [target] else f"wrote {len(written)} pictures into {target}")
