"""A YAML file -> :class:`Config`, or every mistake in it at once."""

from __future__ import annotations

import copy
import itertools
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from nlosrender.config.canonical import tree_hash
from nlosrender.config.document import Config
from nlosrender.config.overrides import apply_overrides
from nlosrender.config.refusal import FAULT, shown
from nlosrender.config.translate import locate, problem_from
from nlosrender.config.yaml_tree import MAX_BYTES, Document, read_document
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

# What stands in for a required section that is wrong, so that the rules between the others still run.
_STAND_INS: dict[KeyPath, Any] = {
    ("scene", "relay_wall"): {"type": "rectangle", "width": 1.0, "height": 1.0},
    ("capture", "scan_type"): "single",
    ("capture", "sensor_grid"): {"nx": 1, "ny": 1},
    ("capture", "laser_grid"): {"nx": 1, "ny": 1},
}
MOST_PROBLEMS = 100  # told at once; finding the nearest known key for each takes a while
_MAX_PASSES = 20  # each one removes something from the tree; a tree of this schema is used up long before


def load_config(path: Path, overrides: Sequence[str] = ()) -> Config:
    """Read, override, validate and freeze a config file.

    Parameters
    ----------
    path
        The YAML file; relative file names in it start at its folder.
    overrides
        ``a.b.c=VALUE`` each, as given to ``--set``.

    Raises
    ------
    ConfigError
        With every problem found: the file cannot be read, is no YAML, or breaks a rule.
    """
    path = Path(path)
    return parse_config(read_text(path), str(path), path.absolute().parent, overrides)


def read_text(path: Path) -> str:
    """Return the text of a config file.

    Raises
    ------
    ConfigError
        It cannot be read, is no text or far too long.
    """
    try:
        if path.is_fifo():  # a look for a sweep comes before the capture, and one for places after it
            message = "is a pipe, and a config is read more than once. Save it as a file."
            raise ConfigError.of_file(str(path), message)
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        message = f"no UTF-8 text: byte 0x{content[error.start]:02x} at offset {error.start}. Save it as UTF-8."
        if len(content) > MAX_BYTES:  # the cut may have split a character; size is the real mistake
            message = f"larger than {MAX_BYTES // 1024} KiB, which no configuration needs."
        raise ConfigError.of_file(str(path), message) from error
    except FileNotFoundError as error:
        message = f"there is no such file. nlosrender new {path} writes a starter."
        raise ConfigError.of_file(str(path), message) from error
    except IsADirectoryError as error:
        raise ConfigError.of_file(str(path), "this is a folder, need a YAML file.") from error
    except (OSError, ValueError) as error:
        raise ConfigError.of_file(str(path), f"cannot be read: {getattr(error, 'strerror', error)}.") from error


def parse_config(text: str, source: str, folder: Path, overrides: Sequence[str] = ()) -> Config:
    """Validate the text of a config.

    Parameters
    ----------
    text
        YAML.
    source
        What to call it in messages; its stem is the default name of the capture.
    folder
        Where relative file names start.
    overrides
        ``a.b.c=VALUE`` each.

    Raises
    ------
    ConfigError
        With every problem found.
    """
    document = overridden_document(text, source, overrides)
    if document.tree.get("sweep") is not None:
        message = "this makes many captures, and a single one is needed here; remove it, or --set sweep=null."
        document.problems.append(ValidationIssue(("sweep",), message, place=document.place(("sweep",), "key")))
        document.tree = {key: value for key, value in document.tree.items() if key != "sweep"}
    return validate_document(document, folder)


def overridden_document(text: str, source: str, overrides: Sequence[str] = ()) -> Document:
    """Return the values of a config's text with the overrides put over them; the root is a mapping.

    Raises
    ------
    ConfigError
        The text is no YAML or no mapping. Other problems are those of the document.
    """
    document = read_document(text, source)
    if document.tree is None and not document.problems and overrides:
        document.tree = {}
    if not isinstance(document.tree, dict):
        found = "the file is empty" if document.tree is None else f"got {shown(document.tree)}"
        message = f"{found}, need a mapping with the keys {', '.join(Config.model_fields)}."
        place = document.place(()) if document.tree is not None else source
        raise ConfigError(document.problems or ValidationIssue((), message, place=place))
    apply_overrides(document, overrides)
    return document


def validate_document(document: Document, folder: Path) -> Config:
    """Validate the values of one capture; relative file names in them start at ``folder``.

    Raises
    ------
    ConfigError
        With every problem found, the document's own included.
    """
    return _validate(document, {"folder": Path(folder).absolute(), "stem": default_name(document.source)})


def default_name(source: str) -> str:
    """Return the name of a capture whose config gives none: that of its file, which may hold what a name may not."""
    letters = (letter if letter.isprintable() and letter != "\\" else "-" for letter in Path(source).stem)
    return "".join(letters).strip() or "capture"


def config_to_dict(config: Config) -> dict[str, Any]:
    """Return the config with every default filled in and file names absolute, as plain JSON values."""
    dumped: dict[str, Any] = json.loads(json.dumps(config.model_dump(mode="json"), allow_nan=False))
    return dumped


def config_hash(config: Config) -> str:
    """Return the SHA-256 (hex) of the config's canonical JSON: equal for configs that differ only in writing."""
    return tree_hash(config_to_dict(config))


def _validate(document: Document, context: dict[str, Any]) -> Config:
    """Validate; after mistakes, take them out and look again, so that rules over sound values still speak up."""
    problems = list(document.problems)
    broken, n_untold = set(document.unread), 0
    tree = copy.deepcopy(document.tree)
    for _ in range(_MAX_PASSES):
        try:
            config = Config.model_validate(tree, context=context)
        except ValidationError as error:
            details = error.errors(include_url=False)
        else:
            if problems:
                break
            return config.noting(document.notes)
        fresh = [detail for detail in details if not _is_echo(detail, broken)]
        problems += [problem_from(detail, document) for detail in fresh[:MOST_PROBLEMS]]
        n_untold += len(fresh[MOST_PROBLEMS:])
        culprits = {_culprit(detail, broken) for detail in details}
        if not sum(_take_out(tree, culprit, broken) for culprit in sorted(culprits, key=str)):
            break
    told = sorted(dict.fromkeys(problems), key=_reading_order)
    if n_untold or len(told) > MOST_PROBLEMS:
        n_untold += len(told[MOST_PROBLEMS:])
        told = [
            *told[:MOST_PROBLEMS],
            ValidationIssue((), f"{n_untold} more mistakes are not listed.", place=document.source),
        ]
    raise ConfigError(told)


def _reading_order(problem: ValidationIssue) -> tuple[int, int]:
    """Sort key: from the top of the file down, overrides last."""
    match = re.search(r":(\d+):(\d+)$", problem.place)
    if match is None or problem.place.startswith("--set"):
        return (MAX_BYTES + 1, 0)
    return int(match[1]), int(match[2])


def _is_echo(detail: ErrorDetails, broken: set[KeyPath]) -> bool:
    """Tell an error that only follows from something wrong already reported and taken out."""
    path, _ = locate(detail["loc"])
    context = detail.get("ctx", {})
    if detail["type"] == FAULT and context["needs"]:
        section = path[: len(path) - context["depth"]]
        return any(_overlap((*section, *need), gone) for need in context["needs"] for gone in broken)
    return any(_overlap(path, gone) for gone in broken)


def _overlap(a: KeyPath, b: KeyPath) -> bool:
    return all(x == y for x, y in zip(a, b, strict=False))


def _culprit(detail: ErrorDetails, broken: set[KeyPath]) -> KeyPath:
    """Return what to take out of the tree so that validation gets past this error."""
    path, _ = locate(detail["loc"])
    if path in _STAND_INS:
        return path
    return path[:-1] if detail["type"] == "missing" or path in broken else path


def _take_out(tree: Any, path: KeyPath, broken: set[KeyPath]) -> bool:
    """Put the stand-in at ``path``, or delete it where there is none or it did not do; tell whether the tree changed.

    A whole list goes instead of one item, because the other items are told by their index.
    """
    container, done = tree, ()  # type: tuple[Any, KeyPath]
    for step, following in itertools.zip_longest(path, path[1:]):
        here = (*done, step)
        if not isinstance(container, dict):
            return False
        if here == path and path in _STAND_INS and path not in broken:
            container[step] = copy.deepcopy(_STAND_INS[path])
            broken.add(path)
            return True
        if step not in container:
            return False
        if here == path or isinstance(following, int):
            del container[step]
            broken.add(here)
            return True
        container, done = container[step], here
    return False
