"""``nlosrender check-engines``: do the techniques that can render a scene agree?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson, ConfigFile, Overrides

if TYPE_CHECKING:
    from nlosrender.analysis.engine_check import EngineCheck, PairCheck


def check_engines(
    config: ConfigFile,
    overrides: Overrides = None,
    points: Annotated[
        int, typer.Option("--points", metavar="N", min=1, max=16, help="Sensor points along each side of the grid.")
    ] = 4,
    target_error: Annotated[
        float, typer.Option(metavar="X", min=1e-6, max=1.0, help="Relative L2 error of H at which a technique stops.")
    ] = 0.01,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=0.1, help="Longest time of a technique, without set-up.")
    ] = 20.0,
    significance: Annotated[
        float, typer.Option(metavar="P", min=1e-9, max=0.5, help="Chance of an alarm where all techniques are right.")
    ] = 0.01,
    as_json: AsJson = False,
) -> None:
    """Render a few sensor points by every technique that can, and test whether they agree.

    Light that no technique samples, and a scene that is read wrongly, are the same for all of them: not tested.

    Exit code 0: no difference that noise does not explain; 4: a difference; 1: fewer than two techniques can render
    the scene.

    Example: nlosrender check-engines configs/z-letter.yaml --points 3 (writes nothing; prints per bounce how far path
    tracing with and without hidden geometry sampling and virtual lights are apart at 3 x 3 sensor points, and how
    small a difference would have been seen)
    """
    from nlosrender.analysis import engine_check
    from nlosrender.config.load import config_of, load_document
    from nlosrender.errors import EXIT_COMPARISON_EXCEEDED, EXIT_FAILURE, EXIT_OK, ComparisonError, RenderError

    document = load_document(config, overrides or ())
    loaded = config_of(document)
    with document.placing_issues():
        check = engine_check.check_engines(
            loaded,
            points_per_axis=points,
            target_error=target_error,
            time_limit_s=seconds,
            significance=significance,
            progress=lambda name: typer.echo(f"rendering by {name}", err=True),
        )
    apart = [pair for pair in check.pairs if not pair.agrees]
    if as_json:
        failed = EXIT_FAILURE if not check.pairs else EXIT_COMPARISON_EXCEEDED if apart else EXIT_OK
        OUTPUT.print(check.as_json(), failed)
    else:
        _print_check(check)
    for paths in check.unsampled_paths:
        typer.echo(f"warning: no technique samples {paths}; agreement says nothing about this light", err=True)
    if not check.pairs:
        raise RenderError(f"{config}: fewer than two techniques can render this scene; there is nothing to compare.")
    if apart:
        raise ComparisonError("\n".join(f"{config}: {' and '.join(p.techniques)} differ: {p.worst}" for p in apart))


def _print_check(check: EngineCheck) -> None:
    lasers = "" if check.n_lasers == 1 else f", {check.n_lasers} laser points"
    typer.echo(f"points   {check.n_sensors} sensor points{lasers}")
    for trial in check.trials:
        if trial.obstacle is None:
            typer.echo(f"{trial.technique}: estimated error {trial.error:.2%} of H after {trial.seconds:.1f} s")
        else:
            typer.echo(f"{trial.technique}: not rendered, {trial.obstacle}")
    for pair in check.pairs:
        _print_pair(pair)


def _print_pair(pair: PairCheck) -> None:
    typer.echo(f"{' against '.join(pair.techniques)}: {'agree' if pair.agrees else 'DIFFER'}")
    if pair.n_statements == 0:
        typer.echo("  no bins with enough light to compare: no difference would have been seen")
    else:
        allowed = f"{pair.z_limit:.2f} sigma allowed in {pair.n_statements} statements"
        worst = f" ({pair.worst})" if pair.worst else ""
        typer.echo(f"  largest deviation {pair.z:.2f} of {allowed}{worst}")
    for bounce in pair.bounces:
        if bounce.energy is None or bounce.visible_energy is None:
            found = f"no light by {pair.techniques[1]}"
        else:
            found = (
                f"energy {bounce.energy:+.2%} (would see differences above {bounce.visible_energy:.2%}), "
                f"relative L2 {bounce.rel_l2:.2%} ({bounce.expected_rel_l2:.2%} expected)"
            )
        typer.echo(f"  bounce {bounce.bounce}: {found}")
