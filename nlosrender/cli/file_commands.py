"""Commands about one capture file: what it holds, pictures of it, other programs' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nlosrender.analysis.capture_table import summary_rows
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, CameraFile, CaptureFile, beside, two_numbers
from nlosrender.cli.tables import print_table
from nlosrender.readable import printable


def info(
    file: CaptureFile,
    as_json: AsJson = False,
    check: Annotated[
        bool, typer.Option("--check", help="Also check the layout and every sample; exit code 3 if anything is wrong.")
    ] = False,
) -> None:
    """Show what a capture file holds, from its metadata alone.

    Example: `nlosrender info z.hdf5 --check` prints the grids, the time axis, the bounces and where the file comes
    from, then reads all samples to see that third-party loaders will accept it, or, for a file by another program,
    that it is read right. It creates nothing.
    """
    from nlosrender.analysis.partial_summary import is_unfinished, partial_summary
    from nlosrender.analysis.summary import summarise
    from nlosrender.errors import EXIT_BAD_INPUT, EXIT_OK, FileError

    if is_unfinished(file):
        unfinished = partial_summary(file)
        if as_json:
            OUTPUT.print(unfinished)
        else:
            print_table((label.replace("_", " "), printable(value)) for label, value in unfinished.items())
        return
    summary, violations = summarise(file), ()  # type: dict[str, object], tuple[str, ...]
    if check:
        from nlosrender.files.validation import check_file

        found = check_file(file)
        violations = found.violations
        summary |= {
            "violations": list(violations),
            "deviations": list(found.deviations),
            "readable": found.is_ours or not violations,
            "complete": not (violations or found.deviations),
        }
    if as_json:
        OUTPUT.print(summary, EXIT_BAD_INPUT if violations else EXIT_OK)
    else:
        print_table(summary_rows(summary))
    if violations:
        listed = "\n".join(f"{file}: {printable(violation)}" for violation in violations)
        raise FileError(f"{listed}\nThe file deviates from the Z-NLOS layout: other loaders may refuse or misread it.")


def plot(
    file: CaptureFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="Picture: .png, .pdf or .svg.",
            show_default="FILE.png",
            readable=False,
        ),
    ] = None,
    laser: Annotated[
        str | None,
        typer.Option(
            metavar="IY,IX", help="Laser point (row, column) of an exhaustive capture.", show_default="the middle"
        ),
    ] = None,
    pixel: Annotated[
        str | None,
        typer.Option(
            metavar="IY,IX", help="Sensor point (row, column) of the histogram.", show_default="the brightest"
        ),
    ] = None,
    ideal: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of counts: the capture they were measured from.", readable=False),
    ] = None,
    theme: Annotated[str, typer.Option(metavar="dark|light", help="Ground of the picture.")] = "dark",
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Width and height in inches, or as 18x10cm.", show_default="14x7.6"),
    ] = None,
    dpi: Annotated[float, typer.Option(help="Pixels per inch of .png, and of the frames in .pdf and .svg.")] = 130,
    shared_scale: Annotated[
        bool, typer.Option("--shared-scale", help="One colour scale for all frames; else each has its own.")
    ] = False,
) -> None:
    """Draw a capture: the relay wall over time, one histogram, the light of each bounce, one row over time.

    Of a measured capture: the counts of a point beside its ideal histogram, and the detector's response.

    For a paper: `--theme light --size 18x10cm -o figure.pdf`.

    Example: `nlosrender plot z.hdf5 --pixel 6,8` creates z.png and prints its path.
    """
    from nlosrender.analysis.picture_style import PictureStyle, picture_size
    from nlosrender.analysis.plots import plot_capture

    need = "a row and a column counted from 0, such as 6,8"
    laser_at, pixel_at = two_numbers(laser, ",", "--laser", need), two_numbers(pixel, ",", "--pixel", need)
    look = PictureStyle(theme, picture_size(size), dpi, shared_scale)
    picture = output or beside(file, ".png")
    typer.echo(str(plot_capture(file, picture, laser=laser_at, pixel=pixel_at, ideal=ideal, look=look)))


def frames(
    file: CameraFile,
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


def export(
    file: CaptureFile,
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="tal (y-tal), fk (f-k migration), lct, phasor_mat (diffraction), or learned (for networks).",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="File to write.",
            show_default="FILE-FORMAT.hdf5 or .mat",
            readable=False,
        ),
    ] = None,
    bounces: Annotated[str, typer.Option(metavar="3|all", help="Light to export; bounces are summed.")] = "all",
    legs: Annotated[
        str | None,
        typer.Option(
            metavar="remove|keep",
            help="tal: whether time is counted from the wall, or the legs to the wall are left in.",
            show_default="remove",
        ),
    ] = None,
    key: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="learned: name of the variable, such as final_meas or data (t, row, column).",
            show_default="measlr",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a capture in the format of another program; what that cannot hold is refused or reported.

    Example: `nlosrender export z.hdf5 --format fk --bounces 3` creates z-fk.mat with `meas` and `tofgrid`, the third
    bounce of a confocal capture for f-k migration.
    """
    from nlosrender.errors import OptionError
    from nlosrender.files.export.export import export_capture, suffix_of

    if bounces not in ("3", "all"):
        raise OptionError(f"--bounces: got {bounces!r}, need 3 or all")
    ending = f"-{file_format}{suffix_of(file_format)}"
    target = output or beside(file, ending)
    report = export_capture(file, target, file_format, bounces, legs=legs, key=key)
    if as_json:
        OUTPUT.print({"written": str(report.path), "losses": report.losses})
        return
    typer.echo(f"wrote {report.path}")
    for loss in report.losses:
        typer.echo(f"note: {loss}", err=True)
