"""Whether two captures measure the same thing, so that their samples can be compared one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlosrender.errors import FileError
from nlosrender.files.reader import StoredCapture
from nlosrender.files.stored_header import StoredHeader

POSITION_TOLERANCE = 1e-5  # of the largest coordinate: float32 leaves 6e-8, other writers' arithmetic some more
WIDTH_TOLERANCE = 1e-6  # relative; a float32 deltaT is off by 6e-8
START_TOLERANCE = 1e-3  # bins
# attributes that change what a sample means; files by other writers may lack them, and then say nothing
MEANINGS = ("frame", "account_first_and_last_bounces", "channels", "split_bounces")


@dataclass(frozen=True)
class StructureDifference:
    """One property in which two captures differ, in words."""

    name: str
    value: str
    reference: str

    def __str__(self) -> str:
        return f"{self.name}: {self.value}, the reference has {self.reference}"


def structure_differences(capture: StoredCapture, reference: StoredCapture) -> tuple[StructureDifference, ...]:
    """Return every property that keeps two captures from being compared sample by sample.

    Raises
    ------
    FileError
        A file is damaged.
    """
    found = list(_header_differences(capture.header, reference.header))
    if not found:  # grids of different sizes have been named already
        found += _grid_differences(capture, reference)
    return tuple(found)


def _header_differences(a: StoredHeader, b: StoredHeader) -> Iterator[StructureDifference]:
    if a.scan_type != b.scan_type:
        yield StructureDifference("scan type", a.scan_type, b.scan_type)
    names = {"channel": "channels", "bin": "bins", "sensor": "sensor points", "laser": "laser points"}
    sizes = [_lengths(header) for header in (a, b)]
    for axis, name in names.items():
        if sizes[0][axis] != sizes[1][axis]:
            yield StructureDifference(name, sizes[0][axis], sizes[1][axis])
    if a.sizes["bounce"] != b.sizes["bounce"]:
        yield StructureDifference("bounce axis", str(a.sizes["bounce"]), str(b.sizes["bounce"]))
    if abs(a.bin_width_opl - b.bin_width_opl) > WIDTH_TOLERANCE * b.bin_width_opl:
        yield StructureDifference("bin width", f"{a.bin_width_opl:.9g} m", f"{b.bin_width_opl:.9g} m")
    if abs(a.start_opl - b.start_opl) > START_TOLERANCE * b.bin_width_opl:
        yield StructureDifference("start of bin 0", f"{a.start_opl:.9g} m", f"{b.start_opl:.9g} m")
    for name in MEANINGS:
        values = [header.attributes.get(name) for header in (a, b)]
        if None not in values and values[0] != values[1]:
            yield StructureDifference(name, str(values[0]), str(values[1]))


def _lengths(header: StoredHeader) -> dict[str, str]:
    rows, columns = header.sensor_grid
    laser_rows, laser_columns = header.laser_grid
    return {
        "channel": str(header.sizes["channel"]),
        "bin": str(header.n_bins),
        "sensor": f"{columns} x {rows}",
        "laser": f"{laser_columns} x {laser_rows}",
    }


def _grid_differences(a: StoredCapture, b: StoredCapture) -> Iterator[StructureDifference]:
    """Compare where laser, sensor and their points are; what one of the files does not say is passed over."""
    for name in ("sensor_position", "laser_position"):
        points = [getattr(capture.header, name) for capture in (a, b)]
        if None not in points and _apart(np.array(points[0]), np.array(points[1])):
            yield StructureDifference(name.replace("_", " "), _shown(points[0]), _shown(points[1]))
    try:
        grids = [capture.positions for capture in (a, b)]
    except FileError:  # samples mean something without positions too: other writers leave them out
        return
    for name in ("sensor_positions", "sensor_normals", "laser_positions", "laser_normals"):
        first, second = (getattr(grid, name) for grid in grids)
        if _apart(first, second):
            row, column = np.unravel_index(int(np.argmax(np.abs(first - second).max(axis=-1))), first.shape[:2])
            where = f"{name.replace('_', ' ')} (worst at row {row}, column {column})"
            yield StructureDifference(where, _shown(first[row, column]), _shown(second[row, column]))


def _apart(a: np.ndarray, b: np.ndarray) -> bool:
    if a.shape != b.shape:
        return True
    largest = max(float(np.abs(b).max()), np.finfo(np.float64).tiny)
    return not bool((np.abs(a - b) <= POSITION_TOLERANCE * largest).all())  # a NaN is apart from everything


def _shown(point: np.ndarray | tuple[float, ...]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in point)})"
