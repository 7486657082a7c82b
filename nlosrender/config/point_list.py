"""Lists of points on the relay wall: ``capture.sensor_points`` and ``capture.laser_points``.

A list stands in the YAML, or in a .csv or .npy file that it names. Mistakes are told with the line they stand in.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ValidationInfo

from nlosrender.config.fields import MAX_LENGTH, Checked, finite_numbers
from nlosrender.config.frozen import FrozenDict
from nlosrender.config.issues import InvalidValue, invalid_value, mismatch, shown
from nlosrender.config.plugin_check import config_folder, existing_file
from nlosrender.errors import KeyPath, ValidationIssue

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SUFFIXES = (".csv", ".npy")
MAX_POINTS = 2**24  # 4096 x 4096, beyond any scan
MAX_TOLD = 5  # mistakes of one file; more are alike
_XY = "2 finite numbers, x and y on the wall [m]"
_HEADER = "Remove a line of names, or begin it with #."


class PointList:
    """Points (n, 2) in wall coordinates [m] and where each of them is written.

    Raises
    ------
    InvalidValue
        There are none, or too many, one is no point, or one stands there twice.
    """

    def __init__(self, rows: Sequence[object], places: Sequence[str] | None = None):
        import numpy as np  # only where there is a list: validate is quick without it

        self._places = places  # of a file: "points.csv:3"; None: the YAML's own items
        numbers = [finite_numbers(row, 2) for row in rows]
        wrong = [index for index, xy in enumerate(numbers) if xy is None or max(map(abs, xy)) > MAX_LENGTH]
        if wrong or not rows:
            need = f"{_XY}, up to {MAX_LENGTH:g}"
            self._refuse((index, mismatch(rows[index], need, self._advice(rows, index))) for index in wrong)
            raise invalid_value([], "at least one point [x, y]")
        self.xy: NDArray[np.float64] = np.array(numbers, dtype=np.float64)
        self.xy.setflags(write=False)
        _, first, inverse = np.unique(self.xy, axis=0, return_index=True, return_inverse=True)
        twin = first[inverse.ravel()]
        self._refuse(
            (
                int(at),
                f"got {shown(self.xy[at].tolist())} a second time, first in {self.place(int(twin[at]))}; remove one.",
            )
            for at in np.flatnonzero(twin != np.arange(len(twin)))
        )

    def __len__(self) -> int:
        return len(self.xy)

    def place(self, index: int) -> str:
        """Return where a point is written."""
        return f"item {index}" if self._places is None else self._places[index]

    def issue(self, index: int, message: str) -> ValidationIssue:
        """Return the mistake of one point; its path starts at the list."""
        if self._places is None:
            return ValidationIssue((index,), message)
        return ValidationIssue(("file",), f"{self._places[index]}: {message}")

    def _advice(self, rows: Sequence[object], index: int) -> str:
        row = rows[index]
        is_text = isinstance(row, (list, tuple)) and any(isinstance(item, str) for item in row)
        return _HEADER if self._places is not None and is_text and index == 0 else ""

    def _refuse(self, wrong: Iterator[tuple[int, str]]) -> None:
        issues = [self.issue(index, message) for index, message in wrong]
        if issues:
            left = len(issues) - MAX_TOLD
            more = [ValidationIssue(issues[0].path, f"{left} more points are wrong.")] if left > 0 else []
            raise InvalidValue(*issues[:MAX_TOLD], *more)


def point_list(value: Sequence[object] | Mapping[str, Any]) -> PointList:
    """Return the points of ``sensor_points`` or ``laser_points``, a file's read again only where it has changed.

    Raises
    ------
    InvalidValue
        As ``PointList``, or the file cannot be read.
    """
    if not isinstance(value, Mapping):
        return PointList(value)
    path = Path(value["file"])
    try:
        status = path.stat()
        return _read(path, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise _of_file(f"{path} cannot be read: {error.strerror or error}.") from error


def off_the_wall(points: PointList, extent: tuple[float, float], tolerance: float) -> Iterator[ValidationIssue]:
    """Yield the first few points off a wall of width and height ``extent`` [m]; paths start at the list."""
    import numpy as np

    half = np.array(extent) / 2
    outside = np.flatnonzero((np.abs(points.xy) > half * (1 + tolerance)).any(axis=1))
    need = f"need x from {-half[0]:.6g} to {half[0]:.6g} m and y from {-half[1]:.6g} to {half[1]:.6g} m."
    for index in outside[:MAX_TOLD].tolist():
        yield points.issue(index, f"got {shown(points.xy[index].tolist())}, off the relay wall; {need}")
    if len(outside) > MAX_TOLD:
        yield points.issue(
            int(outside[MAX_TOLD]), f"this point and {len(outside) - MAX_TOLD - 1} more are off it, too."
        )


def _checked(value: object, validation: ValidationInfo) -> object:
    if isinstance(value, (list, tuple)):
        return tuple((float(x), float(y)) for x, y in PointList(value).xy.tolist())
    if not isinstance(value, Mapping) or set(value) != {"file"}:
        raise invalid_value(value, "a list [[x, y], ...] of points on the wall [m], or {file: points.csv}")
    name = value["file"]
    if not isinstance(name, str) or not name.lower().endswith(SUFFIXES):
        raise _of_file(mismatch(name, "the name of a .csv or .npy file"))
    path, problem = existing_file(name, config_folder(validation))
    if problem:
        raise _of_file(problem)
    named = FrozenDict({"file": str(path)})
    point_list(named)
    return named


def _of_file(message: str) -> InvalidValue:
    path: KeyPath = ("file",)
    return InvalidValue(ValidationIssue(path, message))


@lru_cache(maxsize=16)
def _read(path: Path, changed: int, size: int) -> PointList:
    rows, places = _array_rows(path) if path.suffix.lower() == ".npy" else _text_rows(path)
    if not rows:
        raise _of_file(f"{path} holds no points, need at least one line x,y.")
    return PointList(rows, places)


def _array_rows(path: Path) -> tuple[list[Any], list[str]]:
    import numpy as np

    try:
        array = np.load(path, allow_pickle=False, mmap_mode="r")
    except (ValueError, EOFError) as error:
        raise _of_file(f"{path} is no array of numbers in NumPy's format.") from error
    is_array = isinstance(array, np.ndarray)
    if not is_array or array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] != 2:
        found = f"{array.dtype} {array.shape}" if is_array else "several arrays"
        raise _of_file(f"{path} holds {found}, need numbers of shape (points, 2), x and y on the wall [m].")
    _refuse_many(path, len(array))
    return array.tolist(), [f"{path.name}, row {row}" for row in range(len(array))]


def _text_rows(path: Path) -> tuple[list[Any], list[str]]:
    """Return the values of each line, numbers where they are, and its place; blank lines and # lines are left out."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise _of_file(f"{path} is no UTF-8 text: {error.reason} at byte {error.start}.") from error
    used = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"]
    _refuse_many(path, len(used))
    rows = [[_number(text) for text in re.split(r"\s*[,;]\s*|\s+", line.strip())] for _, line in used]
    return rows, [f"{path.name}:{number}" for number, _ in used]


def _number(text: str) -> float | str:
    try:
        return float(text) if "_" not in text else text
    except ValueError:
        return text


def _refuse_many(path: Path, count: int) -> None:
    if count > MAX_POINTS:
        raise _of_file(f"{path} holds {count:_} points, need at most {MAX_POINTS:_}.")


_PAIR = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
_FILE = {
    "type": "object",
    "required": ["file"],
    "properties": {"file": {"type": "string", "pattern": r"\.([cC][sS][vV]|[nN][pP][yY])$"}},
    "additionalProperties": False,
}
WallPoints = Annotated[
    tuple[tuple[float, float], ...] | FrozenDict,
    Checked(_checked, {"anyOf": [{"type": "array", "items": _PAIR, "minItems": 1}, _FILE]}, with_context=True),
]
