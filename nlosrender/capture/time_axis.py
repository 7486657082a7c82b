"""The time axis: bins of optical path length (OPL)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import ConfigError

if TYPE_CHECKING:
    from nlosrender.config.capture import TimeAxisConfig

AUTO_BINS_MULTIPLE = 32  # a choice: small changes of a scene then keep the length of its files
MAX_AUTO_BINS = 65536  # 197 m in bins of 3 mm; more is a mistaken unit, and 0.5 MB of sums per pair


@dataclass(frozen=True)
class TimeAxis:
    """Bins of optical path length: bin i covers [start_opl + i * width, start_opl + (i + 1) * width).

    Raises
    ------
    ValueError
        A number is not finite or out of range.
    """

    start_opl: float  # m
    bin_width_opl: float  # m, > 0
    n_bins: int  # >= 1

    def __post_init__(self) -> None:
        if not np.isfinite(self.start_opl):
            raise ValueError(f"start_opl: got {self.start_opl!r}, need a finite number [m]")
        if not (np.isfinite(self.bin_width_opl) and self.bin_width_opl > 0):
            raise ValueError(f"bin_width_opl: got {self.bin_width_opl!r}, need a finite number > 0 [m]")
        if self.n_bins < 1:
            raise ValueError(f"n_bins: got {self.n_bins!r}, need an integer >= 1")

    @property
    def end_opl(self) -> float:
        """OPL at the end of the last bin [m]."""
        return self.start_opl + self.n_bins * self.bin_width_opl


def bin_centres(start_opl: float, bin_width_opl: float, n_bins: int) -> NDArray[np.float64]:
    """Return the optical path length in the middle of every bin, (bin,) [m]."""
    middles: NDArray[np.float64] = np.arange(n_bins, dtype=np.float64) + 0.5
    return start_opl + middles * bin_width_opl


def resolve_time_axis(time_axis_config: TimeAxisConfig, latest_opl: float) -> TimeAxis:
    """Return the time axis of a configuration; ``n_bins: auto`` reaches ``latest_opl`` [m] (``latest_arrival``).

    Light after it falls out of the window and is reported by the engines.

    Raises
    ------
    ConfigError
        ``auto`` would take more than 65536 bins.
    """
    start, width = float(time_axis_config.start_opl), float(time_axis_config.bin_width_opl)
    if time_axis_config.n_bins != "auto":
        return TimeAxis(start, width, int(time_axis_config.n_bins))
    # + 1: an arrival exactly on an edge belongs to the bin after it
    needed = max(np.floor((latest_opl - start) / width) + 1, 1)
    rounded = np.ceil(needed / AUTO_BINS_MULTIPLE) * AUTO_BINS_MULTIPLE
    if rounded > MAX_AUTO_BINS:
        message = (
            f"auto would need {rounded:.0f} bins of {width:g} m to reach the latest light at {latest_opl:.4g} m, and "
            f"stops at {MAX_AUTO_BINS}. Give n_bins as an integer, a larger bin_width_opl "
            f"(from {(latest_opl - start) / MAX_AUTO_BINS:.2g} m), or a later start_opl."
        )
        raise ConfigError.at("time_axis.n_bins", message)
    return TimeAxis(start, width, int(rounded))
