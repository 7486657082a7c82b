"""Random draws of a sweep: numbers, choices, files of a folder, rotations, places; alone or anywhere inside a value.

A draw depends on the seed, its key and its number alone: a longer sweep, or one of more keys, begins with the same.
"""

from __future__ import annotations

import glob
import math
import random
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo

from nlosrender.config.fields import finite_numbers
from nlosrender.config.issues import invalid_value
from nlosrender.config.plugin_check import config_folder
from nlosrender.errors import ConfigError

ENDS, SPANS = ("uniform", "log_uniform", "integers"), ("rotation", "inside")  # [a, b]; one [a, b] per axis
KINDS = (*ENDS, "choice", "files", *SPANS)
_DRAW = (
    "one of {uniform: [a, b]}, {log_uniform: [a, b]}, {integers: [a, b]}, {choice: [...]}, {files: 'folder/*.obj'}, "
    "{rotation: uniform}, {inside: [[x0, x1], [y0, y1], [z0, z1]]}, or a value with these in it"
)
PICKS = ("random", "each")
COPY = "#"  # before the number of a further copy of an item


@dataclass(frozen=True)
class Draw:
    """A distribution of one key, or of a part of its value.

    Parameters
    ----------
    kind
        One of ``KINDS``; ``integers`` include both ends.
    among
        The two ends, what is chosen from, or three pairs of ends, of x, y and z; of ``rotation`` empty for a uniform
        one over all rotations.
    each
        ``files``: one after the other instead of at random.
    """

    kind: str
    among: tuple[Any, ...]
    each: bool = False

    def value(self, key: str, seed: int, number: int) -> Any:
        """Return the ``number``-th draw for ``key``."""
        stream = random.Random(f"{seed} {key} {number}")  # of text: the same on every machine and version
        share = stream.random()
        if self.kind in ("choice", "files"):
            return self.among[number % len(self.among) if self.each else int(share * len(self.among))]
        if self.kind in SPANS:
            shares = (share, stream.random(), stream.random())
            if not self.among:
                # Haar measure in angles about x, then y, then z: the middle one has the density cos(y) / 2
                x, y, z = shares
                return [360 * x - 180, math.degrees(math.asin(2 * y - 1)), 360 * z - 180]
            return [low + part * (high - low) for part, (low, high) in zip(shares, self.among, strict=True)]
        low, high = self.among
        if self.kind == "integers":
            return low + int(share * (high - low + 1))
        if self.kind == "log_uniform":
            return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        return low + share * (high - low)


@dataclass(frozen=True)
class Drawn:
    """One value that was drawn: of which key, and by what."""

    key: str
    value: Any
    draw: Draw


def draw_of(value: object, validation: ValidationInfo) -> Any:
    """Return a value of ``random.keys`` with a ``Draw`` in place of each mapping that describes one.

    Raises
    ------
    InvalidValue
        There is no draw in it, or a mistake in one.
    """
    folder = config_folder(validation)
    found = _with_draws(value, folder)
    if not _has_draws(found):
        raise invalid_value(value, _DRAW)
    return found


@dataclass
class Drawer:
    """Draws the values of one capture, and notes them.

    Parameters
    ----------
    suffix
        Added to a key, so that further copies of an item get draws of their own.
    lead
        Key and value of the first file of the capture, once it is drawn.
    goes_with
        Whether a further file may stand beside the first one; None: any.
    """

    suffix: Callable[[str], str] = lambda key: ""
    lead: tuple[str, str] | None = None
    goes_with: Callable[[str, str], bool] | None = None
    drawn: list[Drawn] = field(default_factory=list)

    def value(self, tree: Any, key: str, seed: int, number: int) -> Any:
        """Return a value of ``draw_of`` for a key with everything drawn; the draws are added to ``drawn``.

        Of a chosen mapping with draws in it all values are added.

        Raises
        ------
        ConfigError
            No file may stand beside the first one.
        """
        if isinstance(tree, Draw):
            draw = self._allowed(tree, key)
            value = draw.value(key + self.suffix(key), seed, number)
            if _has_draws(value):  # a choice between items that have draws of their own
                return {name: self._part(item, f"{key}.{name}", seed, number, draw) for name, item in value.items()}
            if draw.kind == "files":
                self.lead = self.lead or (key, value)
            self.drawn.append(Drawn(key, value, draw))
            return value
        if isinstance(tree, dict):
            return {name: self.value(item, f"{key}.{name}", seed, number) for name, item in tree.items()}
        if isinstance(tree, list):
            return [self.value(item, f"{key}.{at}", seed, number) for at, item in enumerate(tree)]
        return tree

    def _part(self, item: Any, key: str, seed: int, number: int, chosen_by: Draw) -> Any:
        if _has_draws(item):
            return self.value(item, key, seed, number)
        self.drawn.append(Drawn(key, item, chosen_by))
        return item

    def _allowed(self, draw: Draw, key: str) -> Draw:
        if draw.kind != "files" or self.lead is None or self.goes_with is None:
            return draw
        first = self.lead[1]
        if key == self.lead[0] and not self.suffix(key).startswith(COPY):  # the first file itself, once more
            return draw
        among = tuple(name for name in draw.among if self.goes_with(name, first))
        if not among:
            raise ConfigError.at(key, f"has no file that is in one split with {first}. Use more files, or by: capture.")
        return replace(draw, among=among)


def _has_draws(tree: Any) -> bool:
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return isinstance(tree, Draw) or any(map(_has_draws, parts))


def _with_draws(value: Any, folder: Path) -> Any:
    if isinstance(value, Mapping):
        names = set(value)
        if names == {"files"} or names == {"files", "pick"}:
            return _files(value, folder)
        if len(names) == 1 and next(iter(names)) in KINDS:
            ((kind, among),) = value.items()
            return _draw(kind, among, folder)
        return {name: _with_draws(item, folder) for name, item in value.items()}
    return [_with_draws(item, folder) for item in value] if isinstance(value, list) else value


def _draw(kind: str, among: Any, folder: Path) -> Draw:
    if kind == "choice":
        if not isinstance(among, list) or not among:
            raise invalid_value(among, "a list of values to choose from")
        options = tuple(_with_draws(item, folder) for item in among)
        for item in options:
            if _has_draws(item) and not isinstance(item, dict):
                raise invalid_value(among, "values, or mappings with draws in them")
        return Draw(kind, options)
    if kind in SPANS:
        return _spans(kind, among)
    ends = finite_numbers(among, 2)
    above = 0.0 if kind == "log_uniform" else -math.inf
    whole = kind != "integers" or (ends and all(isinstance(end, int) for end in among))
    if ends is None or not whole or not above < ends[0] <= ends[1]:
        need = {"integers": "two integers", "log_uniform": "two numbers > 0"}.get(kind, "two numbers")
        raise invalid_value(among, f"{need} [a, b] with a <= b")
    return Draw(kind, tuple(among) if kind == "integers" else tuple(ends))


def _spans(kind: str, among: Any) -> Draw:
    if kind == "rotation" and among == "uniform":
        return Draw(kind, ())
    spans = [finite_numbers(span, 2) for span in among] if isinstance(among, list) else []
    if len(spans) != 3 or any(span is None or span[0] > span[1] for span in spans):
        need = "three pairs [a, b] with a <= b, of x, y and z" + (", or uniform" if kind == "rotation" else "")
        raise invalid_value(among, need)
    return Draw(kind, tuple(tuple(span) for span in spans if span is not None))


def _files(value: Mapping[str, Any], folder: Path) -> Draw:
    patterns, pick = value["files"], value.get("pick", "random")
    if pick not in PICKS:
        raise invalid_value(pick, "random or each")
    listed = patterns if isinstance(patterns, list) else [patterns]
    if not listed or not all(isinstance(pattern, str) and pattern.strip() for pattern in listed):
        raise invalid_value(patterns, "a pattern such as 'bikes/**/*.obj', or a list of them")
    found = sorted({name for pattern in listed for name in _matches(pattern, folder)})
    if not found:
        raise invalid_value(patterns, f"a pattern that some file matches; none in {folder} does")
    return Draw("files", tuple(found), pick == "each")


def _matches(pattern: str, folder: Path) -> Iterator[str]:
    with suppress(ValueError, OSError):  # a zero byte, half of a character: no file has such a name
        for name in glob.iglob(pattern, root_dir=folder, recursive=True):
            if (folder / name).is_file():
                yield Path(name).as_posix()
