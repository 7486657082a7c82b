"""What a render says of itself when it is done: light that is missing, why H is zero, a target that was missed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nlosrender.capture.bounces import BounceAxis
from nlosrender.config.render import RenderConfig
from nlosrender.errors import ConfigError, ValidationIssue
from nlosrender.files.parts.part_attributes import MISSED, known_of, summed_attributes

if TYPE_CHECKING:
    from nlosrender.engine.preflight.unsampled_paths import UnsampledPaths
    from nlosrender.files.sums import Sums
    from nlosrender.rendering.work_items import Engine

MISSED_BY = 1.25  # times the target: the estimate has an error of its own


@dataclass(frozen=True)
class Outcome:
    """What is known of a render beside its samples."""

    sums: Sums
    bounces: BounceAxis
    unsampled: tuple[UnsampledPaths, ...]
    zero_because: tuple[str, ...]  # empty where H is not zero everywhere
    missed: str | None  # a warning: the stated error is above the target

    @classmethod
    def of(cls, render: RenderConfig, engine: Engine, unsampled: tuple[UnsampledPaths, ...], sums: Sums) -> Outcome:
        """Return the outcome of a render whose work items are ``sums`` together."""
        from nlosrender.engine.preflight.zero_capture import zero_reasons

        zero = () if sums.squares else zero_reasons(engine, unsampled, float(sums.outside))
        stated = sums.stated_error(tuple(paths.summary for paths in unsampled))
        return cls(sums, engine.options.bounces, unsampled, zero, missed_target(render, stated))

    @property
    def missing(self) -> tuple[str, ...]:
        """The paths that are not sampled, one sentence for each class."""
        return tuple(paths.summary for paths in self.unsampled)

    @property
    def stated_error(self) -> float:
        """Relative L2 error of H; NaN where light is missing."""
        return self.sums.stated_error(self.missing)

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings that take the finished capture."""
        dark = [f"H is zero everywhere: {'; '.join(self.zero_because)}."] if self.zero_because else []
        return [*dark, *([self.missed] if self.missed else [])]

    def attributes(self, seconds: Mapping[str, float], *, is_whole: bool) -> dict[str, object]:
        """Return the results that the file holds; of a part (not ``is_whole``) without what takes the whole capture."""
        lowest = self._first_unknown_bounce
        results = summed_attributes(self.sums, self.bounces, seconds, self.missing, self.zero_because, lowest)
        return results | {MISSED: self.missed} if self.missed and is_whole else results

    def known_per_bounce(self, errors: Mapping[str, float]) -> dict[str, float | None]:
        """Return errors by bounce number; None where they are not known."""
        return known_of(errors, self.bounces, self._first_unknown_bounce)

    @property
    def _first_unknown_bounce(self) -> int | None:
        return min((paths.first_bounce for paths in self.unsampled), default=None)


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
