"""``--set a.b.c=VALUE``: single values put over those of the file, before validation."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nlosrender.config.document import Config
from nlosrender.config.issues import Wrong, shown
from nlosrender.config.section import Section, sections_in
from nlosrender.config.yaml_tree import MAX_DEPTH, Document, Place, read_document
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

_NOTHING = ("", "~", "null", "Null", "NULL")
_GOALS = ("spp", "target_error")  # exclude each other
_MAX_PLACE = 80  # characters of an absurd override that still help


def apply_overrides(document: Document, overrides: Sequence[str]) -> None:
    """Put each ``a.b.c=VALUE`` into the document; mistakes become issues of the document.

    Parameters
    ----------
    document
        Changed in place; its tree must be a mapping.
    overrides
        Keys joined by dots, numbers index lists; the value is YAML, but as it stands where a key takes text. Missing
        mappings are created.
    """
    document.overrides = tuple(overrides)
    for override in overrides:
        place = f"--set {override}"
        key, equals, text = override.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or not all(parts):
            message = "need KEY=VALUE with dots between keys, such as --set capture.sensor_grid.nx=16."
            document.issues.append(ValidationIssue((), message, place=place))
            continue
        if len(parts) > MAX_DEPTH:
            message = f"got {len(parts)} keys, one inside the other; need at most {MAX_DEPTH}."
            document.issues.append(ValidationIssue((), message, place=place[:_MAX_PLACE]))
            continue
        try:
            value = _value(parts, key, text, place)
            put(document, parts, value, Place(place, place))
        except ConfigError as error:
            document.issues.extend(error.issues)


def _value(parts: Sequence[str], key: str, text: str, place: str) -> Any:
    """Read VALUE; where it stands inside the override is not worth telling."""
    bare = text.strip()
    if takes_text(parts) and bare not in _NOTHING and bare[:1] not in ("'", '"'):
        return bare  # "{name}.hdf5", "a: b.ply" and "1e3" are names here: a shell has taken the quotes away
    try:
        read = read_document(text, place)
        if read.issues:
            raise ConfigError(read.issues)
    except ConfigError as error:
        raise ConfigError([ValidationIssue((key,), found.message, place=place) for found in error.issues]) from error
    return read.tree


def takes_text(parts: Sequence[str]) -> bool:
    """Return whether the value of a key, told by its parts from the root down, is a name, a text or a file."""
    sections: list[type[Section]] = [Config]
    annotations: list[Any] = []
    for part in parts:
        if not part.isdecimal():  # an item of a list is one of the sections that the list may hold
            annotations = [
                section.model_fields[part].annotation for section in sections if part in section.model_fields
            ]
            sections = [section for annotation in annotations for section in sections_in(annotation)]
    return parts[-1] == "filename" or any(map(_is_text, annotations))  # Mitsuba's plugins have no schema here


def _is_text(annotation: Any) -> bool:
    of_items = typing.get_origin(annotation) in (dict, tuple)
    return annotation in (str, Path) or (not of_items and any(map(_is_text, typing.get_args(annotation))))


def put(document: Document, parts: Sequence[str], value: Any, place: Place) -> None:
    """Set one value of the document, creating mappings on the way; from there on its places are ``place``.

    Parameters
    ----------
    document
        Changed in place; its tree must be a mapping.
    parts
        Keys from the root down; numbers index lists.
    value, place
        What to put there, and where that stands.

    Raises
    ------
    ConfigError
        There is something else than a mapping or a list on the way, or a list is too short.
    """
    container, path = document.tree, ()  # type: tuple[Any, KeyPath]
    for depth, part in enumerate(parts):
        step = _step(container, part, path, place.value)
        path = (*path, step)
        if depth == len(parts) - 1:
            container[step] = value
            _drop_other_goal(document, path)
        elif isinstance(container, list):
            container = container[step]  # type: ignore[index]
        else:
            if container.get(step) is None:
                container[step] = {}
                _set_place(document, path, place)
            container = container[step]
    _set_place(document, path, place)


def _drop_other_goal(document: Document, path: KeyPath) -> None:
    """Let a goal that is set over the file's win over the other one, which it excludes."""
    section = document.tree.get("render")
    for goal, other in (_GOALS, _GOALS[::-1]):
        if path == ("render", goal) and section.get(goal) is not None and section.get(other) is not None:
            note = f"render.{other} has no effect beside render.{goal}, which is set over it."
            document.notes.append(note)
            section[other] = None


def _set_place(document: Document, path: KeyPath, place: Place) -> None:
    for known in [known for known in document.places if known[: len(path)] == path]:
        del document.places[known]
    document.places[path] = place


def _step(container: Any, part: str, path: KeyPath, place: str) -> str | int:
    """Return the key or index ``part`` stands for in ``container``."""
    where = ".".join(map(str, path))
    if isinstance(container, dict):
        return part
    if isinstance(container, Wrong):
        raise ConfigError(())  # told already
    if not isinstance(container, list):
        message = f"cannot set {part} in {where}, which holds {shown(container)}; need a mapping or a list there."
        raise ConfigError(ValidationIssue(path, message, place=place))
    if not part.isdecimal() or int(part) >= len(container):
        allowed = f"an index from 0 to {len(container) - 1}" if container else "a non-empty list"
        message = f"got {part} in a list of {len(container)}, need {allowed}."
        raise ConfigError(ValidationIssue((*path, part), message, place=place))
    return int(part)
