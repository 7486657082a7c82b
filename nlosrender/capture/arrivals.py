"""When light can arrive: bounds on the optical path length from boxes, and what they say about a time window."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.time_axis import TimeAxis, latest_arrival
from nlosrender.capture.view_arrivals import earliest_view, latest_view
from nlosrender.scene.hidden_geometry import Bounds, box_corners
from nlosrender.scene.pose import Float64
from nlosrender.scene.relay_wall import RelayWall

SAMPLED_POINTS = 32  # per grid; the share of the window that light fills hardly differs between neighbours


def earliest_arrival(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None) -> float:
    """Return a lower bound on the optical path length of any light of a capture [m]; inf when none can arrive.

    A path to the hidden geometry is at least as long as the distance to its box. On a curved wall light also goes
    straight from wall to wall, in no less than the legs.
    """
    if capture.is_line_of_sight:
        return earliest_view(capture, hidden_bounds)
    laser_legs, sensor_legs = capture.laser_legs.reshape(-1), capture.sensor_legs.reshape(-1)
    if not wall.is_planar:
        opl = laser_legs + sensor_legs if capture.scan_type == "confocal" else laser_legs.min() + sensor_legs.min()
        return float(np.min(opl)) - 2 * capture.laser_spot_radius
    if hidden_bounds is None:
        return math.inf
    to_laser = laser_legs + distance_to_box(_points(capture.laser_grid), hidden_bounds)
    to_sensor = sensor_legs + distance_to_box(_points(capture.sensor_grid), hidden_bounds)
    opl = to_laser + to_sensor if capture.scan_type == "confocal" else to_laser.min() + to_sensor.min()
    return float(np.min(opl)) - 2 * capture.laser_spot_radius


def latest_of_bounce(capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, bounce: int | None) -> float:
    """Return an upper bound on the optical path length of one bounce [m]; inf for None, a render without limit.

    Above the fourth bounce each one adds at most the diameter of everything, which is what the fifth adds.
    """
    if bounce is None:
        return math.inf
    if capture.is_line_of_sight:
        return latest_view(capture, hidden_bounds, bounce)
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
    no_light = wall.is_planar and hidden_bounds is None
    shares = []
    for slot in range(bounces.n_slots):
        bounce = slot + bounces.first if bounces.split else bounces.max_bounces
        if bounces.split and slot == bounces.n_slots - 1:
            bounce = bounces.max_bounces  # the last slot also holds what comes after it
        straight = wall.is_planar and bounces.first == FIRST_BOUNCE and bounce == FIRST_BOUNCE
        shares.append(0.0 if no_light or straight else _filled_share(capture, wall, hidden_bounds, time_axis, bounce))
    return tuple(shares)


def window_warnings(
    capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, time_axis: TimeAxis, max_bounces: int | None
) -> Iterator[str]:
    """Yield what is pointless about a time window that the light of the scene misses."""
    if wall.is_planar and hidden_bounds is None:
        return
    first = earliest_arrival(capture, wall, hidden_bounds)
    if time_axis.end_opl <= first:
        yield (
            f"time_axis: the window ends at {time_axis.end_opl:.6g} m, before the first light can arrive at "
            f"{first:.6g} m: H is zero. Use n_bins: auto, or more or wider bins."
        )
        return
    last = latest_of_bounce(capture, wall, hidden_bounds, max_bounces)
    third = math.inf if capture.is_line_of_sight else latest_arrival(capture, wall, hidden_bounds, THIRD_BOUNCE)
    if time_axis.start_opl > last:
        yield (
            f"time_axis: the window starts at {time_axis.start_opl:.6g} m, after the last light can arrive at "
            f"{last:.6g} m: H is zero. Use an earlier start_opl."
        )
    elif time_axis.start_opl > third:
        yield (
            f"time_axis: the window starts at {time_axis.start_opl:.6g} m, after the last of the third bounce at "
            f"{third:.6g} m: only later bounces can be in it."
        )


def _filled_share(
    capture: Capture, wall: RelayWall, hidden_bounds: Bounds | None, time_axis: TimeAxis, bounce: int | None
) -> float:
    start, end = time_axis.start_opl, time_axis.end_opl
    walls_third = bounce == THIRD_BOUNCE and wall.is_planar and not capture.is_line_of_sight
    if walls_third and hidden_bounds is not None:
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
    for grid, legs in ((capture.laser_grid, capture.laser_legs), (capture.sensor_grid, capture.sensor_legs)):
        index = sampled_indices(grid)
        points, leg = _points(grid)[index], legs.reshape(-1)[index]
        nearest.append(leg + distance_to_box(points, hidden_bounds))
        farthest.append(leg + np.linalg.norm(corners[:, None] - points[None], axis=-1))
    if capture.scan_type == "confocal":
        return nearest[0] + nearest[1], (farthest[0] + farthest[1]).max(axis=0)
    return nearest[0][:, None] + nearest[1], (farthest[0][:, :, None] + farthest[1][:, None]).max(axis=0)


def sampled_indices(grid: PointGrid) -> NDArray[np.int64]:
    """Return flat indices of at most ``SAMPLED_POINTS`` points spread over a grid."""
    count = grid.ny * grid.nx
    # golden ratio: an even stride could run down one column of the grid
    return np.unique((np.arange(SAMPLED_POINTS) * 0.618033988749895 % 1 * count).astype(np.int64))


def _points(grid: PointGrid) -> Float64:
    return grid.positions.reshape(-1, 3)


def distance_to_box(points: Float64, box: Bounds) -> Float64:
    """Return the distance of points (n, 3) to a box, (n,), 0 inside; all in one unit."""
    return np.linalg.norm(np.maximum(np.maximum(box[0] - points, points - box[1]), 0), axis=-1)
