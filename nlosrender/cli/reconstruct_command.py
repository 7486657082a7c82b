"""``nlosrender reconstruct``: from a capture back to the hidden scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, CaptureFile, Quiet, beside
from nlosrender.cli.progress import reporting
from nlosrender.cli.tables import print_table
from nlosrender.readable import readable_duration

if TYPE_CHECKING:
    from nlosrender.analysis.reconstruction.reconstruct import Reconstruction
    from nlosrender.analysis.reconstruction.score import Score


def reconstruct(
    file: CaptureFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT.hdf5",
            help="Volume to write.",
            show_default="FILE-METHOD.hdf5",
            readable=False,
        ),
    ] = None,
    method: Annotated[str, typer.Option(help="phasor, or backprojection (any relay wall, slower).")] = "phasor",
    wavelength: Annotated[
        float | None,
        typer.Option(metavar="M", help="Of the virtual wave [m].", show_default="the shortest without aliasing"),
    ] = None,
    cycles: Annotated[float, typer.Option(help="Wavelengths in the virtual pulse.")] = 5.0,
    volume_center: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z", help="Middle of the volume [m]: along the wall, up, away.", show_default="the file's"
        ),
    ] = None,
    volume_size: Annotated[
        str | None,
        typer.Option(
            metavar="W,H,D", help="Edges of the volume [m], or one for all.", show_default="the file's + margin"
        ),
    ] = None,
    voxels: Annotated[
        int | None, typer.Option(metavar="N", help="Voxels along the longest edge.", show_default="128")
    ] = None,
    voxel_size: Annotated[
        float | None, typer.Option(metavar="M", help="Edge of a voxel [m], instead of --voxels.")
    ] = None,
    bounces: Annotated[
        str | None,
        typer.Option(metavar="3|all", help="Light to reconstruct from.", show_default="3 where the file has it apart"),
    ] = None,
    png: Annotated[bool, typer.Option("--png", help="Also draw a picture, named as the volume.")] = False,
    score: Annotated[
        bool, typer.Option("--score", help="Compare with the true silhouette (of a file that carries its scene).")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the hidden scene of a capture with phasor fields or filtered backprojection.

    Example: `nlosrender reconstruct z-letter.hdf5 -o z.hdf5 --png --score` creates z.hdf5, a volume of 128 voxels
    along its longest edge, and z.png, a picture of it, and prints how well it matches the true silhouette.
    """
    from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
    from nlosrender.analysis.reconstruction.volume_file import write_volume
    from nlosrender.errors import OptionError
    from nlosrender.files.atomic_write import check_writable
    from nlosrender.files.file_kinds import PNG, VOLUME

    center, size = _lengths(volume_center, "--volume-center"), _lengths(volume_size, "--volume-size")
    settings = ReconstructionSettings(method, wavelength, cycles, center, size, voxels, voxel_size, bounces)
    volume_path = output or beside(file, f"-{method}.hdf5")
    check_writable(volume_path, VOLUME, [file])  # before the work, not after it
    picture_path = volume_path.with_suffix(".png")
    if png and picture_path == volume_path:
        raise OptionError(f"--output: got {str(volume_path)!r}, the name --png gives the picture. Name it .hdf5")
    if png:
        check_writable(picture_path, PNG, [file])
    with reporting("reconstruct", quiet) as (progress, warn, _):
        found = reconstruct_capture(file, settings, progress, warn)
    silhouette, scored = None, None
    if score:
        from nlosrender.analysis.reconstruction.score import score_front_view

        silhouette = found.silhouette()
        scored = score_front_view(found.front_view(), silhouette)
    attributes: dict[str, object] = {}
    if scored is not None:
        attributes = {"score_correlation": scored.correlation, "score_iou": scored.iou}
    written = [write_volume(found, volume_path, silhouette, attributes)]
    if png:
        from nlosrender.analysis.reconstruction.picture import draw_reconstruction

        written.append(draw_reconstruction(found, picture_path, silhouette, scored))
    if as_json:
        report = {
            "written": [str(path) for path in written],
            "method": found.method,
            "wavelength": found.wavelength,
            "cycles": found.cycles,
            "bounces": found.bounces,
            "voxels": found.grid.shape[::-1],
            "voxel_size": found.grid.voxel_size,
            "volume": [corner.tolist() for corner in found.grid.bounds],
            "seconds": found.seconds,
            "warnings": found.warnings,
            "score": None if scored is None else dataclasses.asdict(scored),
        }
        OUTPUT.print(report)
    elif not quiet:
        _print_report(found, scored, written)


def _lengths(text: str | None, option: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"got {text!r}, need lengths in m such as 1,0.8,0.5", param_hint=option) from error


def _print_report(found: Reconstruction, score: Score | None, written: list[Path]) -> None:
    from nlosrender.analysis.reconstruction.reconstruct import settings_text

    low, high = found.grid.bounds
    ranges = ", ".join(f"{name} {a:.3g} to {b:.3g}" for name, a, b in zip("xyz", low, high, strict=True))
    typer.echo("wrote " + ", ".join(str(path) for path in written))
    rows = [
        ("method", settings_text(found)),
        ("volume", f"{ranges} m in the wall's frame"),
        ("bounces", ", ".join(str(bounce) for bounce in found.bounces)),
    ]
    if score is not None:
        agreement = f"correlation {score.correlation:.3f}, IoU {score.iou:.3f} with the true silhouette"
        rows.append(("score", f"{agreement} (threshold {score.threshold:.2f} of the largest value)"))
    print_table([*rows, ("took", readable_duration(found.seconds))], indent=2)
