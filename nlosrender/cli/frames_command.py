"""``nlosrender frames``: the pictures of a line-of-sight capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add ``frames`` to ``app``."""
    app.command("frames")(frames)


def frames(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Capture of scan type line_of_sight.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder to fill.", show_default="FILE-frames")
    ] = None,
    kind: Annotated[str, typer.Option("--format", metavar="exr|png|gif", help="What to write.")] = "exr",
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

    Example: `nlosrender frames cornell-box.hdf5 -o box --format gif` creates box/frames.gif, box/steady.exr and
    box/steady.png and prints the folder.
    """
    from nlosrender.analysis.frames import FrameOptions, write_frames

    folder = output or file.with_name(f"{file.stem}-frames")
    written = write_frames(file, folder, FrameOptions(kind, every, start, end, frames_per_second, exposure))
    typer.echo(f"wrote {len(written)} pictures into {folder}")
