"""BSDFs: a Mitsuba BSDF as a dictionary, checked against the table of plugins without starting Mitsuba.

A reflectance is a number (grey), ``[r, g, b]``, or a texture/spectrum dictionary.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Any

from nlosrender.config.bsdf_table import (
    BSDF_PARAMETERS,
    BSDF_REQUIRED,
    BSDF_TYPES,
    COLORED_TYPES,
    MEDIA,
    METALS,
    NESTED_BSDFS,
    NO_METAL,
    TEXTURE_REQUIRED,
    TEXTURE_TYPES,
    TRANSMITTING,
    Kind,
)
from nlosrender.config.fields import as_finite, finite_numbers
from nlosrender.config.frozen import FrozenDict
from nlosrender.config.issues import shown
from nlosrender.config.plugin_check import TRANSFORM_KEYS, PluginCheck, plugin_mapping
from nlosrender.errors import KeyPath, did_you_mean

_NAMES = {  # known ones only: Mitsuba makes a file name of a metal's
    Kind.MATERIAL: (NO_METAL, *METALS),
    Kind.IOR: MEDIA,
}
_WITH_RGB = (Kind.REFLECTANCE, Kind.SPECTRUM)
_WITH_TEXTURE = (Kind.REFLECTANCE, Kind.UNIT, Kind.SPECTRUM)
_NUMBER_RANGES = {  # lowest and highest number allowed
    Kind.REFLECTANCE: (0.0, 1.0),
    Kind.UNIT: (0.0, 1.0),
    Kind.UNIT_NUMBER: (0.0, 1.0),
    Kind.SPECTRUM: (0.0, float("inf")),
    Kind.IOR: (1e-6, float("inf")),
    Kind.IOR_NUMBER: (1e-6, float("inf")),
    # degrees; narrower: float32 directions err by more than 1e-3 of the lobe's peak; wider: the lobe is nearly diffuse
    Kind.WIDTH: (0.01, 60.0),
}

SHARES_ROUNDING = 1e-9  # 0.7 + 0.2 + 0.1 > 1

WHITE_DIFFUSE = FrozenDict(type="diffuse", reflectance=1.0)


def check_parameters(check: PluginCheck, kind: str, values: Mapping[str, Any], names: Collection[str]) -> None:
    """Note what is wrong with the parameters of a BSDF; those not in the table are not checked.

    ``names`` are all that it has, of which ``values`` are known.
    """
    known = BSDF_PARAMETERS.get(kind, {})
    _check_required(check, kind, names, ())
    for key, value in values.items():
        if key in known:
            _parameter(check, value, (key,), known[key])
    if kind == "retroreflector":
        _check_shares(check, values, ())


def is_colored(value: object) -> bool:
    """Return whether a checked BSDF, or a part of one, differs between colour channels (or may: textures)."""
    if isinstance(value, Mapping):
        kind = value.get("type")
        metal = value.get("material", NO_METAL) != NO_METAL
        spectrum = kind == "spectrum" and as_finite(value.get("value")) is None
        parts = (item for key, item in value.items() if key not in TRANSFORM_KEYS)
        return kind in COLORED_TYPES or metal or spectrum or any(is_colored(part) for part in parts)
    if not isinstance(value, tuple) or len(value) != 3 or any(as_finite(item) is None for item in value):
        return False
    return len(set(value)) > 1


def _bsdf(check: PluginCheck, value: Any, path: KeyPath) -> Any:
    kind = check.plugin_type(value, path, BSDF_TYPES, "Mitsuba BSDF")
    if kind is None:
        return value
    known = BSDF_PARAMETERS.get(kind)
    nested = [key for key, item in value.items() if key != "type" and _is_bsdf(item, key, kind)]
    result: dict[str, Any] = {"type": kind}
    for key, item in value.items():
        at = (*path, key)
        if key in nested:
            result[key] = _bsdf(check, item, at)
        elif known is None:
            result[key] = _texture(check, item, at) if _is_texture(item) else check.generic(item, at)
        elif key in known:
            result[key] = _parameter(check, item, at, known[key])
        elif key != "type":
            _unknown_parameter(check, kind, key, at)
    _check_combination(check, kind, value, nested, path)
    return result


def _is_bsdf(value: object, key: str, parent: str) -> bool:
    """Tell a nested BSDF from a texture: by its type; a wrong type counts as a BSDF where only those may be."""
    if not isinstance(value, Mapping) or parent not in NESTED_BSDFS or key in BSDF_PARAMETERS.get(parent, {}):
        return False
    return value.get("type") in BSDF_TYPES or (parent in BSDF_PARAMETERS and not _is_texture(value))


def _is_texture(value: object) -> bool:
    return isinstance(value, Mapping) and value.get("type") in TEXTURE_TYPES


def _unknown_parameter(check: PluginCheck, kind: str, key: str, path: KeyPath) -> None:
    known = list(BSDF_PARAMETERS[kind])
    allowed = ", ".join(known) or "nested BSDFs only"
    message = f"unknown parameter of the {kind} BSDF, it has: {allowed}. {did_you_mean(key, known)}"
    check.note(path, message.rstrip(), at_key=True)


def _check_combination(
    check: PluginCheck, kind: str, value: Mapping[str, Any], nested: list[str], path: KeyPath
) -> None:
    _check_required(check, kind, value, path)
    fewest, most = NESTED_BSDFS.get(kind, (0, 0))
    if not fewest <= len(nested) <= most and kind in NESTED_BSDFS:
        count = str(fewest) if fewest == most else f"{fewest} to {most}"
        check.note(path, f"got {len(nested)} nested BSDFs, need {count} in a {kind} BSDF.", at_key=True)
    for key in nested:
        if kind == "twosided" and value[key].get("type") in TRANSMITTING:
            message = f"got {value[key]['type']}, which lets light through; need a BSDF that only reflects."
            check.note((*path, key, "type"), message)
    if ("alpha_u" in value) != ("alpha_v" in value):
        given, absent = ("alpha_u", "alpha_v") if "alpha_u" in value else ("alpha_v", "alpha_u")
        check.note((*path, given), f"{given} needs {absent} beside it; use alpha for both.", at_key=True)
    if "alpha" in value and "alpha_u" in value:
        check.note((*path, "alpha"), "alpha and alpha_u, alpha_v exclude each other; keep one.", at_key=True)
    if value.get("material", NO_METAL) != NO_METAL and ("eta" in value or "k" in value):
        check.note((*path, "material"), "material and eta, k exclude each other; keep one.", at_key=True)
    if kind == "retroreflector":
        _check_shares(check, value, path)
    if kind == "principled" and "eta" in value and "specular" in value:
        check.note((*path, "specular"), "eta and specular exclude each other; keep one.", at_key=True)


def _check_required(check: PluginCheck, kind: str, names: Collection[str], path: KeyPath) -> None:
    for key in BSDF_REQUIRED.get(kind, ()):
        if key not in names:
            check.note((*path, key), f"missing, the {kind} BSDF needs it.")


def _check_shares(check: PluginCheck, value: Mapping[str, Any], path: KeyPath) -> None:
    """Refuse a retroreflector that reflects more light than it gets; where textures do, the diffuse share gives way."""
    pair = value.get("albedo"), value.get("diffuse")
    albedo, diffuse = (finite_numbers(item if isinstance(item, (list, tuple)) else [item] * 3, 3) for item in pair)
    together = zip(albedo or [], diffuse or [], strict=False)  # nothing where one of them is no colour
    if any(a + b > 1 + SHARES_ROUNDING and max(a, b) <= 1 for a, b in together):
        message = f"got {shown(pair[1])} beside albedo {shown(pair[0])}, need a sum of at most 1."
        check.note((*path, "diffuse"), message)


def _parameter(check: PluginCheck, value: Any, path: KeyPath, kind: Kind) -> Any:
    if isinstance(value, Mapping) and kind in _WITH_TEXTURE:
        return _texture(check, value, path, unit=kind is Kind.REFLECTANCE)
    if kind is Kind.FLAG and isinstance(value, bool):
        return value
    if kind is Kind.DISTRIBUTION and value in ("beckmann", "ggx"):
        return value
    if kind in _NAMES and isinstance(value, str):
        known = _NAMES[kind]
        if value not in known and not (kind is Kind.IOR and value.lower() in known):
            check.note_mismatch(path, value, kind.value, did_you_mean(value, known))
        return value
    low, high = _NUMBER_RANGES.get(kind, (1.0, 0.0))  # an empty range: no number is allowed
    if isinstance(value, (list, tuple)) and len(value) == 3 and kind in _WITH_RGB:
        numbers = [as_finite(item) for item in value]
    else:
        numbers = [as_finite(value)]
    if any(number is None or not low <= number <= high for number in numbers):
        check.note_mismatch(path, value, kind.value)
        return value
    return numbers[0] if len(numbers) == 1 else numbers


def _texture(check: PluginCheck, value: Any, path: KeyPath, *, unit: bool = False) -> Any:
    kind = check.plugin_type(value, path, TEXTURE_TYPES, "Mitsuba texture or spectrum")
    if kind is None:
        return value
    for key in TEXTURE_REQUIRED.get(kind, ()):
        if key not in value:
            check.note((*path, key), f"missing, the {kind} texture needs it.")
    if kind == "spectrum" and len({"value", "filename"} & set(value)) != 1:
        check.note(path, "need either value or filename in a spectrum.", at_key=True)
    result: dict[str, Any] = {"type": kind}
    for key, item in value.items():
        at = (*path, key)
        if isinstance(item, Mapping) and key not in TRANSFORM_KEYS:
            result[key] = _texture(check, item, at, unit=unit)
        elif kind in ("rgb", "srgb") and key in ("value", "color"):
            result[key] = _channels(check, item, at, unit)
        elif unit and (key in ("color0", "color1") or (key == "value" and not isinstance(item, (list, tuple)))):
            result[key] = _parameter(check, item, at, Kind.REFLECTANCE)
        elif key != "type":
            result[key] = check.generic(item, at)
    return result


def _channels(check: PluginCheck, value: Any, path: KeyPath, unit: bool) -> Any:
    numbers = [as_finite(item) for item in value] if isinstance(value, (list, tuple)) else []
    if len(numbers) != 3 or any(number is None or number < 0 or (unit and number > 1) for number in numbers):
        check.note_mismatch(path, value, f"[r, g, b] with each {'from 0 to 1' if unit else '>= 0'}")
    return numbers or value


BsdfMapping = Annotated[FrozenDict, plugin_mapping(lambda check, bsdf: _bsdf(check, bsdf, ()), BSDF_TYPES)]
