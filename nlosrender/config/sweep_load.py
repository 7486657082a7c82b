"""A YAML file with a ``sweep`` -> the configs of all its captures, or every mistake in them at once."""

from __future__ import annotations

import copy
import itertools
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from nlosrender.config.document import Config
from nlosrender.config.load import MOST_PROBLEMS, default_name, overridden_document, read_text, validate_document
from nlosrender.config.overrides import put
from nlosrender.config.refusal import shown
from nlosrender.config.sweep import SweepConfig
from nlosrender.config.translate import problem_from
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
    folder: Path  # where relative file names in it start
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
            It has mistakes; ``load_sweep`` has looked for them.
        """
        # built when it is needed: a hundred thousand configs fill the memory
        return validate_document(_capture_document(self.document, self.settings[index], index), self.folder)


def load_sweep(path: Path, overrides: Sequence[str] = ()) -> Sweep | None:
    """Read a config file and validate all captures of its sweep.

    Parameters
    ----------
    path
        The YAML file.
    overrides
        ``a.b.c=VALUE`` each, as given to ``--set``; they hold for all captures.

    Returns
    -------
    Sweep
        Or None when the file has no sweep: ``load_config`` is for those.

    Raises
    ------
    ConfigError
        With every problem found.
    """
    path = Path(path)
    return parse_sweep(read_text(path), str(path), path.absolute().parent, overrides)


def parse_sweep(text: str, source: str, folder: Path, overrides: Sequence[str] = ()) -> Sweep | None:
    """Validate the text of a config with a sweep; as ``load_sweep``.

    Raises
    ------
    ConfigError
        With every problem found.
    """
    document = overridden_document(text, source, overrides)
    if document.tree.get(_SWEEP) is None:
        return None
    section = _section(document)
    _refuse_swept_overrides(section, overrides)
    settings = tuple(_settings(section))
    base = replace(document, tree={key: value for key, value in document.tree.items() if key != _SWEEP})
    return _validated(base, folder, settings)


def _section(document: Document) -> SweepConfig:
    """Validate the sweep itself."""
    raw = document.tree[_SWEEP]
    try:
        return SweepConfig.model_validate(raw)
    except ValidationError as error:
        details = error.errors(include_url=False)
    problems = [problem_from({**detail, "loc": (_SWEEP, *detail["loc"])}, document) for detail in details]
    raise ConfigError([*document.problems, *problems])


def _refuse_swept_overrides(section: SweepConfig, overrides: Sequence[str]) -> None:
    """Refuse ``--set`` of a key that the sweep sets: one of the two would be lost without a word."""
    swept = {*section.keys, *(section.random.keys if section.random else ())}
    message = "is swept; take it out of sweep, or leave --set away."
    problems = [
        ValidationIssue((key,), message, place=f"--set {override}")
        for override in overrides
        if (key := override.partition("=")[0].strip()) in swept
    ]
    if problems:
        raise ConfigError(problems)


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


def _validated(base: Document, folder: Path, settings: tuple[tuple[_Setting, ...], ...]) -> Sweep:
    """Look at every capture; a mistake that several share is told once, with the first of them."""
    found: dict[ValidationIssue, list[int]] = {}
    paths: dict[Path, int] = {}
    for index, own in enumerate(settings):
        try:
            config = validate_document(_capture_document(base, own, index), folder)
        except ConfigError as error:
            for problem in error.issues:
                found.setdefault(problem, []).append(index)
        else:
            path = config.output.path
            if path in paths:
                place = base.place(("output", "path"))
                message = f"captures {paths[path]} and {index} are both {path}; need {{index}} in it, as in "
                message += f"{DEFAULT_PATTERN}."
                raise ConfigError(ValidationIssue(("output", "path"), message, place=place))
            paths[path] = index
        if len(found) >= MOST_PROBLEMS:
            break
    if found:
        raise ConfigError([_told(problem, indices, settings) for problem, indices in found.items()])
    return Sweep(base, folder, settings, tuple(paths))


def _told(problem: ValidationIssue, indices: list[int], settings: tuple[tuple[_Setting, ...], ...]) -> ValidationIssue:
    """Say which captures have a mistake that not all of them have."""
    if len(indices) == len(settings):
        return problem
    first = ", ".join(f"{setting.key} = {shown(setting.value)}" for setting in settings[indices[0]])
    count = (
        f"{len(indices)} of {len(settings)} captures, the first one with" if len(indices) > 1 else "The capture with"
    )
    return replace(problem, message=f"{problem.message} ({count} {first}.)")


def _capture_document(base: Document, settings: tuple[_Setting, ...], index: int) -> Document:
    """Return the document of one capture: the base with the swept values in place and an output of its own."""
    document = Document(
        base.source,
        copy.deepcopy(base.tree),
        dict(base.places),
        list(base.problems),
        list(base.notes),
        set(base.unread),
    )
    for setting in settings:
        place = Place(base.place(setting.key_at, "key"), base.place(setting.at))
        try:
            put(document, setting.key.split("."), copy.deepcopy(setting.value), place)
        except ConfigError as error:
            document.problems += error.issues
    _set_output(document, index)
    return document


def _set_output(document: Document, index: int) -> None:
    """Fill in the pattern of the output's name; what is no text is left to the validation."""
    name = document.tree.get("name", default_name(document.source))
    output = document.tree.setdefault("output", {})
    if not isinstance(output, dict) or not isinstance(name, str):
        return
    pattern = output.get("path", DEFAULT_PATTERN)
    if not isinstance(pattern, str):
        return
    filled = _filled(pattern, {"name": name}, index)
    if "{" in filled or "}" in filled:
        message = f"got {shown(pattern)}; in a sweep only {{index}}, {{index:05d}} and {{name}} may stand in braces."
        document.problems.append(ValidationIssue(("output", "path"), message, place=document.place(("output", "path"))))
    output["path"] = filled


def _filled(pattern: str, names: Mapping[str, str], index: int) -> str:
    def fill(match: re.Match[str]) -> str:
        return names["name"] if match[1] else f"{index:{match[2] or ''}d}"

    return _PLACEHOLDER.sub(fill, pattern)
