"""When light can arrive: bounds on the optical path length from boxes, and what they say about a time window."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.scene.bounding_box import Bounds, box_corners, distance_to_box, joined_bounds
from nlosrender.scene.pose import Float64
from nlosrender.scene.walls.wall import RelayWall

SAMPLED_POINTS = 32  # per grid; neighbours fill nearly the same share of the window
# Interactions that "n_bins: auto" makes room for: two bounces above the third, and four for a camera. Each adds at most
# the scene's diameter; later light is reported as outside the window.
MAX_EXTRA_BOUNCES = 2
MAX_VIEW_INTERACTIONS = 4


def earliest_arrival(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None) -> float:
    """Return a lower bound on the optical path length of any light of a capture [m]; inf when none can arrive.

    A path to the hidden geometry is at least as long as the distance to its box. On a curved wall light also goes
    straight from wall to wall, in no less than the legs.
    """
    if hidden_bounds is None and wall.is_planar:
        return math.inf
    if capture.is_line_of_sight and not capture.account_first_and_last_bounces:
        return 0.0
    if capture.is_line_of_sight and hidden_bounds is not None:
        return float(distance_to_box(capture.sensor_position, hidden_bounds))
    laser_opl, sensor_opl = capture.laser_legs.reshape(-1), capture.sensor_legs.reshape(-1)
    if wall.is_planar and hidden_bounds is not None:
        laser_opl = laser_opl + distance_to_box(_points(capture.laser_grid), hidden_bounds)
        sensor_opl = sensor_opl + distance_to_box(_points(capture.sensor_grid), hidden_bounds)
    opl = laser_opl + sensor_opl if capture.scan_type == "confocal" else laser_opl.min() + sensor_opl.min()
    return float(np.min(opl)) - 2 * capture.blur


def latest_arrival(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, max_bounces: int | None) -> float:
    """Return a bound on the optical path length of the light that ``n_bins: auto`` makes room for [m].

    The third bounce leg + |x_l - c| + |c - x_s| + leg is convex in c: over a box it is largest at a corner. Further
    bounces go from c to some c': each adds at most the diameter of all that reflects. The box holds a curved wall,
    too, which can light itself. Without hidden geometry a planar wall receives no light: the longest legs are returned.
    """
    if capture.is_line_of_sight:
        return _latest_view(capture, hidden_bounds, min(_or_inf(max_bounces), MAX_VIEW_INTERACTIONS))
    wall_box = wall.bounds()
    reflecting = hidden_bounds if wall.is_planar else joined_bounds([hidden_bounds, wall_box])
    spot = 2 * capture.blur  # places in a spot or footprint are up to their radius farther from both neighbours
    if reflecting is None:
        return float(capture.laser_legs.max() + capture.sensor_legs.max()) + spot
    corners = box_corners(reflecting)
    laser_opl, sensor_opl = (_opl_to(corners, _points(grid), legs) for grid, legs in _grids(capture))
    if capture.scan_type == "confocal":
        third = (laser_opl + sensor_opl).max()
        further = (laser_opl.max(axis=0) + sensor_opl.max(axis=0)).max()  # one wall point, but c and c' differ
    else:
        third = (laser_opl.max(axis=1) + sensor_opl.max(axis=1)).max()  # one corner, any two wall points
        further = laser_opl.max() + sensor_opl.max()
    extra = min(max(_or_inf(max_bounces) - THIRD_BOUNCE, 0), MAX_EXTRA_BOUNCES)
    if not extra:
        return float(third) + spot
    low, high = joined_bounds([reflecting, wall_box]) or reflecting
    return float(further + extra * np.linalg.norm(high - low)) + spot


def latest_of_bounce(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, bounce: int | None) -> float:
    """Return an upper bound on the optical path length of one bounce [m]; inf for None, a render without limit.

    Above the fourth bounce each one adds at most the diameter of everything, which is what the fifth adds.
    """
    if bounce is None:
        return math.inf
    if capture.is_line_of_sight:
        return _latest_view(capture, hidden_bounds, bounce)
    if bounce <= THIRD_BOUNCE + 1:
        return latest_arrival(capture, wall, hidden_bounds, bounce)
    fourth, fifth = (latest_arrival(capture, wall, hidden_bounds, THIRD_BOUNCE + extra) for extra in (1, 2))
    return fourth + (bounce - THIRD_BOUNCE - 1) * (fifth - fourth)


def filled_shares(
    capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, time_axis: TimeAxis, bounces: BounceAxis
) -> tuple[float, ...]:
    """Return, for each bounce slot, the share of the window's bins between first and last possible arrival.

    The mean over a sample of laser and sensor points; 0 for a slot that stays empty.
    """
    shares = []
    for slot in range(bounces.n_slots):
        is_last = slot == bounces.n_slots - 1  # holds what comes after it, too
        bounce = bounces.max_bounces if is_last or not bounces.split else slot + bounces.first
        is_dark = hidden_bounds is None or (bounces.first == FIRST_BOUNCE and bounce == FIRST_BOUNCE)
        is_dark = is_dark and wall.is_planar
        shares.append(0.0 if is_dark else _filled_share(capture, wall, hidden_bounds, time_axis, bounce))
    return tuple(shares)


def window_warnings(
    capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, time_axis: TimeAxis, max_bounces: int | None
) -> Iterator[str]:
    """Yield a sentence where the light of the scene misses the time window."""
    if wall.is_planar and hidden_bounds is None:
        return
    start, end = time_axis.start_opl, time_axis.end_opl
    first = earliest_arrival(capture, wall, hidden_bounds)
    if end <= first:
        yield (
            f"time_axis: the window ends at {end:.6g} m, before the first light can arrive at {first:.6g} m: H is "
            "zero. Use n_bins: auto, or more or wider bins."
        )
        return
    last = latest_of_bounce(capture, wall, hidden_bounds, max_bounces)
    third = math.inf if capture.is_line_of_sight else latest_arrival(capture, wall, hidden_bounds, THIRD_BOUNCE)
    if start > last:
        yield (
            f"time_axis: the window starts at {start:.6g} m, after the last light can arrive at {last:.6g} m: H is "
            "zero. Use an earlier start_opl."
        )
    elif start > third:
        yield (
            f"time_axis: the window starts at {start:.6g} m, after the last of the third bounce at {third:.6g} m: "
            "only later bounces can be in it."
        )


def sampled_indices(grid: PointGrid) -> NDArray[np.int64]:
    """Return flat indices of at most ``SAMPLED_POINTS`` points spread over a grid."""
    # golden ratio: an even stride could run down one column of the grid
    return np.unique((np.arange(SAMPLED_POINTS) * 0.618033988749895 % 1 * (grid.ny * grid.nx)).astype(np.int64))


def _filled_share(
    capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, time_axis: TimeAxis, bounce: int | None
) -> float:
    start, end = time_axis.start_opl, time_axis.end_opl
    is_third = bounce == THIRD_BOUNCE and wall.is_planar and not capture.is_line_of_sight
    if is_third and hidden_bounds is not None:
        earliest, latest = _third_bounce_spans(capture, hidden_bounds)
    else:
        earliest = np.array([earliest_arrival(capture, wall, hidden_bounds)])
        latest = np.array([latest_of_bounce(capture, wall, hidden_bounds, bounce)])
    inside = np.minimum(latest, end) - np.maximum(earliest, start)
    return float(np.clip(inside / (end - start), 0, 1).mean())


def _third_bounce_spans(capture: Capture, hidden_bounds: Bounds) -> tuple[Float64, Float64]:
    """Return earliest and latest OPL of the third bounce for a sample of pairs [m]."""
    corners = box_corners(hidden_bounds)
    nearest, farthest = [], []
    for grid, legs in _grids(capture):
        index = sampled_indices(grid)
        points, leg = _points(grid)[index], legs.reshape(-1)[index]
        nearest.append(leg + distance_to_box(points, hidden_bounds))
        farthest.append(_opl_to(corners, points, leg))
    if capture.scan_type == "confocal":
        return nearest[0] + nearest[1], (farthest[0] + farthest[1]).max(axis=0)
    return nearest[0][:, None] + nearest[1], (farthest[0][:, :, None] + farthest[1][:, None]).max(axis=0)


def _latest_view(capture: Capture, bounds: Bounds | None, interactions: float) -> float:
    """Return a bound on the optical path length to a camera after a number of surface interactions, in vacuum [m].

    The leg to the camera is at most as long as the way to the farthest corner of the scene's box, every other leg as
    its diagonal. Glass delays light by its refractive index.
    """
    if bounds is None:
        return 0.0
    last = float(np.linalg.norm(box_corners(bounds) - capture.sensor_position, axis=-1).max())
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    return (last if capture.account_first_and_last_bounces else 0.0) + interactions * diagonal


def _grids(capture: Capture) -> tuple[tuple[PointGrid, Float64], ...]:
    return (capture.laser_grid, capture.laser_legs), (capture.sensor_grid, capture.sensor_legs)


def _points(grid: PointGrid) -> Float64:
    return grid.positions.reshape(-1, 3)


def _opl_to(corners: Float64, points: Float64, legs: Float64) -> Float64:
    """Return leg + distance between every corner and every point, (8, points) [m]."""
    return np.linalg.norm(corners[:, None] - points[None], axis=-1) + legs.reshape(-1)


def _or_inf(max_bounces: int | None) -> float:
    return math.inf if max_bounces is None else max_bounces
