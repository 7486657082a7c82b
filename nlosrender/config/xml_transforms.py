"""``<transform>`` elements of a Mitsuba scene -> the ``to_world`` values of a configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

from nlosrender.config.vectors import cross, length, unit

_SEPARATOR = re.compile(r"[\s,]+")
_UNIT_ROUNDING = 1e-3  # of the length of a rotation's axis, as files write it
_AXES = ("x", "y", "z")
_LAST_ROW = [0.0, 0.0, 0.0, 1.0]


def transform_steps(transform: Iterable[Element]) -> list[Any] | None:
    """Return the steps of a ``<transform>``, the first applied first, each a ``to_world`` of its own.

    None for a transform that Mitsuba cannot read either: it says so, with the line.
    """
    try:
        return [_STEPS[step.tag](step) for step in transform]
    except (KeyError, ValueError, ZeroDivisionError):
        return None


def numbers_of(text: str | None, counts: Sequence[int] = ()) -> list[float]:
    """Return the numbers in a text, separated by commas or white space.

    Raises
    ------
    ValueError
        A word is no number, or there are not as many as one of ``counts``, if any, says.
    """
    numbers = [float(word) for word in _SEPARATOR.split((text or "").strip()) if word]
    if counts and len(numbers) not in counts:
        raise ValueError(f"got {len(numbers)} numbers, need {' or '.join(map(str, counts))}")
    return numbers


def vector_of(element: Element, default: float = 0.0) -> list[float]:
    """Return the three numbers of an element: in ``value``, where one stands for all three, or in x, y and z.

    Raises
    ------
    ValueError
        One of them is no number.
    """
    if element.get("value") is None:
        return [float(element.get(axis, default)) for axis in _AXES]
    numbers = numbers_of(element.get("value"), (1, 3))
    return numbers * 3 if len(numbers) == 1 else numbers


def check_rotation(step: Element) -> None:
    """Refuse a ``<rotate>`` about an axis that is no unit vector: Mitsuba takes it as one, and shears what it turns.

    Raises
    ------
    ValueError
        Says how long the axis is, and what it should be.
    """
    try:
        axis = vector_of(step)
    except ValueError:
        return  # Mitsuba says so
    if any(axis) and abs(length(axis) - 1) > _UNIT_ROUNDING:
        need = ", ".join(f"{item:.6g}" for item in unit(axis))
        raise ValueError(f"<rotate> about an axis of length {length(axis):.6g}, need a unit vector: {need}")


def _rotation(step: Element) -> list[Any]:
    return [{"rotate": {"axis": vector_of(step), "angle_deg": float(step.get("angle", ""))}}]


def _matrix(step: Element) -> list[Any]:
    numbers = numbers_of(step.get("value"), (9, 16))
    if len(numbers) == 16:
        return [numbers[4 * row : 4 * row + 4] for row in range(4)]
    return [[*numbers[3 * row : 3 * row + 3], 0.0] for row in range(3)] + [_LAST_ROW]


def _lookat(step: Element) -> list[Any]:
    """Return the matrix whose z axis points from origin to target, and its y axis as near to up as may be."""
    origin, target, up = (numbers_of(step.get(key), (3,)) for key in ("origin", "target", "up"))
    forward = unit([b - a for a, b in zip(origin, target, strict=True)])
    left = unit(cross(up, forward))
    columns = [left, cross(forward, left), forward, origin]
    return [[column[row] for column in columns] for row in range(3)] + [_LAST_ROW]


_STEPS: Mapping[str, Callable[[Element], list[Any]]] = {
    "lookat": _lookat,
    "matrix": _matrix,
    "rotate": _rotation,
    "scale": lambda step: [{"scale": vector_of(step, 1.0)}],
    "translate": lambda step: [{"translate": vector_of(step)}],
}
