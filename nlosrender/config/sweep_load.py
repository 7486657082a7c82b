"""A YAML file with a ``sweep`` -> the configs of all its captures, or every mistake in them at once."""

from __future__ import annotations

import copy
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from nlosrender.config.dataset_section import DatasetConfig, split_of
from nlosrender.config.document import Config
from nlosrender.config.draws import COPY, Drawer, Drawn
from nlosrender.config.families import FAMILY_KEYS, PLACES, PLACING, Measure, Member, family_items, placed, with_copies
from nlosrender.config.issues import shown
from nlosrender.config.load import MAX_ISSUES, capture_config, in_order, validated
from nlosrender.config.overrides import put
from nlosrender.config.sweep import SweepConfig
from nlosrender.config.yaml_tree import Document, Place
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

DEFAULT_PATTERN = "{name}/{index:05d}.hdf5"
_SWEEP, _DATASET = "sweep", "dataset"
ALL = -1  # in place of an item: all that is not of a further copy
_PLACEHOLDER = re.compile(r"\{(?:(name)|index(?::(0?\d)d)?)\}")


@dataclass(frozen=True)
class _Setting:
    """One value of one swept key, or a draw of it, and where in the YAML it comes from."""

    key: str
    value: Any  # or, with a seed, what a ``Drawer`` takes
    key_at: KeyPath
    at: KeyPath  # of the value
    seed: int | None = None  # of a draw
    number: int = 0  # of the draw

    def settled(self, drawer: Drawer) -> Any:
        """Return the value; a drawn one is noted by ``drawer``."""
        value = self.value if self.seed is None else drawer.value(self.value, self.key, self.seed, self.number)
        return copy.deepcopy(value)


Settings = tuple[_Setting, ...]


@dataclass(frozen=True, eq=False)
class CaptureFacts:
    """What the index of a dataset says of a capture before it is rendered."""

    values: dict[str, Any]  # by swept key; further copies of an item have #1, #2 after theirs
    files: dict[str, str]  # drawn files by key, as the YAML would name them
    split: str | None  # train, val or test, whatever further captures there are; None: there are no splits
    label: Any  # what it shows: the value of dataset.label, else the folder of its file, or its text


@dataclass(frozen=True, eq=False)
class Sweep:
    """The captures of one file: how many, what differs between them, and the config of each."""

    document: Document  # without the sweep itself
    settings: tuple[Settings, ...]  # of every capture
    paths: tuple[Path, ...]  # output of every capture, all different
    measure: Measure | None = None  # the box around an item, for families that need it
    dataset: DatasetConfig = field(default_factory=DatasetConfig)

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

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The swept keys, as the file has them."""
        return tuple(setting.key for setting in self.settings[0])

    def values(self, index: int) -> dict[str, Any]:
        """Return the values of the swept keys in one capture, places of families as first drawn."""
        return self._drawing(index).values()

    def facts(self, index: int) -> CaptureFacts:
        """Return what is known of a capture, places of families as first drawn: no mesh is read."""
        return self._facts(self._drawing(index))

    def capture(self, index: int) -> tuple[Config, CaptureFacts]:
        """Return the config of one capture, its families placed, and what is known of it.

        Raises
        ------
        ConfigError
            It has mistakes; ``sweep_of`` has looked for those that need no mesh to be read.
        """
        # built when it is needed: a hundred thousand configs fill the memory
        drawing = self._drawing(index)
        drawing.place(self.measure)
        return capture_config(drawing.document), self._facts(drawing)

    def config(self, index: int) -> Config:
        """Return the config of one capture; errors as of ``capture``."""
        return self.capture(index)[0]

    def _facts(self, drawing: _Drawing) -> CaptureFacts:
        values, lead = drawing.values(), drawing.lead
        label = next((value for key, value in values.items() if key.endswith(".text")), None)
        if lead is not None and len(Path(lead[1]).parts) > 1:
            label = Path(lead[1]).parts[-2]
        label = label if self.dataset.label is None else values.get(self.dataset.label)
        split = self.dataset.split
        by_file = split is not None and split.by != "capture" and lead is not None
        name = lead[1] if by_file and lead is not None else drawing.name
        return CaptureFacts(values, drawing.files(), None if split is None else split_of(split, name), label)

    def _drawing(self, index: int) -> _Drawing:
        return _Drawing(self.document, self.settings[index], index, self.dataset)


def sweep_of(document: Document, measure: Measure | None = None) -> Sweep | None:
    """Validate all captures of a document's sweep, but for places that depend on the meshes of a family.

    Parameters
    ----------
    document
        The file.
    measure
        Tells the box around an item, for families with ``no_overlap`` or ``on_floor``.

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
    given = document.tree.get(_DATASET)
    dataset, mistakes = validated(DatasetConfig, {} if given is None else given, document, (_DATASET,))
    if found or mistakes or any(path[0] in (_SWEEP, _DATASET) for path in document.unread):
        raise ConfigError(in_order([*found, *mistakes], document))
    _check_overrides(section, document)
    base = replace(document, tree={key: item for key, item in document.tree.items() if key not in (_SWEEP, _DATASET)})
    sweep = replace(_validated(base, tuple(_settings(section)), dataset), measure=measure, dataset=dataset)
    _check_dataset(sweep)
    return sweep


def _check_dataset(sweep: Sweep) -> None:
    """Refuse splits by files where none are drawn, and a label that is no key of the sweep."""
    split, label, document = sweep.dataset.split, sweep.dataset.label, sweep.document
    if split is not None and split.by != "capture" and sweep._drawing(0).lead is None:
        message = f"got {split.by}, but no file is drawn ({{files: 'folder/*.obj'}}); need capture."
        raise ConfigError(document.issue((_DATASET, "split", "by"), message))
    known = sorted({key for index in range(min(len(sweep), 100)) for key in sweep.values(index)})
    if label is not None and label not in known:
        message = f"got {label}, need one of the swept keys: {', '.join(known[:10])}."
        raise ConfigError(document.issue((_DATASET, "label"), message))


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
                tuple(_Setting(key, draw, (*at, key), (*at, key), seed, number) for key, draw in draws.items())
                for number in range(section.random.count)
            ]
        ]
    combined = itertools.product(*axes) if section.mode == "product" else zip(*axes, strict=True)
    for parts in combined:
        yield tuple(itertools.chain.from_iterable(parts))


def _validated(base: Document, settings: tuple[Settings, ...], dataset: DatasetConfig) -> Sweep:
    """Look at every capture; a mistake that several share is told once, with the first of them."""
    found: dict[ValidationIssue, list[int]] = {}
    paths: dict[Path, int] = {}
    for index, own in enumerate(settings):
        try:
            path = capture_config(_Drawing(base, own, index, dataset).document).output.path
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
    first = ", ".join(f"{setting.key} = {shown(setting.settled(Drawer()))}" for setting in settings[indices[0]])
    count = (
        f"{len(indices)} of {len(settings)} captures, the first one with" if len(indices) > 1 else "The capture with"
    )
    return replace(issue, message=f"{issue.message} ({count} {first}.)")


class _Drawing:
    """The document of one capture: the base with swept and drawn values in place, copies, and an output of its own."""

    def __init__(self, base: Document, settings: Settings, index: int, dataset: DatasetConfig):
        self._base, self._settings, self._split = base, settings, dataset.split
        self._lifted: dict[str, Any] = {}
        first = self._drawer()
        self._drawn: dict[tuple[int, int], list[Drawn]] = {
            (ALL, 0): first.drawn
        }  # by item and copy, redrawn ones later
        self.document = self._filled(first)
        self.lead = first.lead
        self.members: list[Member] = with_copies(self.document, self.redraw) if family_items(self.document.tree) else []
        _set_output(self.document, index)

    def redraw(self, item: int, number: int, attempt: int) -> Any:
        """Return a raw item as its copy ``number`` has it; another ``attempt`` draws only another place."""

        def suffix(key: str) -> str:
            own = _own_key(key, item)
            is_moved = attempt > 0 and own in PLACING
            return "" if own is None else _mark(number) + f"~{attempt}" * is_moved

        drawer = self._drawer(suffix)
        drawer.lead = self.lead
        raw: dict[str, Any] = self._filled(drawer).tree["scene"]["hidden_geometry"][item]
        if number and isinstance(raw, dict) and isinstance(raw.get("name"), str):
            raw["name"] += f"-{number + 1}"  # items have names of their own
        self._drawn[item, number] = [one for one in drawer.drawn if _own_key(one.key, item) is not None]
        return raw

    def place(self, measure: Measure | None) -> None:
        """Place the members of families; ConfigError: a mistake, or there is no place."""
        if not self.members:
            return
        if measure is None:
            raise ValueError("families are placed by a measure of items")
        placed(self.document, self.members, self.redraw, measure, capture_config)
        for member in self.members:
            item = self.document.tree["scene"]["hidden_geometry"][member.at]
            key = next((key for key in PLACES if key in item), None)
            if key is not None and member.floor is not None:
                where = f"scene.hidden_geometry.{member.item}.{key}{_mark(member.copy)}"
                self._lifted[where] = item[key]

    @property
    def name(self) -> str:
        """What the capture is known by, whatever further ones there are: in a product a larger count moves indices."""
        fixed = {setting.key: setting.value for setting in self._settings if setting.seed is None}
        number = next((setting.number for setting in self._settings if setting.seed is not None), 0)
        return json.dumps([number, fixed], sort_keys=True)

    def values(self) -> dict[str, Any]:
        """Return the swept and drawn values by key."""
        found = {setting.key: copy.deepcopy(setting.value) for setting in self._settings if setting.seed is None}
        for (_, number), drawn in self._drawn.items():
            told = (one for one in drawn if one.key.rpartition(".")[2] not in FAMILY_KEYS[number == 0 :])
            found |= {f"{one.key}{_mark(number)}": copy.deepcopy(one.value) for one in told}
        return found | self._lifted

    def files(self) -> dict[str, str]:
        """Return the drawn files by key."""
        each = ((f"{one.key}{_mark(number)}", one) for (_, number), drawn in self._drawn.items() for one in drawn)
        return {key: one.value for key, one in each if one.draw.kind == "files"}

    def _drawer(self, suffix: Callable[[str], str] = lambda key: "") -> Drawer:
        split = self._split
        if split is None or split.by == "capture":
            return Drawer(suffix)
        return Drawer(suffix, goes_with=lambda name, first: split_of(split, name) == split_of(split, first))

    def _filled(self, drawer: Drawer) -> Document:
        document = self._base.copy()
        for setting in self._settings:
            place = Place(document.place(setting.key_at, "key"), document.place(setting.at))
            try:
                put(document, setting.key.split("."), setting.settled(drawer), place)
            except ConfigError as error:
                document.issues += error.issues
        return document


def _mark(number: int) -> str:
    """Return what keys of a further copy of an item end with."""
    return f"{COPY}{number}" if number else ""


def _own_key(key: str, item: int) -> str | None:
    """Return the first key below an item that a dotted key leads to, empty for the item itself; None: another place."""
    start = f"scene.hidden_geometry.{item}"
    return key.removeprefix(start).lstrip(".").partition(".")[0] if f"{key}.".startswith(f"{start}.") else None


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
