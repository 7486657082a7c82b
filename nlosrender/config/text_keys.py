"""Keys that take a name, a text or a file, whatever it looks like."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from nlosrender.config.document import Config

_IN_PLUGINS = ("filename",)  # the mappings of Mitsuba's plugins have no schema here


def takes_text(parts: Sequence[str]) -> bool:
    """Return whether the value of a key, told by its parts from the root down, is text and nothing else."""
    annotations: list[Any] = [Config]
    for part in parts:
        annotations = [inner for outer in annotations for inner in _inside(outer, part)]
    return parts[-1] in _IN_PLUGINS or any(option in (str, Path) for one in annotations for option in _options(one))


def _inside(annotation: Any, part: str) -> Iterator[Any]:
    """Yield the annotations of what ``part`` names in a section, or of an item of a list."""
    for option in _options(annotation):
        if isinstance(option, type) and issubclass(option, BaseModel):
            if part in option.model_fields:
                yield option.model_fields[part].annotation
        elif part.isdecimal() and typing.get_origin(option) is tuple:
            yield typing.get_args(option)[0]


def _options(annotation: Any) -> Iterator[Any]:
    """Yield the members of unions, without what pydantic notes about them."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        yield from _options(typing.get_args(annotation)[0])
    elif origin in (typing.Union, types.UnionType):
        for member in typing.get_args(annotation):
            yield from _options(member)
    else:
        yield annotation
