"""``sweep``: many captures from one file. What may be written there; ``sweep_load`` makes configs of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from nlosrender.config.draws import draw_of
from nlosrender.config.fields import Checked, Seed, as_finite, integer
from nlosrender.config.issues import invalid_value, mismatch
from nlosrender.config.section import MAPPING, ONE_OF, Section
from nlosrender.errors import ValidationIssue

MAX_CAPTURES = 100_000  # of one sweep; beyond it a range is a slip of the pen
_STEP_SLACK = 1e-9  # of a step: 0.1 * 3 is not 0.3

_VALUES = "a list of values, {range: {start: 0.5, stop: 1.5, n: 5}} or log_range alike"


def _swept_values(value: object) -> tuple[Any, ...]:
    if isinstance(value, list) and value:
        return tuple(value)
    if not isinstance(value, Mapping) or len(value) != 1 or next(iter(value)) not in ("range", "log_range"):
        raise invalid_value(value, _VALUES)
    kind, ends = next(iter(value.items()))
    steps = ("n",) if kind == "log_range" else ("n", "step")
    if not isinstance(ends, Mapping) or set(ends) not in [{"start", "stop", step} for step in steps]:
        raise invalid_value(ends, f"start, stop and {' or '.join(steps)}")
    start, stop = as_finite(ends["start"]), as_finite(ends["stop"])
    if start is None or stop is None or (kind == "log_range" and min(start, stop) <= 0):
        raise invalid_value(ends["stop" if start is not None else "start"], f"a number{' > 0' * (kind == 'log_range')}")
    n = _number_of_values(ends, start, stop)
    last = start + (n - 1) * float(ends["step"]) if "step" in ends else stop
    return _range(kind, start, last, n)


def _number_of_values(ends: Mapping[str, Any], start: float, stop: float) -> int:
    if "step" in ends:
        step = as_finite(ends["step"])
        if not step or (stop - start) / step < 0:
            raise invalid_value(ends["step"], "a step that leads from start to stop")
        n = math.floor((stop - start) / step + _STEP_SLACK) + 1 if (stop - start) / step < MAX_CAPTURES else 0
    else:
        n = ends["n"] if isinstance(ends["n"], int) and not isinstance(ends["n"], bool) else 0
    if not 1 <= n <= MAX_CAPTURES:
        raise invalid_value(ends.get("n", ends.get("step")), f"1 to {MAX_CAPTURES} values")
    return n


def _range(kind: str, start: float, stop: float, n: int) -> tuple[float | int, ...]:
    """Return ``n`` values from start to stop, both included; integers where all are whole and evenly spaced."""
    shares = [i / max(n - 1, 1) for i in range(n)]
    if kind == "log_range":
        return tuple(start * (stop / start) ** share for share in shares)
    values = [start + (stop - start) * share for share in shares]
    return tuple(int(value) for value in values) if all(value.is_integer() for value in values) else tuple(values)


def _one_key(**properties: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a mapping with one of some keys."""
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "minProperties": 1,
        "maxProperties": 1,
    }


_LIST = {"type": "array", "minItems": 1}
_RANGE = {"type": "object", "required": ["start", "stop"], "additionalProperties": {"type": "number"}}
Values = Annotated[
    tuple[Any, ...], Checked(_swept_values, {"anyOf": [_LIST, _one_key(range=_RANGE, log_range=_RANGE)]})
]
RandomDraw = Annotated[Any, Checked(draw_of, {"type": ["object", "array"]}, with_context=True)]
DrawCount = Annotated[int, integer(f"an integer from 1 to {MAX_CAPTURES}", 1, MAX_CAPTURES)]


class RandomSweep(Section):
    """Seeded random draws."""

    count: DrawCount
    """draws of every key"""
    seed: Seed = 0
    """start of the draws; they do not depend on count or on other keys"""
    keys: Annotated[dict[str, RandomDraw], MAPPING]
    """dotted key: {uniform: [a, b]}, {log_uniform: [a, b]}, {integers: [a, b]}, {choice: [...]}, {files: "*.obj", pick:
    random or each}, {rotation: uniform or three [a, b]}, {inside: three [a, b]}; or a value with draws in it"""


class SweepConfig(Section):
    """Many captures from one file: which keys take which values."""

    mode: Annotated[Literal["product", "zip"], ONE_OF] = "product"
    """product: every combination, with every random draw; zip: first values together, second values together, ..."""
    keys: Annotated[dict[str, Values], MAPPING] = Field(default_factory=dict)
    """dotted key: a list of values, or {range: {start: 0.5, stop: 1.5, n: 5}} (or step; ends included), or log_range"""
    random: RandomSweep | None = None
    """further keys, at random"""

    def rule_something_is_swept(self) -> Iterator[ValidationIssue]:
        """There are values, or draws."""
        if self.random is None and not self.keys and not self.has_unknown_keys:
            yield ValidationIssue((), "sweeps nothing, need values in keys, or draws in random.keys.", "key")
        if self.random is not None and not self.random.keys:
            yield ValidationIssue(("random", "keys"), "draws nothing, need at least one key.", "key")

    def rule_one_way_for_a_key(self) -> Iterator[ValidationIssue]:
        """A key is swept or drawn."""
        for key in sorted(set(self.keys) & set(self.random.keys if self.random else ())):
            yield ValidationIssue(("random", "keys", key), "stands in keys too; keep one of the two.", "key")

    def rule_lengths(self) -> Iterator[ValidationIssue]:
        """There are as many values as the mode takes."""
        lengths = self._lengths
        if self.mode == "zip" and len(set(lengths.values())) > 1:
            listed = ", ".join(f"{key}: {n}" for key, n in lengths.items())
            yield ValidationIssue(("mode",), f"zip takes as many values of every key, got {listed}.")
        n_captures = math.prod(lengths.values()) if self.mode == "product" else max(lengths.values(), default=0)
        if n_captures > MAX_CAPTURES:
            message = mismatch(n_captures, f"at most {MAX_CAPTURES} captures in all")
            yield ValidationIssue(("keys",), message, "key")

    @property
    def _lengths(self) -> dict[str, int]:
        """Number of values of every key, and of the draws."""
        lengths = {key: len(values) for key, values in self.keys.items()}
        return lengths | ({"random.count": self.random.count} if self.random and self.random.keys else {})
