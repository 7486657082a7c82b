"""Whether two captures measure the same thing, so that their samples can be compared one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlosrender.analysis.comparison.alignment import START_TOLERANCE, Alignment, apart
from nlosrender.errors import FileError
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.stored_header import StoredHeader

WIDTH_TOLERANCE = 1e-6  # relative; a float32 deltaT is off by 6e-8
# attributes that change what a sample means; files by other writers may lack them
MEANINGS = (
    "frame",
    "account_first_and_last_bounces",
    "channels",
    "split_bounces",
    "footprint",
    "laser_spots",
    "laser_flash",
)


@dataclass(frozen=True)
class StructureDifference:
    """One property in which two captures differ, in words."""

    name: str
    value: str
    reference: str

    def __str__(self) -> str:
        return f"{self.name}: {self.value}, the reference has {self.reference}"


def structure_differences(
    capture: StoredCapture, reference: StoredCapture, alignment: Alignment
) -> tuple[StructureDifference, ...]:
    """Return every property that keeps two captures from being compared sample by sample once they are aligned.

    Raises
    ------
    FileError
        A file is damaged.
    """
    found = list(_header_differences(capture.header, reference.header, alignment))
    if not found:  # grids of different sizes have been named already
        found += _grid_differences(capture, reference, alignment)
    return tuple(found)


def _header_differences(a: StoredHeader, b: StoredHeader, alignment: Alignment) -> Iterator[StructureDifference]:
    moved_in_time = bool(alignment.lead or alignment.reference_lead)
    same_axis = a.sizes["bounce"] == b.sizes["bounce"]
    pairs: dict[str, tuple[object, ...]] = {
        "scan type": (a.scan_type, b.scan_type),
        "channels": (a.sizes["channel"], b.sizes["channel"]),
        "samples": tuple("counts" if header.is_measured else "light" for header in (a, b)),
        "bins": (b.n_bins if moved_in_time else a.n_bins, b.n_bins),
        "sensor points": (_size(alignment.sensors.turned_shape, a.is_list()), _size(b.sensor_grid, b.is_list())),
        "laser points": (
            _size(alignment.lasers.turned_shape, a.is_list("laser")),
            _size(b.laser_grid, b.is_list("laser")),
        ),
        "bounce axis": (a.sizes["bounce"], b.sizes["bounce"]),
        "bounce of index 0": (a.first_bounce if same_axis else b.first_bounce, b.first_bounce),
    }
    yield from (StructureDifference(name, str(x), str(y)) for name, (x, y) in pairs.items() if x != y)
    if abs(a.bin_width_opl - b.bin_width_opl) > WIDTH_TOLERANCE * b.bin_width_opl:
        yield StructureDifference("bin width", f"{a.bin_width_opl:.9g} m", f"{b.bin_width_opl:.9g} m")
    if not moved_in_time and abs(a.start_opl - b.start_opl) > START_TOLERANCE * b.bin_width_opl:
        yield StructureDifference("start of bin 0", f"{a.start_opl:.9g} m", f"{b.start_opl:.9g} m")
    for name in MEANINGS:
        values = [header.attributes.get(name) for header in (a, b)]
        if None not in values and values[0] != values[1]:
            yield StructureDifference(name, str(values[0]), str(values[1]))


def _size(grid: tuple[int, int], is_list: bool) -> str:
    return f"{max(grid)} listed" if is_list else f"{grid[1]} x {grid[0]}"


def _grid_differences(a: StoredCapture, b: StoredCapture, alignment: Alignment) -> Iterator[StructureDifference]:
    """Compare where laser, sensor and their points are, as far as both files have them."""
    for name in ("sensor_position", "laser_position"):
        points = [getattr(capture.header, name) for capture in (a, b)]
        if None not in points and apart(np.array(points[0]), np.array(points[1])):
            yield StructureDifference(name.replace("_", " "), _shown(points[0]), _shown(points[1]))
    try:
        grids = [capture.positions for capture in (a, b)]
    except FileError:  # samples mean something without positions too: other writers leave them out
        return
    for name in ("sensor_positions", "sensor_normals", "laser_positions", "laser_normals"):
        stored, second = (getattr(grid, name) for grid in grids)
        if stored is None or second is None:
            continue
        first = (alignment.sensors if name.startswith("sensor") else alignment.lasers).turned(stored)
        if apart(first, second):
            row, column = np.unravel_index(int(np.argmax(np.abs(first - second).max(axis=-1))), first.shape[:2])
            where = f"{name.replace('_', ' ')} (worst at row {row}, column {column})"
            yield StructureDifference(where, _shown(first[row, column]), _shown(second[row, column]))


def _shown(point: np.ndarray | tuple[float, ...]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in point)})"
