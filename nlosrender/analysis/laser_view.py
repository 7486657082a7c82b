"""The light of one laser point, reduced while it is read: memory stays bounded however large the capture is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import index

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError, OptionError
from nlosrender.files.layout import STOKES
from nlosrender.files.reading.reader import BAND_BYTES, StoredCapture
from nlosrender.files.reading.scan import moved, wall_frame
from nlosrender.files.reading.stored_header import intensity

Float64 = NDArray[np.float64]
Point = tuple[int, int]  # row, column

FRAME_SHARES = (0.02, 0.2, 0.45, 0.7, 0.95)  # of the light that has arrived at the moments shown
WINDOW_SHARES = (0.0005, 0.9995)  # of it at the ends of the part of the time axis that is worth showing
DOTTED, DOT = 96, 4  # pixels of the side of a picture of listed points, and of each of them
MAX_ROW_BYTES = 2**30  # of one row of sensor points, which is read at once
MAX_LASER_BYTES = 2**36  # minutes of reading; beyond it a file is more likely damaged than meant


@dataclass(frozen=True, eq=False)
class LaserView:
    """Sums of H over one laser's samples, colour averaged."""

    laser: tuple[int, int]
    wall: Float64  # (Ny, Nx) over bounces and time
    bounces: Float64  # (bounce,) over the wall and time
    time: Float64  # (bin,) over the wall and bounces

    @property
    def brightest(self) -> tuple[int, int]:
        """Row and column of the sensor point that receives most light."""
        row, column = np.unravel_index(int(np.argmax(self.wall)), self.wall.shape)
        return int(row), int(column)


def check_point(option: str, point: Point | None, rows: int, columns: int) -> Point | None:
    """Return a (row, column) as plain integers, None as it is.

    Raises
    ------
    OptionError
        It is no such pair, or the grid does not have it; ``option`` is named.
    """
    if point is None:
        return None
    try:
        row, column = map(index, point)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{option}: got {point!r}, need two integers: row, column") from error
    if not (0 <= row < rows and 0 <= column < columns):
        need = f"a row from 0 to {rows - 1} and a column from 0 to {columns - 1}"
        raise OptionError(f"{option}: got {row},{column}, need {need}")
    return row, column


def laser_view(capture: StoredCapture, laser: tuple[int, int], band_bytes: int = BAND_BYTES) -> LaserView:
    """Sum the light of one laser point over the wall, the bounces and time.

    Raises
    ------
    FileError
        The laser point does not exist, a sample is not finite, or the file is damaged or too large for a picture.
    """
    header, sizes = capture.header, capture.header.sizes
    # float32 as read and float64 as summed
    row_bytes = 12 * sizes["channel"] * len(header.bounce_indices) * sizes["sensor_x"] * sizes["bin"]
    if row_bytes > MAX_ROW_BYTES or row_bytes * sizes["sensor_y"] > MAX_LASER_BYTES:
        raise FileError(
            f"{capture.path}: too large for a picture: data has shape {header.data_shape}. "
            "Check the file with `nlosrender info`."
        )
    wall = np.zeros(header.sensor_grid)
    bounces, time = np.zeros(len(header.bounce_indices)), np.zeros(sizes["bin"])
    # emitters seen directly would outshine all they light: they count among the bounces only
    first = 1 if header.first_bounce == 0 and len(bounces) > 1 else 0
    for rows, samples in capture.bands(laser, band_bytes=band_bytes):
        band = intensity(header, samples.astype(np.float64))
        wall[rows] = band[first:].sum(axis=(0, 3))
        bounces += band.sum(axis=(1, 2, 3))
        time += band[first:].sum(axis=(0, 1, 2))
    return LaserView(laser, wall, bounces, time)


def wall_frames(
    capture: StoredCapture, laser: tuple[int, int], windows: Sequence[slice], band_bytes: int = BAND_BYTES
) -> Float64:
    """Return (window, Ny, Nx) light on the wall, summed over bounces and the bins of each window.

    Raises
    ------
    FileError
        The laser point does not exist, or the file is damaged.
    """
    frames = np.zeros((len(windows), *capture.header.sensor_grid))
    for rows, samples in capture.bands(laser, band_bytes=band_bytes):
        band = intensity(capture.header, samples.astype(np.float64))
        for frame, window in zip(frames, windows, strict=True):
            frame[rows] = band[..., window].sum(axis=(0, 3))
    return frames


def point_histograms(capture: StoredCapture, laser: tuple[int, int], pixel: tuple[int, int]) -> Float64:
    """Return (bounce, bin) of one sensor point, colour averaged.

    Raises
    ------
    FileError
        One of the points does not exist, or the file is damaged.
    """
    block = capture.read_block(lasers=laser, sensors=pixel)
    return intensity(capture.header, block[:, :, 0, 0, 0, 0].astype(np.float64))


def laser_energies(capture: StoredCapture, laser: tuple[int, ...]) -> Float64:
    """Return the sums over the samples of one laser point (bounce,); colours add up, of Stokes components the first.

    Raises
    ------
    FileError
        The file is damaged.
    """
    header = capture.header
    channels = 1 if header.attributes.get("channels") == STOKES else header.sizes["channel"]
    total = np.zeros(len(header.bounce_indices))
    for _, band in capture.bands((laser[0], laser[1])):
        total += band[:channels].sum(axis=(0, 2, 3, 4), dtype=np.float64)
    return total


def row_over_time(capture: StoredCapture, laser: tuple[int, int], row: int) -> Float64:
    """Return (Nx, bin) of one row of sensor points, summed over bounces and colour averaged.

    Raises
    ------
    FileError
        The row or the laser point does not exist, or the file is damaged.
    """
    block = capture.read_block(lasers=laser, sensors=(row, None))
    return intensity(capture.header, block[:, :, 0, 0, 0].astype(np.float64)).sum(axis=0)


def list_on_wall(capture: StoredCapture) -> Float64 | None:
    """Return where the points of a list are on the wall, x and y (points, 2) [m]; None for a grid."""
    if not capture.header.is_list():
        return None
    return np.asarray(moved(capture.positions.sensor_positions[0], wall_frame(capture.header))[:, :2])


def dotted(points: Float64 | None, values: Float64, empty: float = np.nan) -> Float64:
    """Return values of a list (1, points, ...) as dots on a square (rows, columns, ...), the last on top.

    Rows ascend in wall y, columns in x, as of a grid, for which ``points`` are None and ``values`` are returned.
    """
    if points is None:
        return values
    picture = np.full((DOTTED, DOTTED, *values.shape[2:]), empty)
    extent = max(float(np.ptp(points, axis=0).max()), 1e-9)
    places = ((points - points.min(axis=0)) / extent * (DOTTED - DOT)).astype(int)
    for (x, y), value in zip(places, values[0], strict=True):
        picture[y : y + DOT, x : x + DOT] = value
    return picture


@dataclass(frozen=True, eq=False)
class Moments:
    """The wall at the bins of ``frame_bins``, and a few bins around each where there are very many."""

    light: Float64  # (moment, Ny, Nx)
    opl: Float64  # (moment,) m, in the middle
    n_bins: int  # that are summed, away from the ends of the time axis


def moments(capture: StoredCapture, view: LaserView) -> Moments:
    """Return the wall at a few moments of a laser point; errors as of ``wall_frames``."""
    first, last = lit_window(view.time)
    half = (last - first) // 400  # a single bin is mostly noise where bins are many
    bins = frame_bins(view.time)
    light = wall_frames(capture, view.laser, [slice(max(index - half, 0), index + half + 1) for index in bins])
    return Moments(light, capture.header.bin_centres()[bins], 2 * half + 1)


def frame_bins(time: Float64) -> list[int]:
    """Return the bins at which ``FRAME_SHARES`` of the light in ``time`` (bin,) have arrived, each once."""
    return sorted({_bin_of_share(time, share) for share in FRAME_SHARES})


def lit_window(time: Float64) -> tuple[int, int]:
    """Return the first and last bin of the part of ``time`` (bin,) that holds the light, with some margin."""
    if not (time > 0).any():
        return 0, len(time) - 1
    first, last = (_bin_of_share(time, share) for share in WINDOW_SHARES)
    margin = max((last - first) // 12, 2)
    return max(first - margin, 0), min(last + margin, len(time) - 1)


def _bin_of_share(time: Float64, share: float) -> int:
    arrived = np.cumsum(np.maximum(time, 0))  # measured captures may dip below zero
    if arrived[-1] == 0:
        return len(time) // 2
    return int(min(np.searchsorted(arrived, share * arrived[-1]), len(time) - 1))
