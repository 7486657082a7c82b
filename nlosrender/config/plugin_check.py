"""What BSDF, texture and shape dictionaries share: file names, transforms, a list of issues found on the way down."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo

from nlosrender.config.encodable import is_encodable
from nlosrender.config.fields import MAX_LENGTH, Checked, as_finite, finite_numbers
from nlosrender.config.frozen import freeze
from nlosrender.config.issues import InvalidValue, mismatch, shown
from nlosrender.config.vectors import cross, dot
from nlosrender.errors import KeyPath, ValidationIssue, did_you_mean, nearest

TRANSFORM_KEYS = ("to_world", "to_uv")
_OPERATIONS = "translate: [x, y, z], rotate: {axis: [x, y, z], angle_deg: a}, scale: s or [x, y, z]"


@dataclass
class PluginCheck:
    """One walk down a plugin dictionary; collects every issue instead of stopping at the first.

    Parameters
    ----------
    folder
        Where relative file names start.
    """

    folder: Path
    issues: list[ValidationIssue] = field(default_factory=list)

    def note(self, path: KeyPath, message: str, *, at_key: bool = False) -> None:
        """Note one mistake at ``path`` below the dictionary."""
        self.issues.append(ValidationIssue(path, message, "key" if at_key else "value"))

    def note_mismatch(self, path: KeyPath, value: object, need: str, advice: str = "") -> None:
        """Note that ``value`` at ``path`` is not what is needed."""
        self.note(path, mismatch(value, need, advice))

    def plugin_type(self, value: object, path: KeyPath, allowed: Sequence[str], what: str) -> str | None:
        """Return the plugin's type; None after noting why there is none."""
        if not isinstance(value, Mapping):
            self.note_mismatch(path, value, f"a mapping with a type, such as {{type: {allowed[0]}}}")
            return None
        name = value.get("type")
        if "type" not in value:
            self.note((*path, "type"), f"missing, need the {what}: one of {', '.join(allowed)}.")
        elif name not in allowed:
            self.note_mismatch((*path, "type"), name, f"one of {', '.join(allowed)}", did_you_mean(str(name), allowed))
        else:
            return str(name)
        return None

    def generic(self, value: Any, path: KeyPath) -> Any:
        """Return a parameter of an unknown kind, with its file names absolute and its transforms checked."""
        key = path[-1] if path else ""
        if key == "filename":
            return self.file(value, path)
        if key in TRANSFORM_KEYS:
            return self.transform(value, path)
        if isinstance(value, Mapping):
            return {name: self.generic(item, (*path, name)) for name, item in value.items()}
        if value is None:
            self.note_mismatch(path, value, "a value")
        return value

    def numbers(self, value: Any, path: KeyPath, size: int, need: str) -> Any:
        """Return a list of ``size`` finite numbers as floats."""
        found = finite_numbers(value, size)
        if found is None or any(abs(number) > MAX_LENGTH for number in found):
            self.note_mismatch(path, value, need)
        return found

    def file(self, value: object, path: KeyPath) -> str:
        """Return the absolute name of an existing file."""
        if not isinstance(value, str) or not value.strip():
            self.note_mismatch(path, value, "the name of a file")
            return ""
        absolute, problem = mitsuba_file(value, self.folder)
        if problem:
            self.note(path, problem)
        return str(absolute)

    def transform(self, value: Any, path: KeyPath) -> Any:
        """Return a checked transform: a 4x4 matrix, or operations applied in order, the first listed first."""
        items = value if isinstance(value, (list, tuple)) else None
        if items and all(isinstance(item, Mapping) for item in items):
            return [self._operation(item, (*path, index)) for index, item in enumerate(items)]
        rows = [finite_numbers(row, 4) for row in items] if items is not None else []
        if len(rows) != 4 or any(row is None for row in rows):
            self.note_mismatch(path, value, f"4 rows of 4 finite numbers, or a list of {_OPERATIONS}")
            return value
        matrix = [row for row in rows if row is not None]
        if matrix[3] != [0, 0, 0, 1]:
            self.note_mismatch((*path, 3), value[3], "[0, 0, 0, 1] as last row")
        elif abs(dot(cross(matrix[0][:3], matrix[1][:3]), matrix[2][:3])) < 1e-30:
            self.note(path, "the matrix is singular: it flattens space, need one that can be inverted.")
        return matrix

    def _operation(self, item: Mapping[str, Any], path: KeyPath) -> dict[str, Any]:
        if len(item) != 1 or next(iter(item)) not in ("translate", "rotate", "scale"):
            self.note_mismatch(path, item, f"exactly one of {_OPERATIONS}")
            return dict(item)
        ((name, value),) = item.items()
        at = (*path, name)
        if name == "rotate":
            return {name: self._rotation(value, at)}
        numbers = finite_numbers(value, 3)
        if name == "scale" and as_finite(value) is not None:
            numbers = [as_finite(value) or 0.0] * 3
        need = "3 finite numbers [x, y, z]" if name == "translate" else "a number or [x, y, z], none of them 0"
        if numbers is None or (name == "scale" and 0.0 in numbers):
            self.note_mismatch(at, value, need)
        return {name: numbers}

    def _rotation(self, value: Any, path: KeyPath) -> Any:
        if not isinstance(value, Mapping) or set(value) != {"axis", "angle_deg"}:
            self.note_mismatch(path, value, "{axis: [x, y, z], angle_deg: a}")
            return value
        axis, angle = finite_numbers(value["axis"], 3), as_finite(value["angle_deg"])
        if axis is None or not any(axis):
            self.note_mismatch((*path, "axis"), value["axis"], "3 finite numbers [x, y, z], not all zero")
        if angle is None:
            self.note_mismatch((*path, "angle_deg"), value["angle_deg"], "a finite number in degrees")
        return {"axis": axis, "angle_deg": angle}


def plugin_mapping(walk: Callable[[PluginCheck, Any], Any], types: Sequence[str]) -> Checked:
    """Return the check of a plugin dictionary: ``walk`` goes over it and returns the result, which is then frozen."""

    def check(value: object, validation: ValidationInfo) -> Any:
        found = PluginCheck(config_folder(validation))
        result = walk(found, value)
        if found.issues:
            raise InvalidValue(*found.issues)
        return freeze(result)

    schema = {"type": "object", "required": ["type"], "properties": {"type": {"enum": list(types)}}}
    return Checked(check, schema, with_context=True)


def config_folder(validation: ValidationInfo) -> Path:
    """Return the folder relative file names start from: the YAML's, else the current directory."""
    return Path((validation.context or {}).get("folder", ".")).absolute()


def existing_file(name: str, folder: Path, start: str = "the YAML's folder") -> tuple[Path, str]:
    """Return the absolute path of ``name`` and what is wrong with it; empty for a readable file.

    ``start`` says in words where relative names start.
    """
    try:
        path = (folder / name).resolve()
        if path.is_file():
            return path, ""
        found = "a folder" if path.is_dir() else "no file"
    except (OSError, ValueError, RuntimeError):  # too long, a null character, a loop of links
        return Path(folder), f"got {shown(name)}, which is no possible file name."
    alike = (entry.name for entry in path.parent.glob("*") if entry.suffix.lower() == path.suffix.lower())
    hint = nearest(path.name, alike) if path.parent.is_dir() else None
    advice = f" Did you mean {hint}?" if hint and found == "no file" else ""
    return path, f"got {name}, but there is {found} at {path}. Relative names start at {start}.{advice}"


def mitsuba_file(name: str, folder: Path, start: str = "the YAML's folder") -> tuple[Path, str]:
    """Return as ``existing_file`` does, for a file that Mitsuba opens by its name."""
    path, problem = existing_file(name, folder, start)
    if not problem and not is_encodable(str(path)):
        what = f"got {shown(name)}; Mitsuba opens files with names in UTF-8 only, not {path}."
        problem = f"{what} Rename it, or its folder."
    return path, problem
