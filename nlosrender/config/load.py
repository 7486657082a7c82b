"""A YAML file -> :class:`Config`, or every mistake in it at once.

A file is read once: into a :class:`~nlosrender.config.yaml_tree.Document`, which is asked for captures, and for the
places of what only the renderer finds wrong.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from nlosrender.config.canonical import tree_hash
from nlosrender.config.document import Config
from nlosrender.config.encodable import encodable
from nlosrender.config.foreign_scenes import advice_to_import
from nlosrender.config.issues import shown
from nlosrender.config.overrides import apply_overrides
from nlosrender.config.section import Section, issues_in
from nlosrender.config.unused_keys import without_unused_keys
from nlosrender.config.yaml_tree import MAX_BYTES, Document, read_document
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

LEFT_OUT = (  # of the canonical JSON, if empty
    ("sensor",),
    ("output", "ground_truth"),
    ("output", "ground_truth_grid"),
    ("capture", "sensor_points"),
    ("capture", "laser_points"),
    ("capture", "pixel_point"),
    ("capture", "laser_target"),
    ("capture", "laser_targets"),
    ("capture", "footprint", "pixel"),
    ("capture", "footprint"),
    ("capture", "laser_spots"),
    ("capture", "laser_spot_weights"),
    ("capture", "multiplex"),
    ("capture", "laser_flash"),
)
MAX_ISSUES = 100  # told at once; nobody reads more
SectionT = TypeVar("SectionT", bound=Section)


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
        With every issue found: the file cannot be read, is no YAML, or breaks a rule.
    """
    return config_of(load_document(path, overrides))


def parse_config(text: str, source: str, folder: Path, overrides: Sequence[str] = ()) -> Config:
    """Validate the text of a config; as ``load_config``, with parameters as ``parse_document``.

    Raises
    ------
    ConfigError
        With every issue found.
    """
    return config_of(parse_document(text, source, folder, overrides))


def load_document(path: Path, overrides: Sequence[str] = ()) -> Document:
    """Return the values of a config file with the overrides put over them; a pipe will do.

    Raises
    ------
    ConfigError
        The file cannot be read, or is no YAML mapping. Other issues are those of the document.
    """
    path = Path(path)
    text, is_pipe = yaml_text(path, f" nlosrender new {path} writes a starter.")
    document = parse_document(text, str(path), Path.cwd() if is_pipe else path.absolute().parent, overrides)
    return dataclasses.replace(document, stem="capture") if is_pipe else document


def yaml_text(path: Path, if_missing: str = "") -> tuple[str, bool]:
    """Return the text of a YAML file, and whether it came through a pipe.

    Raises
    ------
    ConfigError
        The file cannot be read; ``if_missing`` is added where there is none.
    """
    try:
        is_pipe = path.is_fifo()
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        return content.decode("utf-8-sig"), is_pipe
    except UnicodeDecodeError as error:
        message = f"no UTF-8 text: byte 0x{content[error.start]:02x} at offset {error.start}. Save it as UTF-8."
        if len(content) > MAX_BYTES:  # the cut may have split a character; size is the real mistake
            message = f"larger than {MAX_BYTES // 1024} KiB, which no configuration needs."
        raise ConfigError.of_file(str(path), message) from error
    except FileNotFoundError as error:
        raise ConfigError.of_file(str(path), f"there is no such file.{if_missing}") from error
    except IsADirectoryError as error:
        raise ConfigError.of_file(str(path), "this is a folder, need a YAML file.") from error
    except (OSError, ValueError) as error:
        raise ConfigError.of_file(str(path), f"cannot be read: {getattr(error, 'strerror', error)}.") from error


def parse_document(text: str, source: str, folder: Path, overrides: Sequence[str] = ()) -> Document:
    """Return the values of a config's text with the overrides put over them; the root is a mapping.

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
        The text is no YAML or no mapping. Other issues are those of the document.
    """
    if advice := advice_to_import(text, None, source):
        raise ConfigError.of_file(f"{source}:1:1", advice)
    document = read_document(text, source, folder)
    if advice := advice_to_import(text, document.tree, source):
        raise ConfigError.of_file(document.place(()), advice)
    if document.tree is None and not document.issues and overrides:
        document.tree = {}
    if not isinstance(document.tree, dict):
        found = "the file is empty" if document.tree is None else f"got {shown(document.tree)}"
        message = f"{found}, need a mapping with the keys {', '.join(Config.model_fields)}."
        place = document.place(()) if document.tree is not None else source
        raise ConfigError(document.issues or ValidationIssue((), message, place=place))
    apply_overrides(document, overrides)
    return document


def config_of(document: Document) -> Config:
    """Return the config of a document that describes one capture.

    Raises
    ------
    ConfigError
        With every issue found, the document's own included; a sweep is one.
    """
    if document.tree.get("sweep") is None:
        unused = document.tree.get("dataset") is not None
        return capture_config(document).with_notes(["dataset has no effect without a sweep."] * unused)
    message = "this makes many captures, and a single one is needed here; remove it, or --set sweep=null."
    sweep = document.issue(("sweep",), message, "key")
    single = {key: value for key, value in document.tree.items() if key != "sweep"}
    return capture_config(dataclasses.replace(document, tree=single, issues=[*document.issues, sweep]))


def capture_config(document: Document) -> Config:
    """Validate the values of one capture, whatever their document says of sweeps.

    Raises
    ------
    ConfigError
        With every issue found, the document's own included.
    """
    tree, notes = without_unused_keys(document.tree)
    config, found = validated(Config, tree, document)
    if found or document.issues:
        raise ConfigError(in_order(found, document))
    return config.with_notes((*document.notes, *notes))


def validated(
    section: type[SectionT], tree: Any, document: Document, path: KeyPath = ()
) -> tuple[SectionT, list[ValidationIssue]]:
    """Return the section of the values that stand at ``path`` of a document, and every issue found in it.

    With issues the section is good for nothing.
    """
    checked = section.model_validate(tree, context={"folder": document.folder, "stem": document.stem})
    return checked, [*issues_in(checked, path, Config)]


def in_order(found: Sequence[ValidationIssue], document: Document) -> list[ValidationIssue]:
    """Return issues with their places, and those of the document, in the order of the file, overrides last."""
    placed = [
        document.issue(issue.path, encodable(issue.message), issue.at)
        for issue in found
        if not any(_overlap(issue.path, unread) for unread in document.unread)  # told already
    ]
    issues = sorted(dict.fromkeys([*document.issues, *placed]), key=_reading_order)
    if len(issues) > MAX_ISSUES:
        rest = f"{len(issues) - MAX_ISSUES} more mistakes are not listed."
        issues = [*issues[:MAX_ISSUES], ValidationIssue((), rest, place=document.source)]
    return issues


def _overlap(a: KeyPath, b: KeyPath) -> bool:
    return all(x == y for x, y in zip(a, b, strict=False))


def _reading_order(issue: ValidationIssue) -> tuple[int, int]:
    match = re.search(r":(\d+):(\d+)$", issue.place)
    if match is None or issue.place.startswith("--set"):
        return (MAX_BYTES + 1, 0)
    return int(match[1]), int(match[2])


def config_to_dict(config: Config) -> dict[str, Any]:
    """Return the config with every default filled in and file names absolute, as plain JSON values.

    Sections and keys of ``LEFT_OUT`` are there only where they are set: earlier captures keep their hash.
    """
    dumped: dict[str, Any] = json.loads(json.dumps(config.model_dump(mode="json"), allow_nan=False))
    for *sections, key in LEFT_OUT:
        place = dumped
        for section in sections:
            place = place[section] or {}
        if key in place and not place[key]:
            del place[key]
    return dumped


def config_hash(config: Config) -> str:
    """Return the SHA-256 (hex) of the config's canonical JSON: equal for configs that differ only in writing."""
    return tree_hash(config_to_dict(config))
