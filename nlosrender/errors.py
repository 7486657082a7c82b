"""Everything a user can run into, as exceptions that carry the process exit code.

Only ``cli/`` catches these and exits; everything else raises them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self, TypeAlias

EXIT_OK = 0
EXIT_FAILURE = 1
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_COMPARISON_EXCEEDED = 4
EXIT_INCOMPLETE = 5
EXIT_ENVIRONMENT = 6
EXIT_INTERRUPTED = 130


KeyPath: TypeAlias = tuple[str | int, ...]  # keys of a configuration from the root, or a section of it, down


class NlosError(Exception):
    """Base of every error that is explained to the user instead of traced."""

    exit_code: int = EXIT_FAILURE


@dataclass(frozen=True)
class ValidationIssue:
    """One mistake in a configuration: where it is and what to do about it."""

    path: KeyPath  # ("capture", "laser_grid", "nx"); empty when the whole file is meant
    message: str  # what was found, what is allowed, what to do
    at: Literal["value", "key"] = "value"  # which of the two is shown as the place
    place: str = ""  # "z.yaml:14:3" or "--set capture.laser_grid.nx=0"; empty: not known yet

    @property
    def key(self) -> str:
        """The dotted key, such as ``capture.laser_grid.nx``."""
        return ".".join(map(str, self.path))

    @classmethod
    def at_key(cls, key: str, message: str) -> Self:
        """Return the issue of a dotted key."""
        return cls(tuple(int(part) if part.isdigit() else part for part in key.split(".")), message)

    def below(self, path: KeyPath) -> Self:
        """Return the issue of a section, or of a value, as that of the whole it stands in at ``path``."""
        return replace(self, path=(*path, *self.path))

    def __str__(self) -> str:
        return ": ".join(part for part in (self.place, self.key, self.message) if part)


class ConfigError(NlosError):
    """The configuration cannot be used; holds every issue found, not only the first."""

    exit_code = EXIT_BAD_INPUT

    def __init__(self, issues: Sequence[ValidationIssue] | ValidationIssue):
        self.issues: tuple[ValidationIssue, ...] = (issues,) if isinstance(issues, ValidationIssue) else tuple(issues)
        super().__init__("\n".join(map(str, self.issues)))

    @classmethod
    def at(cls, key: str, message: str) -> Self:
        """Return the error of one dotted key whose place in the file is not known yet."""
        return cls(ValidationIssue.at_key(key, message))

    @classmethod
    def of_file(cls, place: str, message: str) -> Self:
        """Return the error of a whole file, or of a place in it that no key is known of."""
        return cls(ValidationIssue((), message, place=place))


class OptionError(NlosError):
    """An option of a command is impossible, by itself or for what it is used on."""

    exit_code = EXIT_USAGE


class FileError(NlosError):
    """A capture or mesh file cannot be read, written or understood."""

    exit_code = EXIT_BAD_INPUT


class DiskError(FileError):
    """A disk is full or fails: nothing is wrong with what was asked for."""

    exit_code = EXIT_FAILURE


class ComparisonError(NlosError):
    """Two captures, or two datasets, differ by more than their tolerances allow."""

    exit_code = EXIT_COMPARISON_EXCEEDED


class BackendError(NlosError):
    """The machine lacks what a render needs: no usable LLVM, no GPU."""

    exit_code = EXIT_ENVIRONMENT


class RenderError(NlosError):
    """The render itself failed: a non-finite result, not enough memory, a scene the renderer rejects."""


class IncompleteRender(NlosError):
    """The render failed half-way; what was finished is saved, and the same command goes on from there."""

    exit_code = EXIT_INCOMPLETE


class InterruptedRender(NlosError):
    """The user stopped the render; what was finished has been saved or removed as documented."""

    exit_code = EXIT_INTERRUPTED


class NlosWarning(UserWarning):
    """A warning that the command line prints, as Python programs get it."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name closest in spelling to ``name``, or None when none is close."""
    import difflib

    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return matches[0] if matches else None


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """Return the question after the nearest known name; empty where none is near."""
    close = nearest(value, known) if isinstance(value, str) else None
    return f"Did you mean {close}?" if close else ""
