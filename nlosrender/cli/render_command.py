"""``nlosrender render``: the main job."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from nlosrender.pipeline import Progress, RenderReport


def register(app: typer.Typer) -> None:
    """Add ``render`` to ``app``."""
    app.command()(render)


def render(
    config: Annotated[Path, typer.Argument(help="The YAML file that describes the capture.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write, instead of output.path.")
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key; may be repeated.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no report.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as one JSON object.")] = False,
) -> None:
    """Render a capture and write it as one HDF5 file.

    Example: nlosrender render configs/z-letter.yaml -o out/z-letter.hdf5
    creates out/z-letter.hdf5, a capture of a hidden letter Z.
    """
    from nlosrender.config.load import load_config
    from nlosrender.config.places import with_places
    from nlosrender.errors import ConfigError
    from nlosrender.pipeline import render_capture

    changes = list(overrides or [])
    if output is not None:
        changes.append(f"output.path={_quoted(output)}")
    loaded = load_config(config, changes)
    try:
        with _progress_bar(hidden=quiet) as progress:
            report = render_capture(loaded, progress, _ignore if quiet else _print_warning)
    except ConfigError as error:
        raise with_places(error, config, changes) from error
    if as_json:
        _print_json(report)
    elif not quiet:
        _print_report(report)


def _quoted(path: Path) -> str:
    import json

    return json.dumps(str(path))  # a JSON string is a YAML string: names such as "1e3" or "yes" stay text


def _ignore(text: str) -> None:
    pass


def _print_warning(text: str) -> None:
    from tqdm import tqdm

    tqdm.write(f"warning: {text}", file=sys.stderr)  # above the progress bar, not into it


@contextmanager
def _progress_bar(hidden: bool) -> Iterator[Progress]:
    from tqdm import tqdm

    layout = "{l_bar}{bar}| {elapsed}<{remaining}"
    with tqdm(total=1.0, disable=True if hidden else None, desc="render", bar_format=layout, leave=False) as bar:

        def progress(share: float) -> None:
            bar.update(max(0.0, min(share, 1.0) - bar.n))

        yield progress


def _print_json(report: RenderReport) -> None:
    import dataclasses
    import json
    import math

    content = dataclasses.asdict(report) | {"output": str(report.output)}
    if not math.isfinite(report.error_estimate):
        content["error_estimate"] = None  # pure noise: JSON knows no infinity
    typer.echo(json.dumps(content))


def _print_report(report: RenderReport) -> None:
    seconds = report.seconds
    typer.echo(f"wrote {report.output}")
    typer.echo(f"  engine          {report.engine}: {report.reason}")
    paths = f", {report.samples} paths per sensor point" if report.samples else ""
    typer.echo(f"  error estimate  {report.error_estimate:.2%} (relative L2){paths}")
    energies = ", ".join(f"{name}: {energy:.4g}" for name, energy in report.energy.items())
    typer.echo(f"  energy          bounce {energies}; outside the time window: {report.out_of_window:.4g}")
    stages = ", ".join(f"{stage} {spent:.2f}" for stage, spent in seconds.items() if stage != "total")
    typer.echo(f"  seconds         {seconds['total']:.2f} ({stages})")
