"""How a wrong value is told: one plain sentence with the value found and what is allowed.

The check of a value raises :class:`InvalidValue`; the value of its key is then :class:`Wrong`, until ``load`` has
collected every issue.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from nlosrender.errors import ValidationIssue

_MAX_SHOWN = 60  # characters of a wrong value that still help


class InvalidValue(ValueError):
    """What the check of a value raises: every issue found in it, with paths from the value down."""

    def __init__(self, *issues: ValidationIssue):
        self.issues = issues
        super().__init__("; ".join(issue.message for issue in issues))


class WrongValueRead(Exception):
    """A rule over several values reads one that is itself wrong, so the rule has nothing to say."""


class Wrong:
    """Stands where a value is missing or wrong; whoever reads anything of it gets ``WrongValueRead``."""

    def __init__(self, *issues: ValidationIssue):
        self.issues = issues

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what Python itself looks for
            raise AttributeError(name)
        raise WrongValueRead(name)

    def __len__(self) -> int:
        raise WrongValueRead


def invalid_value(value: object, need: str, advice: str = "") -> InvalidValue:
    """Return the error of a value that is not what is needed."""
    return InvalidValue(ValidationIssue((), mismatch(value, need, advice)))


def wrong_value(value: object, need: str, advice: str = "") -> Wrong:
    """Return what stands for a value that is not what is needed."""
    return Wrong(ValidationIssue((), mismatch(value, need, advice)))


def mismatch(value: object, need: str, advice: str = "") -> str:
    """Return the sentence ``got <value>, need <need>. <advice>``."""
    return f"got {shown(value)}, need {need}." + (f" {advice}" if advice else "")


def one_of(names: Iterable[str]) -> str:
    """Return what is needed where one of a few names is."""
    known = list(names)
    return known[0] if len(known) == 1 else f"one of {', '.join(known)}"


def shown(value: object) -> str:
    """Return ``value`` as a user wrote it, with its type where that is the mistake, cut to a readable length."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"{_cut(value)!r} (text)"
    if isinstance(value, Mapping):
        return f"a mapping with {', '.join(map(str, list(value)[:5]))}" if value else "an empty mapping"
    if isinstance(value, (list, tuple)):
        return _cut("[" + ", ".join(_element(item) for item in value[:12]) + (", ..." if len(value) > 12 else "") + "]")
    return f"{value:.12g}" if isinstance(value, float) else _cut(str(value))


def _element(value: object) -> str:
    if isinstance(value, str):
        return repr(_cut(value))
    if isinstance(value, Mapping):
        return "{...}"
    return "null" if value is None else shown(value)


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."
