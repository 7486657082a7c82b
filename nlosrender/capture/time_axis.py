"""The time axis: bins of optical path length, and how many of them a scene can fill."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.view_arrivals import MARGIN_INTERACTIONS, latest_view
from nlosrender.errors import ConfigError, Problem
from nlosrender.scene.hidden_geometry import Bounds, box_corners, joined_bounds
from nlosrender.scene.pose import Float64
from nlosrender.scene.relay_wall import RelayWall

if TYPE_CHECKING:
    from nlosrender.config.capture import TimeAxisConfig

AUTO_BINS_MULTIPLE = 32
AUTO_BINS_LIMIT = 65536
MARGIN_BOUNCES = 2  # bounces above the third that "n_bins: auto" makes room for


@dataclass(frozen=True)
class TimeAxis:
    """Bins of optical path length (OPL): bin i covers [start + i * width, start + (i + 1) * width).

    Parameters
    ----------
    start_opl
        OPL at the start of bin 0 [m].
    bin_width_opl
        Width of a bin [m], > 0.
    n_bins
        Number of bins, >= 1.

    Raises
    ------
    ValueError
        A number is not finite or out of range.
    """

    start_opl: float
    bin_width_opl: float
    n_bins: int

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

    def edges(self) -> Float64:
        """Return the edges of the bins, (n_bins + 1,) [m]."""
        # start + i * width, not a running sum: the last of 4096 edges must be as exact as the first
        return self.start_opl + np.arange(self.n_bins + 1, dtype=np.float64) * self.bin_width_opl

    def centres(self) -> Float64:
        """Return the centres of the bins, (n_bins,) [m]."""
        return self.start_opl + (np.arange(self.n_bins, dtype=np.float64) + 0.5) * self.bin_width_opl

    def bin_of(self, opl: ArrayLike) -> NDArray[np.int64]:
        """Return the bin of each OPL [m], in agreement with ``edges`` to the last bit.

        Light outside the window is not clamped in: it gets a negative number or one >= n_bins.

        Raises
        ------
        ValueError
            An OPL is not finite.
        """
        opl = np.asarray(opl, dtype=np.float64)
        if not np.all(np.isfinite(opl)):
            raise ValueError("bin_of: an optical path length is not finite")
        index = np.floor((opl - self.start_opl) / self.bin_width_opl)
        # The quotient may round across an edge: compare with the edges themselves.
        index = np.where(opl < self.start_opl + index * self.bin_width_opl, index - 1, index)
        index = np.where(opl >= self.start_opl + (index + 1) * self.bin_width_opl, index + 1, index)
        return index.astype(np.int64)


def resolve_time_axis(
    time_axis_config: TimeAxisConfig,
    capture: Capture,
    wall: RelayWall,
    hidden_bounds: Bounds | None,
    max_bounces: int | None,
) -> TimeAxis:
    """Return the time axis, with ``n_bins: auto`` resolved to bins enough for the latest light expected.

    That is the latest possible third bounce (``latest_arrival``), and up to two bounces above it if they are asked
    for; later light falls out of the window and is reported by the engines. Rounded up to a multiple of 32.

    Parameters
    ----------
    time_axis_config
        ``time_axis``.
    capture
        Grids and legs.
    wall
        The relay wall.
    hidden_bounds
        Box around all hidden geometry in the local frame [m]; None when there is none.
    max_bounces
        Highest bounce computed; None for no limit.

    Raises
    ------
    ConfigError
        More than 65536 bins would be needed.
    """
    start, width = float(time_axis_config.start_opl), float(time_axis_config.bin_width_opl)
    if time_axis_config.n_bins != "auto":
        return TimeAxis(start, width, int(time_axis_config.n_bins))
    latest = latest_arrival(capture, wall, hidden_bounds, max_bounces)
    # + 1: an arrival exactly on an edge belongs to the bin after it
    needed = max(np.floor((latest - start) / width) + 1, 1)
    rounded = np.ceil(needed / AUTO_BINS_MULTIPLE) * AUTO_BINS_MULTIPLE
    if rounded > AUTO_BINS_LIMIT:
        message = (
            f"auto would need {rounded:.0f} bins of {width:g} m to reach the latest light at {latest:.4g} m, and "
            f"stops at {AUTO_BINS_LIMIT}. Give n_bins as an integer, a larger bin_width_opl "
            f"(from {(latest - start) / AUTO_BINS_LIMIT:.2g} m), or a later start_opl."
        )
        raise ConfigError(Problem("", "time_axis.n_bins", message))
    return TimeAxis(start, width, int(rounded))


def latest_arrival(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, max_bounces: int | None) -> float:
    """Return a bound on the optical path length of the light a capture is expected to hold [m].

    The third bounce leg + |x_l - c| + |c - x_s| + leg is convex in c: over a box it is largest at a corner. Further
    bounces go from c to some c': each adds at most the diameter of all that reflects, for up to two of them. Light can
    come to a curved wall from the wall itself, so that the wall is part of the box then. No light arrives from a
    planar wall without hidden geometry: the longest legs are returned. A camera waits for four interactions at most.

    Parameters
    ----------
    capture, wall, hidden_bounds, max_bounces
        As in ``resolve_time_axis``.
    """
    if capture.is_line_of_sight:
        most = MARGIN_INTERACTIONS if max_bounces is None else min(max_bounces, MARGIN_INTERACTIONS)
        return latest_view(capture, hidden_bounds, most)
    wall_box = wall.bounds()
    reflecting = hidden_bounds if wall.is_planar else joined_bounds([hidden_bounds, wall_box])
    spot = 2 * capture.laser_spot_radius  # a point of the spot is up to one radius farther from both of its neighbours
    if reflecting is None:
        return float(capture.laser_legs.max() + capture.sensor_legs.max()) + spot
    corners = box_corners(reflecting)
    laser_opl = _opl_to(corners, capture.laser_grid, capture.laser_legs)
    sensor_opl = _opl_to(corners, capture.sensor_grid, capture.sensor_legs)
    extra = MARGIN_BOUNCES if max_bounces is None else min(max(max_bounces - THIRD_BOUNCE, 0), MARGIN_BOUNCES)
    if capture.scan_type == "confocal":
        third = (laser_opl + sensor_opl).max()
        further = (laser_opl.max(axis=0) + sensor_opl.max(axis=0)).max()  # same point, but c and c' differ
    else:
        third = (laser_opl.max(axis=1) + sensor_opl.max(axis=1)).max()  # same corner, any two points
        further = laser_opl.max() + sensor_opl.max()
    if not extra:
        return float(third) + spot
    everything = joined_bounds([reflecting, wall_box]) or reflecting
    return float(further + extra * np.linalg.norm(everything[1] - everything[0])) + spot


def _opl_to(corners: Float64, grid: PointGrid, legs: Float64) -> Float64:
    """Return leg + distance between every corner and every point of the grid, (8, points) [m]."""
    points = grid.positions.reshape(-1, 3)
    return np.linalg.norm(corners[:, None] - points[None], axis=-1) + legs.reshape(-1)
