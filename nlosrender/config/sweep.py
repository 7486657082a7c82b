"""``sweep``: many captures from one file. What may be written there; ``sweep_load`` makes configs of it."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

from nlosrender.config.fields import Checked, Seed, as_finite
from nlosrender.config.refusal import Fault, refusal, refuse
from nlosrender.config.section import Section

MAX_CAPTURES = 100_000  # of one sweep; beyond it a range is a slip of the pen
_STEP_SLACK = 1e-9  # of a step: 0.1 * 3 is not 0.3

_VALUES = "a list of values, {range: {start: 0.5, stop: 1.5, n: 5}} or log_range alike"
_DRAW = "one of {uniform: [a, b]}, {log_uniform: [a, b]}, {integers: [a, b]}, {choice: [...]}"


@dataclass(frozen=True)
class Draw:
    """A distribution of one key.

    Parameters
    ----------
    kind
        ``uniform``, ``log_uniform``, ``integers`` (both ends included) or ``choice``.
    among
        The two ends, or what is chosen from.
    """

    kind: str
    among: tuple[Any, ...]

    def value(self, key: str, seed: int, number: int) -> Any:
        """Return the ``number``-th draw for ``key``; it depends on these and the seed alone.

        So a sweep can be made longer, or get further keys, without changing what has been rendered.
        """
        share = random.Random(f"{seed} {key} {number}").random()  # of text: the same on every machine and version
        low, high = self.among[0], self.among[-1]
        if self.kind == "choice":
            return self.among[int(share * len(self.among))]
        if self.kind == "integers":
            return low + int(share * (high - low + 1))
        if self.kind == "log_uniform":
            return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        return low + share * (high - low)


def _swept_values(value: object) -> tuple[Any, ...]:
    if isinstance(value, list) and value:
        return tuple(value)
    if not isinstance(value, Mapping) or len(value) != 1 or next(iter(value)) not in ("range", "log_range"):
        raise refuse(value, _VALUES)
    kind, ends = next(iter(value.items()))
    steps = ("n",) if kind == "log_range" else ("n", "step")
    if not isinstance(ends, Mapping) or set(ends) not in [{"start", "stop", step} for step in steps]:
        raise refuse(ends, f"start, stop and {' or '.join(steps)}")
    start, stop = as_finite(ends["start"]), as_finite(ends["stop"])
    if start is None or stop is None or (kind == "log_range" and min(start, stop) <= 0):
        raise refuse(ends["stop" if start is not None else "start"], f"a number{' > 0' * (kind == 'log_range')}")
    n = _number_of_values(ends, start, stop)
    last = start + (n - 1) * float(ends["step"]) if "step" in ends else stop
    return _range(kind, start, last, n)


def _number_of_values(ends: Mapping[str, Any], start: float, stop: float) -> int:
    if "step" in ends:
        step = as_finite(ends["step"])
        if not step or (stop - start) / step < 0:
            raise refuse(ends["step"], "a step that leads from start to stop")
        n = math.floor((stop - start) / step + _STEP_SLACK) + 1 if (stop - start) / step < MAX_CAPTURES else 0
    else:
        n = ends["n"] if isinstance(ends["n"], int) and not isinstance(ends["n"], bool) else 0
    if not 1 <= n <= MAX_CAPTURES:
        raise refuse(ends.get("n", ends.get("step")), f"1 to {MAX_CAPTURES} values")
    return n


def _range(kind: str, start: float, stop: float, n: int) -> tuple[float | int, ...]:
    """Return ``n`` values from start to stop, both included; integers where all are whole and evenly spaced."""
    shares = [i / max(n - 1, 1) for i in range(n)]
    if kind == "log_range":
        return tuple(start * (stop / start) ** share for share in shares)
    values = [start + (stop - start) * share for share in shares]
    return tuple(int(value) for value in values) if all(value.is_integer() for value in values) else tuple(values)


def _draw(value: object) -> Draw:
    kinds = ("uniform", "log_uniform", "integers", "choice")
    if not isinstance(value, Mapping) or len(value) != 1 or next(iter(value)) not in kinds:
        raise refuse(value, _DRAW)
    kind, among = next(iter(value.items()))
    if kind == "choice":
        if not isinstance(among, list) or not among:
            raise refuse(among, "a list of values to choose from")
        return Draw(kind, tuple(among))
    ends = [as_finite(end) for end in among] if isinstance(among, list) else []
    numbers = [end for end in ends if end is not None]
    whole = kind != "integers" or all(isinstance(end, int) for end in among)
    least = 0.0 if kind == "log_uniform" else -math.inf
    if len(ends) != 2 or len(numbers) != 2 or not whole or not least < numbers[0] <= numbers[1]:
        need = {"integers": "two integers", "log_uniform": "two numbers > 0"}.get(kind, "two numbers")
        raise refuse(among, f"{need} [a, b] with a <= b")
    return Draw(kind, tuple(among) if kind == "integers" else tuple(numbers))


_RANGE_SCHEMA = {"type": "object", "required": ["start", "stop"], "additionalProperties": {"type": "number"}}
_ENDS_SCHEMA = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
Values = Annotated[
    tuple[Any, ...],
    Checked(
        _swept_values,
        {
            "anyOf": [
                {"type": "array", "minItems": 1},
                {
                    "type": "object",
                    "properties": {"range": _RANGE_SCHEMA, "log_range": _RANGE_SCHEMA},
                    "additionalProperties": False,
                    "minProperties": 1,
                    "maxProperties": 1,
                },
            ]
        },
    ),
]
RandomDraw = Annotated[
    Draw,
    Checked(
        _draw,
        {
            "type": "object",
            "properties": {
                "uniform": _ENDS_SCHEMA,
                "log_uniform": _ENDS_SCHEMA,
                "integers": _ENDS_SCHEMA,
                "choice": {"type": "array", "minItems": 1},
            },
            "additionalProperties": False,
            "minProperties": 1,
            "maxProperties": 1,
        },
    ),
]


def _count(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_CAPTURES:
        raise refuse(value, f"an integer from 1 to {MAX_CAPTURES}")
    return value


DrawCount = Annotated[int, Checked(_count, {"type": "integer", "minimum": 1, "maximum": MAX_CAPTURES})]


class RandomSweep(Section):
    """Seeded random draws."""

    count: DrawCount
    """draws of every key"""
    seed: Seed = 0
    """start of the draws; they do not depend on count or on other keys"""
    keys: dict[str, RandomDraw]
    """dotted key: {uniform: [a, b]}, {log_uniform: [a, b]}, {integers: [a, b]} or {choice: [...]}"""


class SweepConfig(Section):
    """Many captures from one file: which keys take which values."""

    mode: Literal["product", "zip"] = "product"
    """product: every combination, with every random draw; zip: first values together, second values together, ..."""
    keys: dict[str, Values] = Field(default_factory=dict)
    """dotted key: a list of values, or {range: {start: 0.5, stop: 1.5, n: 5}} (or step; ends included), or log_range"""
    random: RandomSweep | None = None
    """further keys, at random"""

    def rules(self) -> Iterator[Fault]:
        """Yield what is wrong between the keys."""
        drawn = self.random.keys if self.random else {}
        if not self.keys and self.random is None:
            yield Fault((), "sweeps nothing, need values in keys, or draws in random.keys.", "key")
        if self.random and not drawn:
            yield Fault(("random", "keys"), "draws nothing, need at least one key.", "key")
        for key in sorted(set(self.keys) & set(drawn)):
            yield Fault(("random", "keys", key), "stands in keys too; keep one of the two.", "key")
        lengths = {key: len(values) for key, values in self.keys.items()}
        if self.random and drawn:
            lengths["random.count"] = self.random.count
        if self.mode == "zip" and len(set(lengths.values())) > 1:
            listed = ", ".join(f"{key}: {n}" for key, n in lengths.items())
            yield Fault(("mode",), f"zip takes as many values of every key, got {listed}.")
        if self.n_captures > MAX_CAPTURES:
            yield Fault(("keys",), refusal(self.n_captures, f"at most {MAX_CAPTURES} captures in all"), "key")

    @property
    def n_captures(self) -> int:
        """Number of captures."""
        lengths = [len(values) for values in self.keys.values()]
        if self.random and self.random.keys:
            lengths.append(self.random.count)
        return math.prod(lengths) if self.mode == "product" else max(lengths, default=0)
