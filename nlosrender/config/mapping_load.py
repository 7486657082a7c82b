"""A configuration, or changes to one, as Python values: into the documents and overrides that YAML is read into."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nlosrender.config.foreign_scenes import advice_to_import
from nlosrender.config.issues import Wrong
from nlosrender.config.yaml_tree import MAX_DEPTH, Document, Place
from nlosrender.errors import ConfigError, KeyPath, OptionError, ValidationIssue

SOURCE = "dict"  # what a mapping is called in messages, before the key
Changes = Mapping[str, object]  # values by dotted key, such as {"render.spp": 64}


def mapping_document(values: Mapping[str, object], source: str = SOURCE) -> Document:
    """Return the document of a configuration given as a mapping; relative file names start at the current folder.

    NumPy numbers and arrays become numbers and lists, paths become text. What is no value of a YAML is an issue of
    the document, which names its key.

    Raises
    ------
    ConfigError
        It is a scene of another renderer.
    """
    document = Document(source, Path.cwd(), "capture", places={(): Place(source, source)})
    document.tree = {} if not isinstance(values, Mapping) else _plain(values, (), document)
    if advice := advice_to_import("", document.tree, source):
        raise ConfigError.of_file(source, advice)
    return document


def change_texts(changes: Changes | Iterable[str]) -> tuple[str, ...]:
    """Return changes as ``--set`` takes them; texts pass as they are.

    Raises
    ------
    ConfigError
        A value is none that a YAML holds; its key is named.
    OptionError
        An item is no text.
    """
    if not isinstance(changes, Mapping):
        texts = (changes,) if isinstance(changes, str) or not isinstance(changes, Iterable) else tuple(changes)
        if other := [text for text in texts if not isinstance(text, str)]:
            raise OptionError(f"changes: got {other[0]!r:.60}, need texts KEY=VALUE, or a mapping of keys and values")
        return texts
    document = Document("changes", Path.cwd(), "", places={(): Place("changes", "changes")})
    values = {str(key): _plain(value, tuple(str(key).split(".")), document) for key, value in changes.items()}
    if document.issues:
        raise ConfigError(document.issues)
    return tuple(f"{key}={json.dumps(value)}" for key, value in values.items())  # JSON is YAML; "1e3" stays a text


def _plain(value: object, path: KeyPath, document: Document) -> Any:
    """Return a value as YAML would hold it; what it cannot hold is noted, and ``Wrong`` stands for it."""
    if len(path) > MAX_DEPTH:
        return _unread(f"nested deeper than {MAX_DEPTH} levels.", path, document)
    if isinstance(value, Mapping):
        return _mapping(value, path, document)
    if type(value).__module__ == "numpy":  # told by name: NumPy is not imported for this
        value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        return [_plain(item, (*path, index), document) for index, item in enumerate(value)]
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, float) and not math.isfinite(value):
        return _unread(f"got {value}, need a finite number.", path, document)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return _unread(f"got {type(value).__name__}, need numbers, text, lists and mappings.", path, document)


def _mapping(values: Mapping[Any, object], path: KeyPath, document: Document) -> dict[str, Any]:
    plain = {}
    for key, value in values.items():
        if isinstance(key, str):
            plain[key] = _plain(value, (*path, key), document)
        else:
            document.issues.append(document.issue(path, f"got {key!r} as a key, need text.", "key"))
    return plain


def _unread(message: str, path: KeyPath, document: Document) -> Wrong:
    document.unread.add(path)
    document.issues.append(ValidationIssue(path, message, place=document.source))
    return Wrong()
