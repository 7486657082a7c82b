"""When light can arrive: bounds that hold for every path, and windows that miss the light."""

from __future__ import annotations

import numpy as np
import pytest

from nlosrender.capture.arrivals import earliest_arrival, filled_shares, latest_of_bounce, window_warnings
from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.grids import Capture, point_grid, single_point
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.round_walls import SphereWall
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.5)
BOX = (np.array([-0.4, -0.7, 0.5]), np.array([0.9, 0.2, 1.6]))


def scanned(scan_type: str = "exhaustive", legs: bool = True) -> Capture:
    sensors = point_grid(WALL, 5, 3)
    lasers = {"single": single_point(WALL, (0.3, -0.2)), "confocal": sensors, "exhaustive": point_grid(WALL, 7, 2)}
    return Capture(
        scan_type, sensors, lasers[scan_type], np.array([-0.5, 0, 0.3]), np.array([0.2, 0.1, 1]), legs, 1.0, 0.0
    )


def path_lengths(shot: Capture, n_hidden: int) -> np.ndarray:
    """OPL of random paths laser, x_l, n points of BOX, x_s, sensor."""
    random = np.random.default_rng(7)
    inside = random.uniform(*BOX, (n_hidden, 20_000, 3))
    laser = random.integers(shot.n_lasers, size=20_000)
    sensor = laser if shot.scan_type == "confocal" else random.integers(shot.n_sensors, size=20_000)
    ends = [grid.positions.reshape(-1, 3)[at] for grid, at in ((shot.laser_grid, laser), (shot.sensor_grid, sensor))]
    path = np.concatenate([ends[:1], inside, ends[1:]])
    legs = shot.laser_legs.reshape(-1)[laser] + shot.sensor_legs.reshape(-1)[sensor]
    return np.linalg.norm(np.diff(path, axis=0), axis=-1).sum(axis=0) + legs


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("legs", [True, False])
def test_no_path_arrives_before_the_earliest_or_after_the_latest_bound(scan_type, legs):
    """The bounds hold for every path through the box, and the first one is not far from the shortest."""
    shot = scanned(scan_type, legs)
    earliest = earliest_arrival(shot, WALL, BOX)
    for bounce in (3, 4, 5, 8):
        lengths = path_lengths(shot, bounce - 2)
        assert earliest <= lengths.min()
        assert lengths.max() <= latest_of_bounce(shot, WALL, BOX, bounce)
    # the box is 0.5 m away; separate minima over lasers and sensors lose less than the wall's extent
    assert path_lengths(shot, 1).min() - earliest < 0.5
    assert latest_of_bounce(shot, WALL, BOX, None) == np.inf


def test_a_planar_wall_alone_never_receives_light_and_a_curved_one_does():
    """Light from wall to wall needs a curved wall."""
    assert earliest_arrival(scanned(), WALL, None) == np.inf
    sphere = SphereWall(np.zeros(3), 0.8)
    grid = point_grid(sphere, 5, 3)
    shot = Capture("confocal", grid, grid, np.zeros(3), np.zeros(3), True, 1.0, 0.0)
    assert earliest_arrival(shot, sphere, None) == pytest.approx(1.6)  # from the centre and back: two radii


@pytest.mark.parametrize(
    ("start", "n_bins", "max_bounces", "match"),
    [
        (0.0, 10, 3, "ends at 1 m, before the first light"),
        (0.0, 100, 3, None),
        (30.0, 10, 3, "starts at 30 m, after the last light"),
        (30.0, 10, None, "after the last of the third bounce"),
        (8.0, 10, 7, "after the last of the third bounce"),
        (1000.0, 10, 7, "after the last light"),
    ],
)
def test_a_window_that_misses_the_light_is_said(start, n_bins, max_bounces, match):
    """Exactly one sentence when nothing (or no third bounce) can be in the window, none otherwise."""
    said = list(window_warnings(scanned(), WALL, BOX, TimeAxis(start, 0.1, n_bins), max_bounces))
    assert len(said) == (match is not None)
    if match:
        assert match in said[0]


def test_filled_shares_are_shares_of_the_window():
    """No light, no bins; a window twice as long is half as full; the second bounce of a plane stays empty."""
    shot, bounces = scanned(), BounceAxis(5, True)
    short, long = (filled_shares(shot, WALL, BOX, TimeAxis(0.0, 0.1, n), bounces) for n in (300, 600))
    assert short[0] == 0
    assert 0 < short[1] < short[2] < short[3] < 1
    assert long == pytest.approx([share / 2 for share in short])
    assert filled_shares(shot, WALL, None, TimeAxis(0.0, 0.1, 100), bounces) == (0, 0, 0, 0)
    # all of the third bounce lies in a window from the earliest to the latest of it, and fills part of it per pair
    third = filled_shares(shot, WALL, BOX, TimeAxis(0.0, 0.1, 300), BounceAxis(3, False))
    assert third == pytest.approx([short[1]])
