"""A capture's points and light in the order of the wall's own coordinates, its time counted from the wall.

Files by other writers may begin at the top left, or run along columns. Formats without positions fix the order: they
are written from here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nlosrender.files.layout import Float64
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.scan import BAND_BYTES, Float32, Scan, read_light

SAME = 1e-3  # difference of two lengths over the larger one, or over a grid's extent, that counts as none


@dataclass(frozen=True, eq=False)
class GridOrder:
    """How to take a stored grid (rows, columns) to one whose rows differ in wall y and whose columns differ in x."""

    rows: NDArray[np.intp]  # of each sorted row its place in the stored grid, of its columns when transposed
    columns: NDArray[np.intp]
    transposed: bool = False

    def sorted(self, stored: NDArray[np.float64]) -> Float64:
        """Return an array (rows, columns, ...) of the stored grid in the new order."""
        turned = stored.swapaxes(0, 1) if self.transposed else stored
        return turned[self.rows][:, self.columns]

    def stored_at(self, row: int, column: int) -> tuple[int, int]:
        """Return the stored place of a point of the sorted grid."""
        place = int(self.rows[row]), int(self.columns[column])
        return place[::-1] if self.transposed else place


@dataclass(frozen=True, eq=False)
class OrderedCapture:
    """A capture seen from its wall, with both grids in the order of wall coordinates."""

    capture: StoredCapture
    scan: Scan  # points and legs, in that order
    bounces: tuple[int, ...]  # indices on the file's bounce axis that are summed
    sensor_order: GridOrder
    laser_order: GridOrder
    is_grid: bool  # whether the sensor points lie along the wall's axes; if not, they are in the order of the file

    def bands(self, laser: tuple[int, int] = (0, 0), multiple: int = 1) -> Iterator[tuple[slice, Float32]]:
        """Yield (rows, (row, Nx, bin)): the light of one laser point, a few rows of sensor points at a time.

        Parameters
        ----------
        laser
            (row, column) of the sorted grid; (0, 0) for a confocal capture.
        multiple
            The number of rows is a multiple of it, but for the last.

        Raises
        ------
        FileError
            The file is damaged, or holds a number that is not finite.
        """
        header = self.capture.header
        stored_laser = (0, 0) if self.scan.confocal else self.laser_order.stored_at(*laser)
        n_rows, n_columns = self.scan.sensors.shape[:2]
        row_bytes = 4 * header.sizes["channel"] * len(self.bounces) * n_columns * self.scan.n_bins
        step = int(max(BAND_BYTES // row_bytes, 1))
        step = max(step - step % multiple, 1)
        for start in range(0, n_rows, step):
            rows = slice(start, min(start + step, n_rows))
            yield rows, self._rows(stored_laser, self.sensor_order.rows[rows])

    def _rows(self, laser: tuple[int, int], places: NDArray[np.intp]) -> Float32:
        first, last = int(places.min()), int(places.max()) + 1
        if last - first != len(places):  # scattered over the file: one by one
            return np.concatenate([self._rows(laser, places[index : index + 1]) for index in range(len(places))])
        part = slice(first, last)
        order = self.sensor_order
        rows, columns = (None, part) if order.transposed else (part, None)
        light = read_light(self.capture, laser, rows, columns, self.bounces)
        if order.transposed:
            light = light.swapaxes(0, 1)
        return light[places - first][:, order.columns]


def ordered_capture(
    capture: StoredCapture, scan: Scan, bounces: tuple[int, ...], *, x_descends: bool = False, y_descends: bool = False
) -> OrderedCapture:
    """Return a capture in the order of wall coordinates: rows along y, columns along x, both ascending by default."""

    def order(name: str, points: Float64) -> GridOrder | None:
        listed = capture.header.is_list(name)
        return None if listed else grid_order(points, x_descends=x_descends, y_descends=y_descends)

    sensors = order("sensor", scan.sensors)
    lasers = sensors if scan.confocal else order("laser", scan.lasers)
    laser_order = lasers or _as_stored(scan.lasers)
    sensor_order = sensors or _as_stored(scan.sensors)
    ordered = replace(
        scan,
        sensors=sensor_order.sorted(scan.sensors),
        lasers=laser_order.sorted(scan.lasers),
        sensor_legs=sensor_order.sorted(scan.sensor_legs),
        laser_legs=laser_order.sorted(scan.laser_legs),
    )
    return OrderedCapture(capture, ordered, bounces, sensor_order, laser_order, sensors is not None)


def grid_order(points: Float64, *, x_descends: bool = False, y_descends: bool = False) -> GridOrder | None:
    """Return how to sort points (rows, columns, 3) [m] by y and x; None when they are no grid along these axes."""
    largest = max(float(np.ptp(points[..., 0])), float(np.ptp(points[..., 1])))
    for transposed in (False, True):
        turned = points.swapaxes(0, 1) if transposed else points
        x, y = turned[..., 0], turned[..., 1]
        if max(np.ptp(y, axis=1).max(), np.ptp(x, axis=0).max()) <= SAME * largest:
            rows, columns = y.mean(axis=1), x.mean(axis=0)
            return GridOrder(
                np.argsort(-rows if y_descends else rows, kind="stable"),
                np.argsort(-columns if x_descends else columns, kind="stable"),
                transposed,
            )
    return None


def _as_stored(points: Float64) -> GridOrder:
    rows, columns = points.shape[:2]
    return GridOrder(np.arange(rows), np.arange(columns))


@dataclass(frozen=True, eq=False)
class Rectification:
    """How far the histograms of a capture are moved, so that bin 0 is the moment at which light is at the wall.

    Each bin is shared by the two that it covers: energy is kept, and light before 0 is not expected on a plane.
    """

    shift: Float64  # bins, (Ny, Nx) of the sensor points: from start and sensor leg
    laser_shift: Float64  # bins, (Ly, Lx); added to it. Zero for a confocal capture, whose two legs are in ``shift``
    n_bins: int  # as many as reach the last light of the whole capture

    @property
    def is_identity(self) -> bool:
        """Whether nothing moves."""
        return not self.shift.any() and not self.laser_shift.any()

    def apply(self, light: Float32, rows: slice, laser: tuple[int, int] = (0, 0)) -> Float32:
        """Return (row, Nx, n_bins): histograms (row, Nx, bin) of some rows of sensor points, moved."""
        if self.is_identity:
            return light
        shift = self.shift[rows] + self.laser_shift[laser]
        whole = np.floor(shift).astype(int)
        later = (shift - whole).astype(np.float32)[..., None]
        moved = np.zeros((*light.shape[:2], self.n_bins), dtype=np.float32)
        for row, column in np.ndindex(*light.shape[:2]):
            if not light[row, column].any():
                continue
            for share, start in ((1 - later, whole), (later, whole + 1)):
                first = int(start[row, column])
                part = light[row, column, max(-first, 0) :] * share[row, column]
                begin = max(first, 0)
                length = max(min(len(part), self.n_bins - begin), 0)
                moved[row, column, begin : begin + length] += part[:length]
        return moved


def rectification(scan: Scan) -> Rectification:
    """Return how to count the time of a capture from the wall."""
    if scan.confocal:
        shift, laser_shift = scan.start_opl - (scan.sensor_legs + scan.laser_legs), np.zeros((1, 1))
    elif scan.laser_legs.size == 1:
        shift, laser_shift = scan.start_opl - (scan.sensor_legs + scan.laser_legs[0, 0]), np.zeros((1, 1))
    else:
        shift, laser_shift = scan.start_opl - scan.sensor_legs, -scan.laser_legs
    in_bins, laser_in_bins = shift / scan.bin_width_opl, laser_shift / scan.bin_width_opl
    latest = in_bins.max() + laser_in_bins.max()
    moves = bool(in_bins.any() or laser_in_bins.any())
    n_bins = max(scan.n_bins + int(np.floor(latest)) + 1, 1) if moves else scan.n_bins
    return Rectification(in_bins, laser_in_bins, n_bins)
