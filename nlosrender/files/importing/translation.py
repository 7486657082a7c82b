"""What an imported file becomes: the values of a configuration, and a verdict on every key of the file."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from nlosrender.config.issues import shown
from nlosrender.errors import KeyPath, ValidationIssue, did_you_mean

Verdict = Literal["taken", "changed", "dropped", "refused", "note"]
_DIGITS = 12  # of what a float64 matrix product gives: -0.5, not -0.49999999999999994
MAX_POINTS = 1_000_000  # of a list that is written out
_SHOWN = 60  # characters of a value in the report
_INTEGER = re.compile(r"[-+]?\d[\d_]*")
_YAML_11 = {"yes": True, "on": True, "no": False, "off": False}
_NEEDS: Mapping[type, str] = {bool: "true or false", float: "a finite number", int: "an integer", str: "text"}


@dataclass(frozen=True)
class KeyLine:
    """One key of an imported file, and what became of it."""

    place: str  # z.xml:12; "default" for a key that the file leaves out
    key: str
    value: str
    verdict: Verdict
    remark: str  # the key here, or the reason


@dataclass(frozen=True)
class Found:
    """A value of an imported file."""

    value: Any
    place: str


@dataclass
class Translation:
    """The configuration that an imported file becomes.

    Parameters
    ----------
    source
        The imported file, as it is called in messages.
    folder
        Where relative file names of the configuration start.
    """

    source: Path
    folder: Path
    config: dict[str, Any] = field(default_factory=dict)
    lines: list[KeyLine] = field(default_factory=list)
    issues: list[ValidationIssue] = field(default_factory=list)
    remarks: dict[str, str] = field(default_factory=dict)  # comments behind keys of the configuration
    _origins: dict[KeyPath, str] = field(default_factory=dict)

    @property
    def start(self) -> str:
        """Where the file begins: the place of what it leaves out."""
        return f"{self.source}:1"

    def put(self, to: str, value: Any, place: str) -> None:
        """Set a dotted key of the configuration, whose value comes from ``place``."""
        *parents, last = to.split(".")
        section = self.config
        for key in parents:
            section = section.setdefault(key, {})
        section[last] = value
        self._origins[(*parents, last)] = place

    def add_item(self, name: str, shape: Mapping[str, Any], bsdf: Mapping[str, Any], place: str) -> None:
        """Add a hidden item that begins at ``place``; a name that is taken, or cannot be one, is left out."""
        items = self.config.setdefault("scene", {}).setdefault("hidden_geometry", [])
        is_name = name and not set(name) & set("/\\") and name not in {item.get("name") for item in items}
        named = {"name": name} if is_name else {}
        shape = {key: value for key, value in shape.items() if key != "to_world" or value}
        items.append({**named, "type": "mitsuba", "shape": shape, "bsdf": dict(bsdf)})
        self._origins["scene", "hidden_geometry", len(items) - 1] = place

    def put_laser(self, point: tuple[float, float]) -> None:
        """Set the laser point to that of --laser."""
        self.line("--laser", "", list(point), "taken", "capture.laser_point")
        self.put("capture.laser_point", list(point), "--laser")

    def line(self, place: str, key: str, value: Any, verdict: Verdict, remark: str) -> None:
        """Report on a key."""
        text = plain(value)
        shown_value = text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
        self.lines.append(KeyLine(place, key, shown_value, verdict, remark))

    def note(self, text: str) -> None:
        """Report what holds for the file as a whole."""
        self.lines.append(KeyLine(str(self.source), "", "", "note", text))

    def refuse(self, place: str, key: str, value: Any, why: str) -> None:
        """Report on a key that has no counterpart, without which the capture would be another one."""
        self.line(place, key, value, "refused", why)
        message = why if why.endswith("?") else f"{why}."
        self.issues.append(ValidationIssue((key,) if key else (), message, place=place))

    def placed(self, issue: ValidationIssue) -> ValidationIssue:
        """Return a mistake in the configuration with the place in the imported file that it comes from."""
        ends = (issue.path[:end] for end in range(len(issue.path), 0, -1))
        place = next((self._origins[path] for path in ends if path in self._origins), self.start)
        return ValidationIssue(issue.path, issue.message, issue.at, place)

    def file_name(self, file: Path, *, is_absolute: bool) -> str:
        """Return how the configuration names a file: as the imported one does, from the configuration's folder."""
        return str(file) if is_absolute else Path(os.path.relpath(file, self.folder.resolve())).as_posix()


class Keys:
    """Keys of an imported file, each to be judged once; those left over are unknown and refused.

    Parameters
    ----------
    translation
        Where the verdicts go.
    found
        The values, by their names in the file.
    names
        The name in the file of keys that are called otherwise here.
    prefix
        Where they stand, before each name in the report.
    place
        What is told of keys that are left out; default: where the file begins.
    """

    def __init__(
        self,
        translation: Translation,
        found: Mapping[str, Found],
        names: Mapping[str, str] | None = None,
        prefix: str = "",
        place: str = "",
    ):
        self.translation, self.found, self.prefix = translation, found, prefix
        self._place = place or translation.start
        self._names = names or {}
        self._judged: set[str] = set()
        self._known: set[str] = set()  # judged, or asked for

    def __contains__(self, name: str) -> bool:
        return self.name(name) in self.found

    def name(self, name: str) -> str:
        """Return what the file calls a key."""
        return self._names.get(name, name)

    def value(self, name: str, default: Any, kind: type | None = None) -> Any:
        """Return the value of a key; where it is not of its kind, it is refused, and the default returned."""
        self._known.add(self.name(name))
        if name not in self:
            return default
        value = self.found[self.name(name)].value
        if value is None:  # of YAML: as if it were left out
            return default
        if kind is not None and not _is(kind, value):
            self.refuse(name, f"got {shown(value)}, need {_NEEDS[kind]}")
            return default
        return value

    def place(self, name: str) -> str:
        """Return where a key stands, or should."""
        return self.found[self.name(name)].place if name in self else self._place

    def take(self, name: str, to: str, value: Any, remark: str = "", *, changed: bool = False) -> None:
        """Set a key of the configuration; ``value`` is what the file says or, where it is silent, means."""
        if self._judge(name):
            where = f"{to}: {plain(value)}" + (f" ({remark})" if remark else "")
            self._line(name, value, "changed" if changed else "taken", where)
            self.translation.put(to, value, self.place(name))

    def keep(self, name: str, remark: str) -> None:
        """Report on a key that is part of something else here."""
        if self._judge(name) and name in self:
            self._line(name, None, "taken", remark)

    def change(self, name: str, remark: str) -> None:
        """Report on a key whose meaning is put otherwise here."""
        if self._judge(name) and name in self:
            self._line(name, None, "changed", remark)

    def enter(self, name: str, kind: type, need: str) -> Any:
        """Return a list or mapping, whose own keys are judged one by one; refuse what is none, and return None."""
        value = self.value(name, None)
        if isinstance(value, kind):
            self._judge(name)
            return value
        self.refuse(name, f"got {shown(value)}, need {need}")
        return None

    def drop(self, name: str, why: str) -> None:
        """Report on a key that has no counterpart, and needs none; nothing where the file is silent."""
        if self._judge(name) and name in self:
            self._line(name, None, "dropped", why)

    def refuse(self, name: str, why: str) -> None:
        """Report on a key without which the capture would be another one."""
        if self._judge(name):
            value = self.found[self.name(name)].value if name in self else None
            self.translation.refuse(self.place(name), self.prefix + self.name(name), value, why)

    def drop_all(self, reasons: Mapping[str, str]) -> None:
        """Drop several keys."""
        for name, why in reasons.items():
            self.drop(name, why)

    def finish(self) -> None:
        """Refuse the keys that nobody has judged."""
        alike = (self._judged | self._known) - {*self.found}
        for name in self.found:
            if name not in self._judged:
                part, _, last = name.rpartition(".")
                parts = (item.rpartition(".") for item in alike)
                hint = did_you_mean(last, [other for of, _, other in parts if of == part])
                self.refuse(name, "unknown here; remove it if it does not matter" + (f". {hint}" if hint else ""))

    def _judge(self, name: str) -> bool:
        """Return whether a key has no verdict yet; from now on it has one."""
        is_new = self.name(name) not in self._judged
        self._judged.add(self.name(name))
        return is_new

    def _line(self, name: str, value: Any, verdict: Verdict, remark: str) -> None:
        place = self.place(name) if name in self else "default"
        said = self.found[self.name(name)].value if name in self else value
        self.translation.line(place, self.prefix + self.name(name), said, verdict, remark)


def plain(value: Any) -> str:
    """Return a value on one line, as YAML has it."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {plain(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(plain, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "null"
    return f"{value:.6g}" if isinstance(value, float) else " ".join(str(value).split())


def rounded(values: Any) -> Any:
    """Return numbers of a computed array, nested as it is, without the noise of their last digits."""
    if getattr(values, "ndim", 0):
        return [rounded(value) for value in values]
    return float(f"{float(values):.{_DIGITS}g}") + 0.0 if abs(float(values)) > 10.0**-_DIGITS else 0.0


def _is(kind: type, value: Any) -> bool:
    if isinstance(value, bool) or kind is bool:
        return isinstance(value, bool) and kind is bool
    if kind is float:
        return isinstance(value, (int, float)) and math.isfinite(value)
    return isinstance(value, kind)


def as_yaml_11(value: Any) -> Any:
    """Return a scalar as YAML 1.1 reads it: 1_000_000 is a number, yes is true."""
    if isinstance(value, str) and _INTEGER.fullmatch(value):
        return int(value.replace("_", ""))
    return _YAML_11.get(value.lower(), value) if isinstance(value, str) else value
