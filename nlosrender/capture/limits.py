"""Captures that no machine could hold, refused by arithmetic alone: before anything is allocated for them."""

from __future__ import annotations

from nlosrender.capture.plan import BYTES_OF_STATISTICS, BYTES_PER_SUM
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.config.capture import CaptureConfig
from nlosrender.errors import ConfigError

# about 80 float64 per grid point: position, normal, wall coordinates and their copies (16), leg (1), and the difference
# to eight corners of a box, its squares and their sums (56)
POINT_BYTES = 640
MAX_SAMPLES = 2**40  # 4 TiB of float32 per bounce
MAX_BATCHES = 1_000_000  # at 0.1 s each more than a day
MAX_INT32 = 2**31 - 1  # the file holds the number of bins as a 32-bit integer


def refuse_impossible_grids(capture_config: CaptureConfig, memory_limit: int) -> None:
    """Raise ConfigError for grids or pixels whose positions alone take more than ``memory_limit`` bytes."""
    points, sensors = _words(capture_config)
    lasers = "capture.laser_grid" if capture_config.laser_points is None else "capture.laser_points"
    for key, grid, count in (
        (sensors, capture_config.sensor_grid, capture_config.n_sensors),
        (lasers, capture_config.laser_grid, capture_config.n_lasers),
    ):
        if count * POINT_BYTES > memory_limit:
            shape = f"{count}" if grid is None else f"{grid.nx} x {grid.ny}"
            message = (
                f"{shape} {points} take {count * POINT_BYTES / 1e9:.3g} GB for their positions "
                f"alone, but there are {memory_limit / 1e9:.3g} GB. Use fewer {points}."
            )
            raise ConfigError.at(key, message)


def refuse_wide_kernel(kernel_opl: float, time_axis: TimeAxis) -> None:
    """Raise ConfigError for a temporal kernel of full width ``kernel_opl`` [m] wider than the time window.

    It would carry most light out of the window, and its work grows with its width in bins.
    """
    window = time_axis.end_opl - time_axis.start_opl
    if kernel_opl > window:
        message = (
            f"got {kernel_opl:g} m, wider than the time axis, {window:g} m; need a few bins, or 0 for a histogram."
        )
        raise ConfigError.at("render.temporal_kernel_opl", message)


def refuse_impossible_samples(
    capture_config: CaptureConfig, *, rows_per_pair: int, n_bins: int, memory_limit: int
) -> None:
    """Refuse a capture with more samples or batches than can be dealt with; ``n_bins: auto`` is resolved by now.

    Parameters
    ----------
    capture_config
        ``capture``.
    rows_per_pair, n_bins
        Histogram rows per (sensor, laser), which are bounce slots times channels; bins per row.
    memory_limit
        Bytes a batch may take.

    Raises
    ------
    ConfigError
        The capture is too large; the message says what to change.
    """
    points, sensors = _words(capture_config)
    pairs = capture_config.n_sensors * capture_config.n_lasers
    smallest = pairs * rows_per_pair * (n_bins + 1) * (2 * BYTES_PER_SUM + BYTES_OF_STATISTICS)
    if n_bins > MAX_INT32:
        key, message = "time_axis.n_bins", f"got {n_bins}, need at most {MAX_INT32}. Use wider bins or a later start."
    elif pairs * n_bins > MAX_SAMPLES:
        counted = points if capture_config.is_line_of_sight else "pairs of laser and sensor points"
        message = f"{pairs:_} {counted} with {n_bins:_} bins each are more than 2**40 samples. "
        key, message = sensors, f"{message}Use fewer {points} or bins."
    elif smallest > MAX_BATCHES * memory_limit:
        key, message = (
            sensors,
            (
                f"the capture takes {smallest / 1e12:.3g} TB in all, more than {MAX_BATCHES:_} batches of the "
                f"{memory_limit / 1e6:.0f} MB that render.memory_limit leaves. Raise it, or use fewer {points} or bins."
            ),
        )
    else:
        return
    raise ConfigError.at(key, message)


def _words(capture_config: CaptureConfig) -> tuple[str, str]:
    """Return what sensor points are called, and the key that sets their number."""
    if capture_config.is_line_of_sight or capture_config.camera is not None:
        return "pixels", "capture.camera"
    return "points", f"capture.{capture_config.sensor_key}"
