"""The types of single config values: numbers, vectors, text. Each says in one sentence what it allows.

Checks of our own rather than pydantic's: YAML's true is no number, "3" is no 3, and every message names the value found
and what is allowed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema

from nlosrender.config.encodable import is_encodable
from nlosrender.config.issues import InvalidValue, Wrong, invalid_value
from nlosrender.config.vectors import length

MIN_LENGTH, MAX_LENGTH = (
    1e-9,
    1e9,
)  # m; beyond them lengths are slips of the pen, and float32 has no room
MAX_NAME_BYTES = 1000  # file systems take 255 or so and say so themselves
_MIN_JOULES, _MAX_JOULES = 1e-15, 1e15  # the square of H stays a float32 number
_MAX_SAMPLES = 10**12  # a path tracer takes years for them
_MAX_BOUNCES = 10**6
_MIN_DIRECTION = 1e-12  # below it, and above its inverse, a vector has no direction in float64 worth the name
_MAX_SIZE_LENGTH = 40  # characters of a size such as 600MB
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
        :class:`~nlosrender.config.issues.InvalidValue`; the field is then :class:`~nlosrender.config.issues.Wrong`.
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

        def check(value: Any, validation: ValidationInfo) -> Any:
            if isinstance(value, Wrong):
                return value
            try:
                return self.check(value, validation) if self.with_context else self.check(value)
            except InvalidValue as error:
                return Wrong(*error.issues)

        return core_schema.with_info_plain_validator_function(check)

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


def finite_numbers(value: object, *sizes: int) -> list[float] | None:
    """Return a list of as many finite numbers as one of ``sizes`` says, as floats; None when it is not one."""
    numbers = [as_finite(item) for item in value] if isinstance(value, (list, tuple)) else []
    finite = [number for number in numbers if number is not None]
    return finite if len(finite) == len(numbers) and len(finite) in sizes else None


def three_or_one(value: object) -> list[float] | None:
    """Return one finite number or a list of three, as a list; None when it is neither."""
    return finite_numbers(value, 3) if isinstance(value, (list, tuple)) else finite_numbers([value], 1)


def _number(need: str, span: tuple[float, float, str] | None = None, **bounds: float) -> Checked:
    """Return the check of a number with the bounds of its JSON Schema; ``span`` holds for its size, except of 0."""
    smallest, largest, unit = span or (0.0, math.inf, "")
    minimum, above = bounds.get("minimum", -math.inf), bounds.get("exclusiveMinimum", -math.inf)
    below = bounds.get("exclusiveMaximum", math.inf)

    def check(value: object) -> float:
        number = as_finite(value)
        if number is None or not (minimum <= number and above < number < below):
            raise invalid_value(value, need, _unquote(value))
        if number and not smallest <= abs(number) <= largest:
            raise invalid_value(value, f"{smallest:g} to {largest:g} {unit}")
        return number

    return Checked(check, {"type": "number", **bounds, **({"maximum": largest} if span else {})})


def integer(need: str, minimum: float, maximum: int | None = None, too_large: str = "", advice: str = "") -> Checked:
    """Return the check of an integer; ``too_large`` instead of ``need`` is told above the maximum."""

    def check(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
            raise invalid_value(value, need, _unquote(value) or _without_exponent(value) or advice)
        if maximum is not None and value > maximum:
            raise invalid_value(value, too_large or need)
        return value

    return Checked(check, {"type": "integer", "minimum": minimum} | ({"maximum": maximum} if maximum else {}))


def _vector(
    need: str, size: int = 3, allows: Callable[[Sequence[float]], bool] | None = None, most: float = math.inf
) -> Checked:
    def check(value: object) -> tuple[float, ...]:
        numbers = finite_numbers(value, size)
        if numbers is None or (allows and not allows(numbers)):
            raise invalid_value(value, need)
        if any(abs(number) > most for number in numbers):
            raise invalid_value(value, f"coordinates up to {most:g} m")
        return tuple(numbers)

    return Checked(check, _array(size))


def _array(size: int, **item: object) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number", **item}, "minItems": size, "maxItems": size}


def _without_exponent(value: object) -> str:
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:  # shown as the integer that it is not
        return f"Write {value:.0f}, without point and exponent."
    return ""


def _unquote(value: object) -> str:
    if not isinstance(value, str):
        return ""
    try:
        float(value)
    except ValueError:
        return ""
    return "Write the number without underscores." if "_" in value else "Write the number without quotes."


def _share(value: object) -> float:
    number = as_finite(value)
    if number is None or not 0 <= number <= 1:
        raise invalid_value(value, "a number from 0 to 1", _unquote(value))
    return number


def _brightness(value: object) -> float | tuple[float, ...]:
    numbers = three_or_one(value)
    if numbers is None or not all(0 <= number <= _MAX_JOULES for number in numbers):
        raise invalid_value(value, f"a number from 0 to {_MAX_JOULES:g}, or [r, g, b]", _unquote(value))
    return numbers[0] if len(numbers) == 1 else tuple(numbers)


def _scale(value: object) -> float | tuple[float, ...]:
    numbers = three_or_one(value)
    if numbers is None or 0 in numbers:
        need = "a number other than 0, or three of them [x, y, z]; negative ones mirror"
        raise invalid_value(value, need, _unquote(value))
    return numbers[0] if len(numbers) == 1 else tuple(numbers)


def _weights(value: object) -> tuple[float, ...]:
    numbers = finite_numbers(value, len(value)) if isinstance(value, (list, tuple)) else None
    if not numbers or not 0 <= min(numbers) <= max(numbers) <= _MAX_JOULES or max(numbers) == 0:
        raise invalid_value(value, "a list of numbers >= 0, not all 0")
    return tuple(numbers)


def _sizes(need: str, size: int) -> Checked:
    def check(value: object) -> tuple[float, ...]:
        numbers = finite_numbers(value, size)
        if numbers is None or min(numbers) <= 0:
            raise invalid_value(value, need)
        if not MIN_LENGTH <= min(numbers) <= max(numbers) <= MAX_LENGTH:
            raise invalid_value(value, f"{MIN_LENGTH:g} to {MAX_LENGTH:g} m")
        return tuple(numbers)

    return Checked(check, _array(size, exclusiveMinimum=0))


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise invalid_value(value, "true or false")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise invalid_value(value, "text", "" if value is None else "Put it in quotes.")
    if not value.strip() or any(ord(character) < 32 for character in value) or not is_encodable(value):
        raise invalid_value(value, "text that is not blank and has no control characters or halves of characters")
    return value


def _name(value: object) -> str:
    text = _text(value)
    if "/" in text or "\\" in text:
        advice = "It becomes part of file names; folders go into output.path."
        raise invalid_value(value, "a name without slashes", advice)
    if len(text.encode()) > MAX_NAME_BYTES:
        raise invalid_value(value, f"a name of at most {MAX_NAME_BYTES} bytes", "It becomes part of file names.")
    return text


def _bin_count(value: object) -> int | str:
    return "auto" if value == "auto" else int(integer("auto or an integer >= 1", 1).check(value))


def _memory(value: object) -> str:
    if value == "auto" or (isinstance(value, str) and memory_bytes(value)):
        return str(value)
    raise invalid_value(value, 'auto or a size with its unit such as "600MB", "8GB" or "2GiB"')


def memory_bytes(text: str) -> int | None:
    """Return the bytes in a size such as ``600MB`` (10^6) or ``2GiB`` (2^30); None when it is not one, or below 1."""
    match = _MEMORY.fullmatch(text.strip())
    if match is None or len(text) > _MAX_SIZE_LENGTH:
        return None
    return int(float(match[1]) * _MEMORY_UNITS[match[2].lower()]) or None


def _has_direction(vector: Sequence[float]) -> bool:
    return _MIN_DIRECTION < length(vector) < 1 / _MIN_DIRECTION


_LENGTHS = (MIN_LENGTH, MAX_LENGTH, "m")
_PICOSECONDS, _RATES = (1e-3, 1e9, "ps"), (1e-9, 1e15, "1/s")
_NOT_ZERO = {"type": "number", "not": {"const": 0}}
_XYZ = "3 finite numbers [x, y, z]"
_TEXT = {"type": "string", "minLength": 1}

Positive = Annotated[float, _number("a number > 0", exclusiveMinimum=0)]
NonNegative = Annotated[float, _number("a number >= 0", (1e-12, 1e6, ""), minimum=0)]
Wavelength = Annotated[float, _number("a number > 0", (1.0, 1e6, "nm"), exclusiveMinimum=0)]
SolidAngle = Annotated[float, _number("a number > 0", (1e-15, 4 * math.pi, "sr"), exclusiveMinimum=0)]
Area = Annotated[float, _number("a number > 0", (1e-15, 1e12, "m^2"), exclusiveMinimum=0)]
Weights = Annotated[tuple[float, ...], Checked(_weights, {"type": "array", "items": {"type": "number", "minimum": 0}})]
Photons = Annotated[float, _number("a number > 0", (1e-12, 1e6, "photons"), exclusiveMinimum=0)]
Delay = Annotated[float, _number("a number > 0", _PICOSECONDS, exclusiveMinimum=0)]
DelayOrZero = Annotated[float, _number("a number >= 0", _PICOSECONDS, minimum=0)]
Rate = Annotated[float, _number("a number > 0", _RATES, exclusiveMinimum=0)]
RateOrZero = Annotated[float, _number("a number >= 0", _RATES, minimum=0)]
Share = Annotated[float, Checked(_share, {"type": "number", "minimum": 0, "maximum": 1})]
Energy = Annotated[float, _number("a number > 0", (_MIN_JOULES, _MAX_JOULES, "J"), exclusiveMinimum=0)]
Coordinate = Annotated[
    float, _number(f"a number from -{MAX_LENGTH:g} to {MAX_LENGTH:g} m", (0.0, MAX_LENGTH, "m"), minimum=-MAX_LENGTH)
]
Length = Annotated[float, _number("a number > 0", _LENGTHS, exclusiveMinimum=0)]
LengthOrZero = Annotated[float, _number("a number >= 0", _LENGTHS, minimum=0)]
OpenUnit = Annotated[float, _number("a number between 0 and 1 (both excluded)", exclusiveMinimum=0, exclusiveMaximum=1)]
FieldOfView = Annotated[
    float, _number("an angle between 0 and 180 degrees (both excluded)", exclusiveMinimum=0, exclusiveMaximum=180)
]
SampleCount = Annotated[int, integer("an integer >= 1", 1, _MAX_SAMPLES, f"at most {_MAX_SAMPLES:_}")]
GridCount = Annotated[int, integer("an integer >= 1", 1, advice="Use scan_type: single for one laser point.")]
BounceCount = Annotated[  # the least depends on the scan type: document.Config.rule_enough_bounces
    int,
    Checked(
        integer("an integer, or null for no limit", -math.inf, _MAX_BOUNCES, f"at most {_MAX_BOUNCES:_}").check,
        {"type": "integer", "minimum": 0, "maximum": _MAX_BOUNCES},
    ),
]
Seed = Annotated[int, integer("an integer from 0 to 4294967295", 0, 2**32 - 1)]
Vector3 = tuple[float, float, float]
Scale = Annotated[
    float | Vector3,
    Checked(_scale, {"anyOf": [_NOT_ZERO, {"type": "array", "items": _NOT_ZERO, "minItems": 3, "maxItems": 3}]}),
]
Brightness = Annotated[
    float | Vector3, Checked(_brightness, {"anyOf": [{"type": "number", "minimum": 0}, _array(3, minimum=0)]})
]
Point2 = Annotated[tuple[float, float], _vector("2 finite numbers [x, y]", 2, most=MAX_LENGTH)]
Point3 = Annotated[Vector3, _vector(_XYZ, most=MAX_LENGTH)]
Angles3 = Annotated[Vector3, _vector(_XYZ)]
Direction = Annotated[Vector3, _vector(f"{_XYZ}, not all zero", allows=_has_direction)]
Sizes2 = Annotated[tuple[float, float], _sizes("2 numbers > 0 [width, height]", 2)]
Sizes3 = Annotated[Vector3, _sizes("3 numbers > 0 [x, y, z]", 3)]
Flag = Annotated[bool, Checked(_flag, {"type": "boolean"})]
Text = Annotated[str, Checked(_text, _TEXT)]
Name = Annotated[str, Checked(_name, _TEXT)]
BinCount = Annotated[
    int | Literal["auto"], Checked(_bin_count, {"anyOf": [{"const": "auto"}, {"type": "integer", "minimum": 1}]})
]
MemoryLimit = Annotated[str, Checked(_memory, {"type": "string", "examples": ["auto", "600MB", "8GB", "2GiB"]})]
