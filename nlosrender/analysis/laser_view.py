"""The light of one laser point, reduced while it is read: memory stays bounded however large the capture is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.stored_header import intensity

Float64 = NDArray[np.float64]

FRAME_SHARES = (0.02, 0.2, 0.45, 0.7, 0.95)  # of the light that has arrived at the moments shown
WINDOW_SHARES = (0.0005, 0.9995)  # of it at the ends of the part of the time axis that is worth showing
BAND_BYTES = 64 * 2**20  # of samples read at a time
MAX_ROW_BYTES = 2**30
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


def laser_view(capture: StoredCapture, laser: tuple[int, int]) -> LaserView:
    """Sum the light of one laser point over the wall, the bounces and time.

    Raises
    ------
    FileError
        The laser point does not exist, a sample is not finite, or the file is damaged or too large for a picture.
    """
    _check_size(capture)
    sizes = capture.header.sizes
    wall = np.zeros(capture.header.sensor_grid)
    bounces, time = np.zeros(len(capture.header.bounce_indices)), np.zeros(sizes["bin"])
    # emitters seen directly would outshine all they light: they count among the bounces only
    first = 1 if capture.header.first_bounce == 0 and len(bounces) > 1 else 0
    for rows, band in _bands(capture, laser):
        wall[rows] = band[first:].sum(axis=(0, 3))
        bounces += band.sum(axis=(1, 2, 3))
        time += band[first:].sum(axis=(0, 1, 2))
    return LaserView(laser, wall, bounces, time)


def wall_frames(capture: StoredCapture, laser: tuple[int, int], windows: Sequence[slice]) -> Float64:
    """Return (window, Ny, Nx) light on the wall, summed over bounces and the bins of each window.

    Raises
    ------
    FileError
        The laser point does not exist, or the file is damaged.
    """
    frames = np.zeros((len(windows), *capture.header.sensor_grid))
    for rows, band in _bands(capture, laser):
        for frame, window in zip(frames, windows, strict=True):
            frame[rows] = band[..., window].sum(axis=(0, 3))
    return frames


def point_histograms(
    capture: StoredCapture, laser: tuple[int, int], pixel: tuple[int, int], dataset: str = "data"
) -> Float64:
    """Return (bounce, bin) of one sensor point, colour averaged.

    Raises
    ------
    FileError
        One of the points does not exist, or the file is damaged.
    """
    block = capture.read_block(lasers=laser, sensors=pixel, dataset=dataset)
    return intensity(capture.header, block[:, :, 0, 0, 0, 0].astype(np.float64))


def row_over_time(capture: StoredCapture, laser: tuple[int, int], row: int) -> Float64:
    """Return (Nx, bin) of one row of sensor points, summed over bounces and colour averaged.

    Raises
    ------
    FileError
        The row or the laser point does not exist, or the file is damaged.
    """
    block = capture.read_block(lasers=laser, sensors=(row, None))
    return intensity(capture.header, block[:, :, 0, 0, 0].astype(np.float64)).sum(axis=0)


def frame_bins(time: Float64) -> list[int]:
    """Return the bins at which given shares of all light in ``time`` (bin,) have arrived; fewer when they coincide."""
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


def _bands(capture: StoredCapture, laser: tuple[int, int]) -> Iterator[tuple[slice, Float64]]:
    """Yield (bounce, rows, Nx, bin) for a few rows at a time, colour averaged."""
    n_rows = capture.header.sensor_grid[0]
    step = max(BAND_BYTES // _row_bytes(capture), 1)
    chunks = dict(zip(capture.header.axes, capture.header.chunks or (), strict=False))
    if chunks.get("sensor_y", step + 1) <= step:
        step -= step % chunks["sensor_y"]  # whole chunks, or each would be unpacked twice
    for start in range(0, n_rows, step):
        rows = slice(start, min(start + step, n_rows))
        block = capture.read_block(lasers=laser, sensors=(rows, None))
        if not np.isfinite(block).all():
            raise FileError(f"{capture.path}: data holds numbers that are not finite; see `nlosrender info --check`")
        yield rows, intensity(capture.header, block[:, :, 0, 0].astype(np.float64))


def _row_bytes(capture: StoredCapture) -> int:
    sizes, header = capture.header.sizes, capture.header
    # float32 as read and float64 as summed
    return 12 * sizes["channel"] * len(header.bounce_indices) * sizes["sensor_x"] * sizes["bin"]


def _check_size(capture: StoredCapture) -> None:
    row = _row_bytes(capture)
    if row > MAX_ROW_BYTES or row * capture.header.sensor_grid[0] > MAX_LASER_BYTES:
        raise FileError(
            f"{capture.path}: too large for a picture: data has shape {capture.header.data_shape}. "
            "Check the file with `nlosrender info`."
        )
