"""Places in the YAML for problems that only the renderer finds, such as a mesh file that cannot be read."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from nlosrender.config.overrides import apply_overrides
from nlosrender.config.yaml_tree import Document, read_document
from nlosrender.errors import ConfigError, ValidationIssue


def with_places(error: ConfigError, path: Path, overrides: Sequence[str] = ()) -> ConfigError:
    """Return ``error`` with the file, line and column of every problem that has only a key so far.

    Parameters
    ----------
    error
        Problems whose ``key`` is a dotted path into the configuration.
    path, overrides
        What the configuration was loaded from.
    """
    try:
        document = read_document(path.read_text(encoding="utf-8-sig"), str(path))
        apply_overrides(document, overrides)
    except (OSError, ValueError):  # gone or changed since it was loaded: the key alone has to do
        return error
    return ConfigError([_placed(problem, document) for problem in error.issues])


def _placed(issue: ValidationIssue, document: Document) -> ValidationIssue:
    return issue if issue.place or not issue.path else dataclasses.replace(issue, place=document.place(issue.path))
