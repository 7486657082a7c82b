"""Pydantic's errors -> problems a user can act on: place, dotted key, what was found, what is allowed."""

from __future__ import annotations

import re
import typing
from typing import Any, Literal

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from nlosrender.config.document import Config
from nlosrender.config.refusal import FAULT, refusal
from nlosrender.config.yaml_tree import Document
from nlosrender.errors import KeyPath, ValidationIssue, nearest

_NOT_A_MAPPING = ("model_type", "model_attributes_type", "dict_type", "mapping_type")


def locate(location: tuple[str | int, ...]) -> tuple[KeyPath, type[BaseModel]]:
    """Return the path of YAML keys of a pydantic location, and the section it ends in.

    Pydantic puts the tag of a union between the keys: ('scene', 'relay_wall', 'sphere', 'radius').
    """
    sections: list[type[BaseModel]] = [Config]
    path: list[str | int] = []
    section: type[BaseModel] = Config
    for step in location:
        tagged = [
            each
            for each in sections
            if len(sections) > 1 and step in typing.get_args(each.model_fields["type"].annotation)
        ]
        if tagged:  # the location of a rule has no tags
            sections, section = tagged, tagged[0]
            continue
        path.append(step)
        if isinstance(step, str) and sections:
            section = sections[0]
            known = section.model_fields.get(step)
            sections = _sections_in(known.annotation) if known else []
    return tuple(path), section


def _sections_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for part in typing.get_args(annotation) for section in _sections_in(part)]


def problem_from(error: ErrorDetails, document: Document) -> ValidationIssue:
    """Return one pydantic error as a problem with its place."""
    path, section = locate(error["loc"])
    kind, value, context = error["type"], error.get("input"), error.get("ctx", {})
    at: Literal["key", "value"] = "value"
    if kind == FAULT:
        message, at = context["message"], context["at"]
    elif kind == "missing":
        field = section.model_fields.get(str(path[-1]))
        message = f"missing, it is required: {field.description if field and field.description else 'no default'}."
    elif kind == "extra_forbidden":
        message, at = _unknown_key(path, section), "key"
    elif kind in ("union_tag_not_found", "union_tag_invalid"):
        path = (*path, "type")
        allowed = _names(context.get("expected_tags") or _tags(error["loc"]))
        given = value.get("type") if isinstance(value, dict) else None
        missing = kind == "union_tag_not_found" and not (isinstance(value, dict) and "type" in value)
        need = f"one of {', '.join(allowed)}"
        message = f"missing, need {need}." if missing else refusal(given, need, _did_you_mean(given, allowed))
    elif kind == "literal_error":
        allowed = _names(context["expected"])
        need = allowed[0] if len(allowed) == 1 else f"one of {', '.join(allowed)}"
        message = refusal(value, need, _did_you_mean(value, allowed))
    elif kind in _NOT_A_MAPPING:
        message = refusal(value, "a mapping of keys and values")
    elif kind == "tuple_type":
        message = refusal(value, "a list", "Write [] for an empty one." if value is None else "")
    else:
        message = f"{error['msg']}."
    return ValidationIssue(path, message, at, document.place(path, at))


def _tags(location: tuple[str | int, ...]) -> str:
    """Return the types allowed at a union, which pydantic does not name when ``type`` is missing."""
    path = [step for step in location if isinstance(step, str)]
    section: type[BaseModel] = Config
    for step in path[:-1]:
        section = _sections_in(section.model_fields[step].annotation)[0]
    options = _sections_in(section.model_fields[path[-1]].annotation)
    return ", ".join(f"'{typing.get_args(option.model_fields['type'].annotation)[0]}'" for option in options)


def _names(expected: str) -> list[str]:
    return re.findall(r"'([^']*)'", expected)


def _did_you_mean(value: object, allowed: list[str]) -> str:
    close = nearest(value, allowed) if isinstance(value, str) else None
    return f"Did you mean {close}?" if close else ""


def _unknown_key(path: KeyPath, section: type[BaseModel]) -> str:
    key, known = str(path[-1]), list(section.model_fields)
    close = nearest(key, known)
    if close:
        return f"unknown key. Did you mean {close}?"
    elsewhere = _homes(Config, key, ())
    move = f" It belongs in {elsewhere[0]}." if elsewhere else ""
    return f"unknown key, known here: {', '.join(known)}.{move}"


def _homes(section: type[BaseModel], key: str, path: tuple[str, ...]) -> list[str]:
    """Return the sections, as dotted paths, where ``key`` is known."""
    found = [".".join(path) or "the top level"] if key in section.model_fields else []
    for name, field in section.model_fields.items():
        options = _sections_in(field.annotation)
        if len(options) == 1:
            found += _homes(options[0], key, (*path, name))
    return found
