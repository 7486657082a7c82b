"""What a render says of itself when it is done: what was left out or is missing, why H is zero, a target missed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from nlosrender.config.document import Config
from nlosrender.config.render import RenderConfig
from nlosrender.errors import ConfigError, ValidationIssue
from nlosrender.files.capture_results import OMITTED, WARNINGS, SummedCapture

if TYPE_CHECKING:
    from nlosrender.engine.interface import Engine
    from nlosrender.engine.preflight.unsampled_paths import UnsampledPaths
    from nlosrender.files.sums import Sums

MISSED_BY = 1.25  # tolerance of the target: the error estimate has an error itself


def summed_capture(engine: Engine, unsampled: tuple[UnsampledPaths, ...], sums: Sums) -> SummedCapture:
    """Return what is known of a render whose work items are ``sums`` together."""
    from nlosrender.engine.preflight.zero_capture import zero_reasons

    return SummedCapture(
        sums,
        engine.options.bounces,
        tuple(paths.summary for paths in unsampled),
        () if sums.squares else zero_reasons(engine, unsampled, float(sums.outside)),
        min((paths.first_bounce for paths in unsampled), default=None),
    )


def remarks(engine: Engine, config: Config, warnings: Iterable[str]) -> dict[str, object]:
    """Return the attributes that say why this engine rendered, what it left out and why, and the warnings."""
    from nlosrender.engine.preflight.omitted_work import omitted_work

    omitted = omitted_work(engine, scene_is_colored=config.scene.is_colored)
    stated = [f"{work.what}: {work.why}" for work in omitted]
    return {"engine_reason": engine.reason, OMITTED: stated, WARNINGS: list(warnings)}


def missing_light(engine: Engine, strict: bool = False) -> tuple[UnsampledPaths, ...]:
    """Return the paths that carry light and that no technique of the engine samples.

    Raises
    ------
    ConfigError
        ``strict``, and there are any.
    """
    from nlosrender.engine.preflight.unsampled_paths import unsampled_paths

    found = unsampled_paths(engine)
    if strict and found:
        raise ConfigError([ValidationIssue.at_key(paths.key, f"--strict: {paths.warning}") for paths in found])
    return found


def missed_target(render: RenderConfig, stated: float) -> str | None:
    """Return a warning where the stated error is above the asked-for one; None where it is not, or not known."""
    asked = render.target_error
    if asked is None or not stated > MISSED_BY * asked:
        return None
    why = "surfaces and paths cost more than the engine can take, or a pilot of a few points saw less than there is"
    if render.time_limit_s is not None:
        why = f"render.time_limit_s is {render.time_limit_s:g}, or {why}"
    return f"render.target_error: {asked:.3g} was asked for, the error that is stated is {stated:.3g} ({why})."
