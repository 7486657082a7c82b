"""Keys that another value of a choice needs and the chosen one does not: left out before validation, and said.

So ``--set capture.scan_type=confocal`` works on a file with a ``laser_point``, and a sweep may go over scan types.
"""

from __future__ import annotations

import typing
from collections.abc import Iterator, Mapping
from typing import Any

from nlosrender.config.capture import CaptureConfig, ScanType
from nlosrender.config.emitters import EmitterConfig
from nlosrender.config.hidden_geometry import HiddenItemConfig
from nlosrender.config.relay_wall import RelayWallConfig
from nlosrender.config.render import RenderConfig
from nlosrender.config.section import Section, sections_in, type_of
from nlosrender.errors import KeyPath

_SCANS = typing.get_args(ScanType)
_OF_WALLS = ("single", "confocal", "exhaustive")
_NEEDED_BY: dict[KeyPath, tuple[str, ...]] = {
    ("capture", "laser_grid"): ("exhaustive",),
    ("capture", "laser_point"): ("single",),
    ("capture", "camera"): ("line_of_sight",),
    ("scene", "emitters"): ("line_of_sight",),
    ("capture", "laser_position"): _OF_WALLS,
    ("capture", "sensor_position"): _OF_WALLS,
    ("capture", "laser_energy"): _OF_WALLS,
    ("capture", "laser_spot_radius"): _OF_WALLS,
    ("render", "laser_sampling"): _OF_WALLS,
    ("render", "hidden_geometry_sampling"): _OF_WALLS,
}
_SECTIONS: dict[str, type[Section]] = {"capture": CaptureConfig, "render": RenderConfig}
# an item or a wall without them would stand elsewhere than its author thinks: they stay mistakes
_PLACING = ("center", "translate", "rotate_deg", "scale")
_NOTHING: tuple[object, ...] = (None, [], ())


def without_unused_keys(raw: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the values of a config that have an effect, and a sentence for each choice that leaves some without.

    Parameters
    ----------
    raw
        Not validated: whatever is wrong in it is left as it is. Values that are left out are not validated.
    """
    kept = {key: {**value} if isinstance(value, Mapping) else value for key, value in raw.items()}
    notes = [*_by_scan_type(kept), *_by_types(kept)]
    return kept, tuple(notes)


def _by_scan_type(kept: dict[str, Any]) -> Iterator[str]:
    capture = kept.get("capture")
    scan = capture.get("scan_type") if isinstance(capture, dict) else None
    if not isinstance(capture, dict) or scan not in _SCANS:
        return
    idle = [path for path, needed_by in _NEEDED_BY.items() if scan not in needed_by and _take(kept, path)]
    if scan == "line_of_sight" and _is_no_film(capture.get("sensor_grid"), capture.get("camera")):
        del capture["sensor_grid"]
        idle.append(("capture", "sensor_grid"))
    if idle:
        owners = {name for path in idle for name in _NEEDED_BY.get(path, _OF_WALLS)}
        yield _note(idle, f"capture.scan_type: {scan}", [name for name in _SCANS if name in owners])


def _take(kept: dict[str, Any], path: KeyPath) -> bool:
    """Take a key out; return whether it said anything: null and the default say nothing."""
    section, key = kept.get(str(path[0])), str(path[1])
    if not isinstance(section, dict) or key not in section:
        return False
    value = section.pop(key)
    known = _SECTIONS.get(str(path[0]))
    return value not in _NOTHING and not (known and value == known.model_fields[key].default)


def _is_no_film(grid: Any, camera: Any) -> bool:
    """Tell a sensor grid of a wall from one that only repeats the camera's pixels."""
    if not isinstance(grid, Mapping) or not isinstance(camera, Mapping):
        return False
    given = {key: value for key, value in grid.items() if value is not None}
    return given != {"nx": camera.get("width"), "ny": camera.get("height")}


def _by_types(kept: dict[str, Any]) -> Iterator[str]:
    """Leave out the keys of other types of walls, items and emitters."""
    scene = kept.get("scene")
    if not isinstance(scene, dict):
        return
    if isinstance(scene.get("relay_wall"), Mapping):
        scene["relay_wall"], notes = _of_type(scene["relay_wall"], RelayWallConfig, ("scene", "relay_wall"))
        yield from notes
    for key, choice in (("hidden_geometry", HiddenItemConfig), ("emitters", EmitterConfig)):
        items = scene.get(key)
        if isinstance(items, (list, tuple)):
            found = [_of_type(item, choice, ("scene", key, index)) for index, item in enumerate(items)]
            scene[key] = [item for item, _ in found]
            for _, notes in found:
                yield from notes


def _of_type(item: Any, choice: Any, path: KeyPath) -> tuple[Any, list[str]]:
    fields = fields_by_type(choice)
    chosen = item.get("type") if isinstance(item, Mapping) else None
    if not isinstance(chosen, str) or chosen not in fields:
        return item, []
    others = {key for name in fields for key in fields[name]} - fields[chosen]
    gone = [key for key in item if key in others and (item[key] is None or key not in _PLACING)]
    idle = [(*path, key) for key in gone if item[key] is not None]
    kept = {key: value for key, value in item.items() if key not in gone}
    owners = [name for name in fields if any(key in fields[name] for key in gone)]
    return kept, [_note(idle, f"{'.'.join(map(str, path))}.type: {chosen}", owners)] if idle else []


def fields_by_type(choice: Any) -> dict[str, set[str]]:
    """Return the keys of every member of a union of sections, by its ``type``."""
    return {type_of(member): {*member.model_fields} for member in sections_in(typing.get_args(choice)[0])}


def _note(idle: list[KeyPath], choice: str, others: list[str]) -> str:
    keys = ", ".join(".".join(map(str, path)) for path in idle)
    verb = "has" if len(idle) == 1 else "have"
    return (
        f"{keys} {verb} no effect with {choice}; {'it is' if len(idle) == 1 else 'they are'} for {', '.join(others)}."
    )
