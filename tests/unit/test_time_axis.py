"""The time axis: bins, and the bound behind ``n_bins: auto``."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.built_captures import built_capture

from nlosrender.capture.arrivals import latest_arrival
from nlosrender.capture.time_axis import TimeAxis, resolve_time_axis
from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.round_walls import CylinderWall, SphereWall
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.5)
SPHERE = SphereWall(np.zeros(3), 0.8)
TUBE = CylinderWall(Pose.identity(), 0.6, 1.3)
BOX = (np.array([-0.4, -0.7, 0.5]), np.array([0.9, 0.2, 1.6]))
SMALL_BOX = (np.array([-0.1, -0.3, -0.2]), np.array([0.3, 0.2, 0.1]))


def capture(wall=WALL, scan_type="exhaustive", **changes):
    keys = {"laser_point": (0.3, -0.2), "laser_position": [-0.5, 0.1, 0.25], "sensor_position": [0.2, 0.3, 0.4]}
    return built_capture(wall, scan_type=scan_type, **keys | changes)


def config(start_opl=0.0, bin_width_opl=0.003, n_bins="auto"):
    return SimpleNamespace(start_opl=start_opl, bin_width_opl=bin_width_opl, n_bins=n_bins)


def arrivals(shot, vertices):
    """OPL of paths laser, x_l, vertices..., x_s, sensor for every pair that is measured; vertices (k, paths, 3)."""
    inner = np.linalg.norm(np.diff(vertices, axis=0), axis=-1).sum(axis=0)
    laser, sensor = shot.laser_grid.positions.reshape(-1, 3), shot.sensor_grid.positions.reshape(-1, 3)
    first = np.linalg.norm(laser[:, None] - vertices[0], axis=-1) + shot.laser_legs.reshape(-1, 1)
    last = np.linalg.norm(sensor[:, None] - vertices[-1], axis=-1) + shot.sensor_legs.reshape(-1, 1)
    return first + last + inner if shot.scan_type == "confocal" else first[:, None] + last[None] + inner


def in_box(box, count, seed=3):
    random = np.random.default_rng(seed)
    return random.uniform(box[0], box[1], (count, 3))


def corners(box):
    return np.array([[box[i][0], box[j][1], box[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
def test_third_bounce_bound_is_the_latest_corner(scan_type):
    """No point of the box arrives later than the bound, and some corner of the box exactly then."""
    shot = capture(scan_type=scan_type)
    bound = latest_arrival(shot, WALL, BOX, 3)
    assert arrivals(shot, in_box(BOX, 400)[None]).max() <= bound
    assert arrivals(shot, corners(BOX)[None]).max() == pytest.approx(bound, rel=1e-14)


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("bounces", [4, 5])
def test_fourth_and_fifth_bounce_stay_below_the_bound(scan_type, bounces):
    """Paths hidden - hidden and hidden - wall - hidden arrive in the window of their max_bounces, and of no limit."""
    shot = capture(scan_type=scan_type)
    wall_points = in_box((np.array([-1, -0.75, 0]), np.array([1, 0.75, 0])), 2000, 5)
    path = np.stack([in_box(BOX, 2000, 3), *[wall_points] * (bounces - 4), in_box(BOX, 2000, 4)])
    extreme = np.stack([np.repeat(corners(BOX), 8, axis=0), np.tile(corners(BOX), (8, 1))])
    latest = max(arrivals(shot, path).max(), arrivals(shot, extreme).max())
    assert latest <= latest_arrival(shot, WALL, BOX, bounces)
    assert latest > latest_arrival(shot, WALL, BOX, 3)  # the margin is needed
    assert latest_arrival(shot, WALL, BOX, None) == latest_arrival(shot, WALL, BOX, 5)


@pytest.mark.parametrize("wall", [SPHERE, TUBE], ids=["sphere", "tube"])
@pytest.mark.parametrize("hidden", [None, SMALL_BOX])
def test_a_curved_wall_lights_itself(wall, hidden):
    """Second and third bounces by way of the wall itself arrive within the window."""
    shot = capture(wall, laser_position=None, sensor_position=None)
    random = np.random.default_rng(6)
    on_wall = wall.positions((random.random((400, 2)) - 0.5) * [wall.width, wall.height])
    bound = latest_arrival(shot, wall, hidden, 3)
    assert arrivals(shot, on_wall[None]).max() <= bound
    assert arrivals(shot, shot.laser_grid.positions.reshape(1, -1, 3)).max() <= bound  # holds the second bounce, too
    assert bound < 2 * 0.8 + 2 * 2 * 0.8 * np.sqrt(3)  # not huge: legs, and twice the diagonal of the sphere's box


def test_a_spot_makes_the_latest_light_later():
    """Points of a laser spot are up to its radius away: two distances grow by that much."""
    narrow, wide = (latest_arrival(capture(laser_spot_radius=r), WALL, BOX, 3) for r in (0.0, 0.05))
    assert wide == pytest.approx(narrow + 0.1)


def test_auto_covers_the_latest_arrival():
    """The window reaches beyond the bound, by less than 32 bins and one, in a multiple of 32."""
    shot = capture()
    bound = latest_arrival(shot, WALL, BOX, 3)
    axis = resolve_time_axis(config(start_opl=1.0), bound)
    assert axis.n_bins % 32 == 0
    assert bound < axis.end_opl <= bound + 33 * 0.003


def test_legs_that_do_not_count_shorten_the_window():
    """Without first and last bounces only the path between the wall points is covered."""
    shot = capture(account_first_and_last_bounces=False)
    bound = latest_arrival(shot, WALL, BOX, 3)
    assert bound < latest_arrival(capture(), WALL, BOX, 3)
    assert arrivals(shot, corners(BOX)[None]).max() == pytest.approx(bound, rel=1e-14)


def test_an_empty_scene_still_has_bins():
    """Nothing hidden, or a window that starts after all light: at least 32 bins."""
    assert resolve_time_axis(config(start_opl=10.0), latest_arrival(capture(), WALL, None, 3)).n_bins == 32
    assert resolve_time_axis(config(start_opl=1e3), latest_arrival(capture(), WALL, BOX, None)).n_bins == 32


def test_an_integer_is_taken_as_it_is():
    """A configured number of bins is not rounded."""
    assert resolve_time_axis(config(0.5, 0.01, 7), 9.0) == TimeAxis(0.5, 0.01, 7)


def test_too_many_bins_are_refused_with_advice():
    """Auto stops at 65536 bins and names the key and a bin width that fits."""
    with pytest.raises(ConfigError, match=r"time_axis\.n_bins: auto would need .* larger bin_width_opl") as caught:
        resolve_time_axis(config(bin_width_opl=1e-6), latest_arrival(capture(), WALL, BOX, 3))
    assert caught.value.issues[0].key == "time_axis.n_bins"


def test_large_captures_are_bounded_quickly():
    """64^4 pairs are not formed: the bound needs 2 x 8 x 4096 distances."""
    many = SimpleNamespace(nx=64, ny=64, width=None, height=None)
    shot = capture(sensor_grid=many, laser_grid=many)
    few = SimpleNamespace(nx=63, ny=63, width=None, height=None)
    similar = latest_arrival(capture(sensor_grid=few, laser_grid=few), WALL, BOX, 3)
    # The outermost points differ by 2.0 / 2 / 63 / 64 m or less in x and y, in four distances: below 1.5e-3 m
    assert latest_arrival(shot, WALL, BOX, 3) == pytest.approx(similar, abs=1.5e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((np.nan, 0.1, 5), "start_opl"), ((0.0, 0.0, 5), "bin_width_opl: got 0.0"), ((0.0, 0.1, 0), "n_bins: got 0")],
)
def test_impossible_axes_are_refused(arguments, message):
    """An axis has a finite start, a positive width and bins."""
    with pytest.raises(ValueError, match=message):
        TimeAxis(*arguments)
