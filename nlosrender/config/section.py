"""What every section of the config has in common: frozen, no unknown keys, rules over several keys."""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from nlosrender.config.issues import Wrong, WrongValueRead, one_of, shown, wrong_value
from nlosrender.config.vectors import parallel
from nlosrender.errors import KeyPath, ValidationIssue, did_you_mean


class Section(BaseModel):
    """A mapping of the YAML; attribute names are its keys.

    Every mistake in it is found in one validation: a value that is wrong does not raise, its key is left without a
    value. ``load.validated`` makes sections and collects the issues.
    """

    # Attribute docstrings feed the JSON Schema and the messages about missing keys: one text, one place.
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    _wrong: dict[str, Wrong] | None = PrivateAttr(default=None)  # values that are wrong, and those of unknown keys

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Return the raw values with those added that depend on others; nothing in ``raw`` is known to be right."""
        return raw

    @model_validator(mode="wrap")
    @classmethod
    def _keep_what_is_right(cls, raw: Any, handler: ModelWrapValidatorHandler[Self], validation: ValidationInfo) -> Any:
        if isinstance(raw, Wrong):
            return raw
        if not isinstance(raw, Mapping):
            return wrong_value(raw, "a mapping of keys and values")
        fields = cls.model_fields
        raw = cls.with_defaults({**raw}, validation)
        for key, field in fields.items():
            if key not in raw and field.is_required():
                raw[key] = Wrong(ValidationIssue((), f"missing, it is required: {field.description or 'no default'}."))
        section = handler({key: value for key, value in raw.items() if key in fields})
        wrong = {key: value for key, value in vars(section).items() if isinstance(value, Wrong)}
        for key in wrong:
            del vars(section)[key]
        wrong |= {key: Wrong() for key in raw if key not in fields}
        if wrong:
            section._wrong = wrong
        return section

    if not TYPE_CHECKING:  # else every attribute would be known to exist

        def __getattr__(self, name: str) -> Any:
            """Tell a rule that it reads a wrong value."""
            if not name.startswith("_") and name in type(self).model_fields:
                raise WrongValueRead(name)
            return super().__getattr__(name)

    @property
    def has_unknown_keys(self) -> bool:
        """Whether keys stand here that are none of this section's: what seems missing may be misspelt."""
        return any(key not in type(self).model_fields for key in self._wrong or {})

    def issues(self, path: KeyPath, root: type[Section]) -> Iterator[ValidationIssue]:
        """Yield what is wrong in this section and those in it; a method ``rule_...`` ends where it reads a wrong value.

        Parameters
        ----------
        path
            Where the section stands.
        root
            The section in which homes of unknown keys are looked for.
        """
        wrong = self._wrong or {}
        for key, value in (vars(self) | wrong).items():
            if isinstance(value, (Section, Wrong, tuple, dict)):
                yield from issues_in(value, (*path, key), root)
        for key in [key for key in wrong if key not in type(self).model_fields]:
            yield ValidationIssue((*path, key), _unknown_key(key, type(self), root), "key")
        for name in _rule_names(type(self)):
            with suppress(WrongValueRead):
                for issue in getattr(self, name)():
                    yield issue.below(path)


def issues_in(value: Any, path: KeyPath, root: type[Section]) -> Iterator[ValidationIssue]:
    """Yield what is wrong in the value of a field, or in a section."""
    if isinstance(value, Section):
        yield from value.issues(path, root)
    elif isinstance(value, Wrong):
        yield from (issue.below(path) for issue in value.issues)
    elif type(value) in (tuple, dict):
        for key, item in enumerate(value) if type(value) is tuple else value.items():
            yield from issues_in(item, (*path, key), root)


@cache
def _rule_names(section: type[Section]) -> tuple[str, ...]:
    return tuple(name for name in dir(section) if name.startswith("rule_"))


def _unknown_key(key: str, section: type[Section], root: type[Section]) -> str:
    known = list(section.model_fields)
    if close := did_you_mean(key, known):
        return f"unknown key. {close}"
    homes = _homes(root, key, ())
    return f"unknown key, known here: {', '.join(known)}." + (f" It belongs in {homes[0]}." if homes else "")


def _homes(section: type[Section], key: str, path: tuple[str, ...]) -> list[str]:
    """Return the sections, as dotted paths, where ``key`` is known."""
    found = [".".join(path) or "the top level"] if key in section.model_fields else []
    for name, field in section.model_fields.items():
        options = sections_in(field.annotation)
        if len(options) == 1:
            found += _homes(options[0], key, (*path, name))
    return found


@dataclass(frozen=True)
class Guard:
    """Pydantic metadata: a look at the raw value before pydantic's own check, for messages in our words.

    Parameters
    ----------
    look
        Takes the value and the names that the annotated type knows: those of a Literal, or the types of a union;
        returns what stands for a wrong value, else None.
    """

    look: Callable[[Any, Sequence[str]], Wrong | None]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return pydantic's schema behind the look."""
        is_literal = typing.get_origin(source) is typing.Literal
        known = typing.get_args(source) if is_literal else [*map(type_of, sections_in(source))]

        def check(value: Any, inner: core_schema.ValidatorFunctionWrapHandler) -> Any:
            wrong = value if isinstance(value, Wrong) else self.look(value, known)
            return inner(value) if wrong is None else wrong

        return core_schema.no_info_wrap_validator_function(check, handler(source))


def _look_for_list(value: Any, _: Sequence[str]) -> Wrong | None:
    advice = "Write [] for an empty one." if value is None else ""
    return None if isinstance(value, (list, tuple)) else wrong_value(value, "a list", advice)


def _look_for_mapping(value: Any, _: Sequence[str]) -> Wrong | None:
    return None if isinstance(value, Mapping) else wrong_value(value, "a mapping of keys and values")


def _look_for_name(value: Any, known: Sequence[str]) -> Wrong | None:
    return None if value in known else wrong_value(value, one_of(known), did_you_mean(value, known))


def _look_for_type(value: Any, known: Sequence[str]) -> Wrong | None:
    if not isinstance(value, Mapping):
        return _look_for_mapping(value, known)
    if "type" not in value:
        return Wrong(ValidationIssue(("type",), f"missing, need {one_of(known)}."))
    wrong = _look_for_name(value["type"], known)
    return None if wrong is None else Wrong(*(issue.below(("type",)) for issue in wrong.issues))


LIST, MAPPING = Guard(_look_for_list), Guard(_look_for_mapping)
ONE_OF = Guard(_look_for_name)  # of a Literal
BY_TYPE = Guard(_look_for_type)  # of a union of sections


def type_of(section: type[BaseModel]) -> str:
    """Return the ``type`` that a member of a union is told by; empty for other sections."""
    field = section.model_fields.get("type")
    return str(typing.get_args(field.annotation)[0]) if field else ""


def sections_in(annotation: Any) -> list[type[Section]]:
    """Return the sections in the annotation of a field: one, or the members of a union."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for part in typing.get_args(annotation) for section in sections_in(part)]


def pose_issues(normal: Sequence[float], up: Sequence[float]) -> Iterator[ValidationIssue]:
    """Yield the issue of an ``up`` that does not tell the pose's y axis."""
    if parallel(normal, up):
        message = f"up {shown(up)} is parallel to normal {shown(normal)}, need two directions that span a plane."
        yield ValidationIssue(("up",), message)
