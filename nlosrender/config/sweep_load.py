"""A YAML file with a ``sweep`` -> the configs of all its captures, or every mistake in them at once."""

from __future__ import annotations

import copy
import itertools
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nlosrender.config.document import Config
from nlosrender.config.issues import shown
from nlosrender.config.load import MAX_ISSUES, capture_config, in_order, validated
from nlosrender.config.overrides import put
from nlosrender.config.sweep import SweepConfig
from nlosrender.config.yaml_tree import Document, Place
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

DEFAULT_PATTERN = "{name}/{index:05d}.hdf5"
_SWEEP = "sweep"
_PLACEHOLDER = re.compile(r"\{(?:(name)|index(?::(0?\d)d)?)\}")


@dataclass(frozen=True)
class _Setting:
    """One value of one swept key, and where in the YAML it comes from."""

    key: str
    value: Any
    key_at: KeyPath
    at: KeyPath  # of the value


@dataclass(frozen=True, eq=False)
class Sweep:
    """The captures of one file: how many, what differs between them, and the config of each."""

    document: Document  # without the sweep itself
    settings: tuple[tuple[_Setting, ...], ...]  # of every capture
    paths: tuple[Path, ...]  # output of every capture, all different

    def __len__(self) -> int:
        """Return the number of captures."""
        return len(self.settings)

    @property
    def source(self) -> str:
        """What the configuration is called in messages."""
        return self.document.source

    @property
    def output_folder(self) -> Path:
        """The folder that all captures are below."""
        return Path(os.path.commonpath([path.absolute().parent for path in self.paths]))

    def values(self, index: int) -> dict[str, Any]:
        """Return the values of the swept keys in one capture."""
        return {setting.key: setting.value for setting in self.settings[index]}

    def config(self, index: int) -> Config:
        """Return the config of one capture.

        Raises
        ------
        ConfigError
            It has mistakes; ``sweep_of`` has looked for them.
        """
        # built when it is needed: a hundred thousand configs fill the memory
        return capture_config(_capture_document(self.document, self.settings[index], index))


def sweep_of(document: Document) -> Sweep | None:
    """Validate all captures of a document's sweep.

    Returns
    -------
    Sweep
        Or None when the document has no sweep: ``config_of`` is for those.

    Raises
    ------
    ConfigError
        With every issue found.
    """
    if document.tree.get(_SWEEP) is None:
        return None
    section, found = validated(SweepConfig, document.tree[_SWEEP], document, (_SWEEP,))
    if found or any(path[0] == _SWEEP for path in document.unread):
        raise ConfigError(in_order(found, document))
    _check_overrides(section, document)
    base = replace(document, tree={key: value for key, value in document.tree.items() if key != _SWEEP})
    return _validated(base, tuple(_settings(section)))


def _check_overrides(section: SweepConfig, document: Document) -> None:
    """Refuse ``--set`` of a key that the sweep sets: one of the two would be lost without a word."""
    swept = {*section.keys, *(section.random.keys if section.random else ())}
    message = "is swept; take it out of sweep, or leave --set away."
    keys = [(override, override.partition("=")[0].strip()) for override in document.overrides]
    issues = [ValidationIssue((key,), message, place=f"--set {override}") for override, key in keys if key in swept]
    if issues:
        raise ConfigError(issues)


def _settings(section: SweepConfig) -> Iterator[tuple[_Setting, ...]]:
    """Yield the settings of every capture; in a product the last key changes fastest, the draws faster still."""
    axes: list[list[tuple[_Setting, ...]]] = []
    for key, values in section.keys.items():
        at: KeyPath = (_SWEEP, "keys", key)
        axes.append([(_Setting(key, value, at, (*at, number)),) for number, value in enumerate(values)])
    if section.random is not None:
        at, seed, draws = (_SWEEP, "random", "keys"), section.random.seed, section.random.keys
        axes += [
            [
                tuple(
                    _Setting(key, draw.value(key, seed, number), (*at, key), (*at, key)) for key, draw in draws.items()
                )
                for number in range(section.random.count)
            ]
        ]
    combined = itertools.product(*axes) if section.mode == "product" else zip(*axes, strict=True)
    for parts in combined:
        yield tuple(itertools.chain.from_iterable(parts))


def _validated(base: Document, settings: tuple[tuple[_Setting, ...], ...]) -> Sweep:
    """Look at every capture; a mistake that several share is told once, with the first of them."""
    found: dict[ValidationIssue, list[int]] = {}
    paths: dict[Path, int] = {}
    for index, own in enumerate(settings):
        try:
            path = capture_config(_capture_document(base, own, index)).output.path
        except ConfigError as error:
            for issue in error.issues:
                found.setdefault(issue, []).append(index)
            if len(found) >= MAX_ISSUES:
                break
            continue
        first = paths.setdefault(path, index)
        if first != index:
            message = f"captures {first} and {index} are both {path}; need {{index}} in it, as in {DEFAULT_PATTERN}."
            raise ConfigError(base.issue(("output", "path"), message))
    if found:
        raise ConfigError([_counted(issue, indices, settings) for issue, indices in found.items()])
    return Sweep(base, settings, tuple(paths))


def _counted(issue: ValidationIssue, indices: list[int], settings: tuple[tuple[_Setting, ...], ...]) -> ValidationIssue:
    """Say which captures have a mistake that not all of them have."""
    if len(indices) == len(settings):
        return issue
    first = ", ".join(f"{setting.key} = {shown(setting.value)}" for setting in settings[indices[0]])
    count = (
        f"{len(indices)} of {len(settings)} captures, the first one with" if len(indices) > 1 else "The capture with"
    )
    return replace(issue, message=f"{issue.message} ({count} {first}.)")


def _capture_document(base: Document, settings: tuple[_Setting, ...], index: int) -> Document:
    """Return the document of one capture: the base with the swept values in place and an output of its own."""
    document = base.copy()
    for setting in settings:
        place = Place(base.place(setting.key_at, "key"), base.place(setting.at))
        try:
            put(document, setting.key.split("."), copy.deepcopy(setting.value), place)
        except ConfigError as error:
            document.issues += error.issues
    _set_output(document, index)
    return document


def _set_output(document: Document, index: int) -> None:
    """Fill in the pattern of the output's name; what is no text is left to the validation."""
    name = document.tree.get("name", document.stem)
    output = document.tree.setdefault("output", {})
    pattern = output.get("path", DEFAULT_PATTERN) if isinstance(output, dict) else None
    if not isinstance(pattern, str) or not isinstance(name, str):
        return
    output["path"] = _PLACEHOLDER.sub(lambda match: name if match[1] else f"{index:{match[2] or ''}d}", pattern)
    if "{" in output["path"] or "}" in output["path"]:
        message = f"got {shown(pattern)}; in a sweep only {{index}}, {{index:05d}} and {{name}} may stand in braces."
        document.issues.append(document.issue(("output", "path"), message))
