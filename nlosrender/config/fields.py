"""The types of single config values: numbers, vectors, text. Each says in one sentence what it allows.

Plain validators rather than pydantic's own types: YAML's true is no number, "3" is no 3, and every message names
the value found and what is allowed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from nlosrender.config.encodable import is_encodable
from nlosrender.config.refusal import refuse
from nlosrender.config.vectors import length

SHORTEST, LONGEST = 1e-9, 1e9  # m; shorter or longer lengths are slips of the pen, and float32 has no room for them
LONGEST_NAME = 1000  # bytes; file systems take 255 or so and say so themselves
_FEWEST_JOULES, _MOST_JOULES = 1e-15, 1e15  # the square of H stays a float32 number
_MOST_SAMPLES = 10**12
_MOST_BOUNCES = 10**6
_SMALLEST_DIRECTION = 1e-12  # below it, and above its inverse, a vector has no direction in float64 worth the name
_LONGEST_SIZE = 40  # characters
_MEMORY = re.compile(r"(\d+(?:\.\d+)?|\.\d+)\s*([kmgt]?i?b)", re.IGNORECASE)
_MEMORY_UNITS = {"b": 1, **{f"{p}b": 1000 ** (i + 1) for i, p in enumerate("kmgt")}} | {
    f"{p}ib": 1024 ** (i + 1) for i, p in enumerate("kmgt")
}


@dataclass(frozen=True, eq=False)  # hashed by identity: typing hashes metadata, and a schema is a dict
class Checked:
    """Pydantic metadata: validate with ``check`` alone, and describe the value by ``json_schema``.

    Parameters
    ----------
    check
        Takes the raw value (and pydantic's validation info when ``with_context``), returns the checked one or raises
        what :func:`~nlosrender.config.refusal.refuse` builds.
    json_schema
        The fragment of JSON Schema for ``nlosrender schema``.
    with_context
        Pass the validation info, whose context holds the config's folder.
    """

    check: Callable[..., Any]
    json_schema: dict[str, Any]
    with_context: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the validation schema: this check and nothing of pydantic's own coercion."""
        if self.with_context:
            return core_schema.with_info_plain_validator_function(self.check)
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return the JSON Schema fragment."""
        return dict(self.json_schema)


def as_finite(value: object) -> float | None:
    """Return ``value`` as a float, or None when it is no finite number (a bool is none)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number + 0.0 if math.isfinite(number) else None  # + 0.0: -0.0 and 0.0 are one config


def _number(
    need: str, allows: Callable[[float], bool], least: float = 0.0, most: float = math.inf, unit: str = "m"
) -> Callable[[object], float]:
    def check(value: object) -> float:
        number = as_finite(value)
        if number is None or not allows(number):
            raise refuse(value, need, _quoted_number(value))
        if number and not least <= abs(number) <= most:
            raise refuse(value, f"{least:g} to {most:g} {unit}")
        return number

    return check


def _integer(need: str, allows: Callable[[int], bool], advice: str = "") -> Callable[[object], int]:
    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not allows(value):
            raise refuse(value, need, _quoted_number(value) or _broken_integer(value) or advice)
        return value

    return check


def _bounded_integer(need: str, least: float, most: int, advice: str = "") -> Callable[[object], int]:
    check_least = _integer(need, lambda n: n >= least, advice)

    def check(value: object) -> int:
        number = check_least(value)
        if number > most:
            raise refuse(value, f"at most {most:_}")
        return number

    return check


def _vector(
    size: int,
    need: str,
    allows: Callable[[tuple[float, ...]], bool],
    least: float = 0.0,
    most: float = math.inf,
) -> Callable[[object], Any]:
    def check(value: object) -> Any:
        numbers = [as_finite(item) for item in value] if isinstance(value, (list, tuple)) else []
        finite = tuple(number for number in numbers if number is not None)
        if len(finite) != size or len(numbers) != size or not allows(finite):
            raise refuse(value, need)
        if any(abs(number) > most or 0 < abs(number) < least for number in finite):
            need_range = f"{least:g} to {most:g} m" if least else f"coordinates up to {most:g} m"
            raise refuse(value, need_range)
        return finite

    return check


def _broken_integer(value: object) -> str:
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:  # shown as the integer that it is not
        return f"Write {value:.0f}, without point and exponent."
    return ""


def _quoted_number(value: object) -> str:
    if not isinstance(value, str):
        return ""
    try:
        float(value)
    except ValueError:
        return ""
    return "Write the number without underscores." if "_" in value else "Write the number without quotes."


def _brightness(value: object) -> Any:
    numbers = [as_finite(item) for item in value] if isinstance(value, (list, tuple)) else [as_finite(value)]
    if len(numbers) != (3 if isinstance(value, (list, tuple)) else 1) or any(
        number is None or not 0 <= number <= _MOST_JOULES for number in numbers
    ):
        raise refuse(value, f"a number from 0 to {_MOST_JOULES:g}, or [r, g, b]", _quoted_number(value))
    return tuple(numbers) if isinstance(value, (list, tuple)) else numbers[0]


def _scale(value: object) -> Any:
    need = "a number other than 0, or three of them [x, y, z]; negative ones mirror"
    numbers = [as_finite(item) for item in value] if isinstance(value, (list, tuple)) else [as_finite(value)]
    if len(numbers) != (3 if isinstance(value, (list, tuple)) else 1) or not all(numbers):
        raise refuse(value, need, _quoted_number(value))
    return tuple(numbers) if isinstance(value, (list, tuple)) else numbers[0]


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise refuse(value, "true or false")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise refuse(value, "text", "" if value is None else "Put it in quotes.")
    if not value.strip() or any(ord(character) < 32 for character in value) or not is_encodable(value):
        raise refuse(value, "text that is not blank and has no control characters or halves of characters")
    return value


def _name(value: object) -> str:
    text = _text(value)
    if "/" in text or "\\" in text:
        raise refuse(value, "a name without slashes", "It becomes part of file names; folders go into output.path.")
    if len(text.encode()) > LONGEST_NAME:
        raise refuse(value, f"a name of at most {LONGEST_NAME} bytes", "It becomes part of file names.")
    return text


def _bin_count(value: object) -> int | Literal["auto"]:
    if value == "auto":
        return "auto"
    return _integer("auto or an integer >= 1", lambda count: count >= 1)(value)


def _memory(value: object) -> str:
    if value == "auto" or (isinstance(value, str) and memory_bytes(value)):
        return str(value)
    raise refuse(value, 'auto or a size with its unit such as "600MB", "8GB" or "2GiB"')


def memory_bytes(text: str) -> int | None:
    """Return the bytes in a size such as ``600MB`` (10^6) or ``2GiB`` (2^30); None when it is not one, or below 1."""
    match = _MEMORY.fullmatch(text.strip())
    if match is None or len(text) > _LONGEST_SIZE:
        return None
    return int(float(match[1]) * _MEMORY_UNITS[match[2].lower()]) or None


def _array(size: int, **item: object) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number", **item}, "minItems": size, "maxItems": size}


def _has_direction(vector: tuple[float, ...]) -> bool:
    return _SMALLEST_DIRECTION < length(vector) < 1 / _SMALLEST_DIRECTION


def _all_positive(vector: tuple[float, ...]) -> bool:
    return all(item > 0 for item in vector)


Positive = Annotated[
    float, Checked(_number("a number > 0", lambda x: x > 0), {"type": "number", "exclusiveMinimum": 0})
]
_NOT_ZERO = {"type": "number", "not": {"const": 0}}
Scale = Annotated[
    float | tuple[float, float, float],
    Checked(
        _scale,
        {"anyOf": [_NOT_ZERO, {"type": "array", "items": _NOT_ZERO, "minItems": 3, "maxItems": 3}]},
    ),
]
Energy = Annotated[
    float,
    Checked(
        _number("a number > 0", lambda x: x > 0, _FEWEST_JOULES, _MOST_JOULES, "J"),
        {"type": "number", "exclusiveMinimum": 0, "maximum": _MOST_JOULES},
    ),
]
Coordinate = Annotated[
    float,
    Checked(
        _number("a finite number", lambda x: True, most=LONGEST),
        {"type": "number", "minimum": -LONGEST, "maximum": LONGEST},
    ),
]
Length = Annotated[
    float,
    Checked(
        _number("a number > 0", lambda x: x > 0, SHORTEST, LONGEST),
        {"type": "number", "exclusiveMinimum": 0, "maximum": LONGEST},
    ),
]
LengthOrZero = Annotated[
    float,
    Checked(
        _number("a number >= 0", lambda x: x >= 0, SHORTEST, LONGEST),
        {"type": "number", "minimum": 0, "maximum": LONGEST},
    ),
]
OpenUnit = Annotated[
    float,
    Checked(
        _number("a number between 0 and 1 (both excluded)", lambda x: 0 < x < 1),
        {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1},
    ),
]
SampleCount = Annotated[
    int,
    Checked(
        _bounded_integer("an integer >= 1", 1, _MOST_SAMPLES),
        {"type": "integer", "minimum": 1, "maximum": _MOST_SAMPLES},
    ),
]
GridCount = Annotated[
    int,
    Checked(
        _integer("an integer >= 1", lambda n: n >= 1, "Use scan_type: single for one laser point."),
        {"type": "integer", "minimum": 1},
    ),
]
BounceCount = Annotated[  # the least depends on the scan type: config.line_of_sight
    int,
    Checked(
        _bounded_integer("an integer, or null for no limit", -math.inf, _MOST_BOUNCES),
        {"type": "integer", "minimum": 0, "maximum": _MOST_BOUNCES},
    ),
]
FieldOfView = Annotated[
    float,
    Checked(
        _number("an angle between 0 and 180 degrees (both excluded)", lambda x: 0 < x < 180),
        {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 180},
    ),
]
Seed = Annotated[
    int,
    Checked(
        _integer("an integer from 0 to 4294967295", lambda n: 0 <= n < 2**32),
        {"type": "integer", "minimum": 0, "maximum": 2**32 - 1},
    ),
]
Vector3 = tuple[float, float, float]
Brightness = Annotated[
    float | Vector3,
    Checked(_brightness, {"anyOf": [{"type": "number", "minimum": 0}, _array(3, minimum=0)]}),
]
Point2 = Annotated[
    tuple[float, float],
    Checked(_vector(2, "2 finite numbers [x, y]", lambda v: True, most=LONGEST), _array(2)),
]
Point3 = Annotated[Vector3, Checked(_vector(3, "3 finite numbers [x, y, z]", lambda v: True, most=LONGEST), _array(3))]
Angles3 = Annotated[Vector3, Checked(_vector(3, "3 finite numbers [x, y, z]", lambda v: True), _array(3))]
Direction = Annotated[
    Vector3, Checked(_vector(3, "3 finite numbers [x, y, z], not all zero", _has_direction), _array(3))
]
Sizes3 = Annotated[
    Vector3,
    Checked(_vector(3, "3 numbers > 0 [x, y, z]", _all_positive, SHORTEST, LONGEST), _array(3, exclusiveMinimum=0)),
]
Flag = Annotated[bool, Checked(_flag, {"type": "boolean"})]
Text = Annotated[str, Checked(_text, {"type": "string", "minLength": 1})]
Name = Annotated[str, Checked(_name, {"type": "string", "minLength": 1})]
BinCount = Annotated[
    int | Literal["auto"], Checked(_bin_count, {"anyOf": [{"const": "auto"}, {"type": "integer", "minimum": 1}]})
]
MemoryLimit = Annotated[str, Checked(_memory, {"type": "string", "examples": ["auto", "600MB", "8GB", "2GiB"]})]
