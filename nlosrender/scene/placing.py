"""Impossible poses and sizes, told with the item they belong to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from nlosrender.errors import ConfigError


@contextmanager
def placed() -> Iterator[None]:
    """Name the item whose pose or size is impossible.

    Raises
    ------
    ConfigError
        A ValueError that begins with an item's key left the block.
    """
    try:
        yield
    except ValueError as error:
        key, _, message = str(error).partition(": ")
        raise ConfigError.at(key, message) from error
