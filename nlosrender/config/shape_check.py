"""What the parameters of a Mitsuba shape may be, in YAML as in XML: round shapes without extent, flat transforms."""

from __future__ import annotations

from typing import Any

from nlosrender.config.bsdf_table import SHAPE_TYPES
from nlosrender.config.fields import MAX_LENGTH, MIN_LENGTH, as_finite
from nlosrender.config.plugin_check import PluginCheck

_ROUND = ("sphere", "cylinder")  # shapes whose parameters give their box before Mitsuba loads them
_POINTS = ("center", "p0", "p1")


def check_shape(check: PluginCheck, value: Any) -> Any:
    """Return a shape dictionary with numbers as floats and file names absolute; note its issues in ``check``."""
    if check.plugin_type(value, (), SHAPE_TYPES, "Mitsuba shape") is None:
        return value
    result = {}
    for key, item in value.items():
        if key == "bsdf":
            check.note((key,), "the BSDF belongs beside shape, not in it; move it one level up.", at_key=True)
        elif isinstance(item, dict) and key != "to_world":
            check.note_mismatch(
                (key,), item, "a number, text or list", "Emitters and sensors cannot be part of a shape."
            )
        elif key in _POINTS and value["type"] in _ROUND:
            result[key] = check.numbers(item, (key,), 3, "3 finite numbers [x, y, z]")
        elif key == "radius" and value["type"] in _ROUND:
            number = as_finite(item)
            if number is None or not MIN_LENGTH <= number <= MAX_LENGTH:
                check.note_mismatch((key,), item, f"a number from {MIN_LENGTH:g} to {MAX_LENGTH:g} m")
            result[key] = item
        else:
            result[key] = check.generic(item, (key,))
    if value["type"] == "cylinder" and result.get("p0", [0.0, 0.0, 0.0]) == result.get("p1", [0.0, 0.0, 1.0]):
        check.note((), "p0 and p1 are the same point, need the two ends of the axis.", at_key=True)
    return result
