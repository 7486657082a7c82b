"""Keys without effect, which another value of a choice needs: left out before validation, and told in a warning.

So ``--set capture.scan_type=confocal`` works on a file with a ``laser_point``, and a sweep may go over scan types.
"""

from __future__ import annotations

import copy
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from nlosrender.config.capture import CaptureConfig, ScanType
from nlosrender.config.emitters import EmitterConfig
from nlosrender.config.hidden_geometry import HiddenItemConfig
from nlosrender.config.relay_wall import RelayWallConfig
from nlosrender.config.render import RenderConfig
from nlosrender.config.scene import SceneConfig
from nlosrender.config.section import Section, sections_in, type_of

_SCANS = typing.get_args(ScanType)
_OF_WALLS = ("single", "confocal", "exhaustive")
_NEEDED_BY: dict[str, tuple[str, ...]] = {
    "capture.sensor_points": _OF_WALLS,
    "capture.laser_grid": ("exhaustive",),
    "capture.laser_points": ("exhaustive",),
    "capture.laser_point": ("single",),
    "capture.laser_spots": ("single",),
    "capture.laser_spot_weights": ("single",),
    "capture.multiplex": ("single",),
    "capture.laser_flash": ("single",),
    "capture.laser_target": ("single",),
    "capture.laser_targets": ("exhaustive",),
    "capture.pixel_point": _OF_WALLS,
    "scene.emitters": ("line_of_sight",),
    "capture.laser_position": _OF_WALLS,
    "capture.sensor_position": _OF_WALLS,
    "capture.laser_energy": _OF_WALLS,
    "capture.laser_spot_radius": _OF_WALLS,
    "capture.footprint": _OF_WALLS,
    "render.laser_sampling": _OF_WALLS,
    "render.hidden_geometry_sampling": _OF_WALLS,
}
_OF_GRIDS = tuple(
    f"capture.{key}" for key in ("sensor_points", "laser_grid", "laser_points", "laser_point", "sensor_position")
)
_SECTIONS: dict[str, type[Section]] = {"scene": SceneConfig, "capture": CaptureConfig, "render": RenderConfig}
# an item or a wall without them would stand elsewhere than its author thinks: they stay mistakes
_PLACING = ("center", "translate", "rotate_deg", "scale", "fit")


def fields_by_type(choice: Any) -> dict[str, set[str]]:
    """Return the keys of every member of a union of sections, by its ``type``."""
    return {type_of(member): {*member.model_fields} for member in sections_in(typing.get_args(choice)[0])}


_FIELDS = {
    "relay_wall": fields_by_type(RelayWallConfig),
    "hidden_geometry": fields_by_type(HiddenItemConfig),
    "emitters": fields_by_type(EmitterConfig),
}


def without_unused_keys(raw: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the values of a config that have an effect, and a sentence for each choice that leaves some without.

    Parameters
    ----------
    raw
        Not validated: whatever is wrong in it is left as it is. Values that are left out are not validated.
    """
    kept = copy.deepcopy(dict(raw))
    notes = [*_by_scan_type(kept)]
    scene = kept.get("scene")
    if isinstance(scene, dict):
        notes += _by_type(scene.get("relay_wall"), _FIELDS["relay_wall"], "scene.relay_wall")
        for key in ("hidden_geometry", "emitters"):
            items = scene.get(key)
            for index, item in enumerate(items if isinstance(items, list) else ()):
                notes += _by_type(item, _FIELDS[key], f"scene.{key}.{index}")
    return kept, notes


def _by_scan_type(kept: dict[str, Any]) -> Iterator[str]:
    capture = kept.get("capture")
    scan = capture.get("scan_type") if isinstance(capture, dict) else None
    if not isinstance(capture, dict) or scan not in _SCANS:
        return
    unused = [key for key, needed_by in _NEEDED_BY.items() if scan not in needed_by and _take(kept, key)]
    if scan == "line_of_sight" and _is_no_film(capture.get("sensor_grid"), capture.get("camera")):
        del capture["sensor_grid"]
        unused.append("capture.sensor_grid")
    owners = {name for key in unused for name in _NEEDED_BY.get(key, _OF_WALLS)}
    yield from _note(unused, f"capture.scan_type: {scan}", [name for name in _SCANS if name in owners])
    if scan in _OF_WALLS and _has_camera(kept):
        idle = [key for key in _OF_GRIDS if _take(kept, key)]
        if _is_no_film(capture.get("sensor_grid"), capture.get("camera")):
            del capture["sensor_grid"]
            idle.append("capture.sensor_grid")
        yield from _note(idle, "a camera", ["grids on a relay wall"])


def _has_camera(kept: Mapping[str, Any]) -> bool:
    scene = kept.get("scene")
    whole = scene.get("mitsuba") if isinstance(scene, Mapping) else None
    return kept["capture"].get("camera") is not None or whole is not None


def _take(kept: dict[str, Any], path: str) -> bool:
    """Take a key out; return whether it said anything: null and the default say nothing."""
    name, key = path.split(".")
    section = kept.get(name)
    if not isinstance(section, dict) or key not in section:
        return False
    value = section.pop(key)
    return value not in (None, [], (), _SECTIONS[name].model_fields[key].default)


def _is_no_film(grid: Any, camera: Any) -> bool:
    """Tell a sensor grid of a wall from one that only repeats the camera's pixels."""
    if not isinstance(grid, Mapping) or not isinstance(camera, Mapping):
        return False
    given = {key: value for key, value in grid.items() if value is not None}
    return given != {"nx": camera.get("width"), "ny": camera.get("height")}


def _by_type(item: Any, fields: Mapping[str, set[str]], path: str) -> Iterator[str]:
    """Take the keys of other types of walls, items and emitters out."""
    chosen = item.get("type") if isinstance(item, dict) else None
    if not isinstance(chosen, str) or chosen not in fields:
        return
    others = set().union(*fields.values()) - fields[chosen]
    gone = [key for key in item if key in others and (item[key] is None or key not in _PLACING)]
    unused = [f"{path}.{key}" for key in gone if item.pop(key) is not None]
    yield from _note(unused, f"{path}.type: {chosen}", [name for name in fields if not fields[name].isdisjoint(gone)])


def _note(unused: list[str], choice: str, owners: list[str]) -> Iterator[str]:
    verb, they = ("has", "it is") if len(unused) == 1 else ("have", "they are")
    if unused:
        yield f"{', '.join(unused)} {verb} no effect with {choice}; {they} for {', '.join(owners)}."
