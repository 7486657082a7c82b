"""Grids on the relay wall, and captures."""

from dataclasses import replace

import numpy as np
import pytest
from support.built_captures import built_capture

from nlosrender.capture.grids import point_grid, single_point
from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.round_walls import SphereWall
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.from_normal_up([5.0, -2.0, 1.0], [1, 0.5, 0.2], [0, 0.3, 1]), 2.0, 1.5)
SPHERE = SphereWall(np.array([1.0, 2.0, 3.0]), 0.8)


def capture(wall=WALL, **changes):
    return built_capture(wall, **{"laser_position": [6.0, -2.0, 1.5], "laser_energy": 2.0} | changes)


def test_points_are_cell_centres():
    """Column i of 5 is at ((i + 0.5) / 5 - 0.5) * width; rows ascend in y, columns in x."""
    points = point_grid(WALL, 5, 3)
    assert points.positions.shape == (3, 5, 3)
    assert (points.ny, points.nx, points.size) == (3, 5, (2.0, 1.5))
    np.testing.assert_allclose(points.positions[1, :, 0], [-0.8, -0.4, 0.0, 0.4, 0.8], atol=1e-15)
    np.testing.assert_allclose(points.positions[:, 2, 1], [-0.5, 0.0, 0.5], atol=1e-15)
    np.testing.assert_array_equal(points.positions[..., 2], 0)
    np.testing.assert_array_equal(points.wall_coordinates, points.positions[..., :2])
    np.testing.assert_array_equal(points.normals, np.broadcast_to([0, 0, 1], (3, 5, 3)))


def test_a_smaller_extent_is_centred():
    """The cells of a 1.4 x 0.4 m grid fill that extent around the wall's centre."""
    points = point_grid(WALL, 7, 2, 1.4, 0.4)
    np.testing.assert_allclose(points.positions[0, :, 0], np.arange(-3, 4) * 0.2, atol=1e-15)
    np.testing.assert_allclose(points.positions[:, 0, 1], [-0.1, 0.1], atol=1e-15)


def test_a_grid_on_a_sphere_is_uniform_in_area():
    """The whole sphere's grid has points in rows of equal area: heights are equally spaced (Archimedes)."""
    points = point_grid(SPHERE, 6, 4)
    np.testing.assert_allclose(points.positions[:, 0, 1], [-0.6, -0.2, 0.2, 0.6], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(points.positions, axis=-1), 0.8, atol=1e-15)
    np.testing.assert_allclose(points.normals, -points.positions / 0.8, atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 3), "grid of 0 x 3 points"),
        ((3, 0), "grid of 3 x 0 points"),
        ((3, 5, 2.1, 1.0), "grid width: got 2.1 m, need > 0 and <= 2 m"),
        ((3, 5, 1.0, 1.6), "grid height: got 1.6 m"),
        ((3, 5, 0.0, 1.0), "grid width: got 0 m"),
        ((3, 5, np.nan, 1.0), "grid width: got nan"),
    ],
)
def test_grids_beyond_the_wall_are_refused(arguments, message):
    """A grid has points and lies within the wall."""
    with pytest.raises(ValueError, match=message):
        point_grid(WALL, *arguments)


def test_a_single_point_is_a_grid_of_one():
    """One point keeps its wall coordinates; off the wall it is refused."""
    point = single_point(WALL, [0.3, -0.2])
    assert point.size == (0.0, 0.0)
    np.testing.assert_array_equal(point.positions, [[[0.3, -0.2, 0]]])
    with pytest.raises(ValueError, match="off the wall"):
        single_point(WALL, [0.3, -0.8])


def test_exhaustive_legs_are_distances_in_the_scene():
    """Legs are distances between device and wall point, as measured in scene coordinates."""
    result = capture()
    laser = WALL.pose.to_scene(result.laser_grid.positions)
    assert result.laser_legs.shape == (2, 7)
    assert (result.n_lasers, result.n_sensors) == (14, 15)
    np.testing.assert_allclose(result.laser_legs, np.linalg.norm(laser - [6.0, -2.0, 1.5], axis=-1), atol=1e-14)
    # default sensor position: 1 m in front of the centre
    xy = result.sensor_grid.wall_coordinates
    np.testing.assert_allclose(result.sensor_legs, np.sqrt(np.sum(xy**2, axis=-1) + 1), atol=1e-14)
    assert (result.laser_energy, result.laser_spot_radius) == (2.0, 0.0)


def test_legs_that_do_not_count_are_zero():
    """Without first and last bounces the legs are zero, the positions stay."""
    result = capture(account_first_and_last_bounces=False)
    np.testing.assert_array_equal(result.laser_legs, np.zeros((2, 7)))
    np.testing.assert_array_equal(result.sensor_legs, np.zeros((3, 5)))
    np.testing.assert_allclose(WALL.pose.to_scene(result.laser_position), [6.0, -2.0, 1.5])


def test_confocal_has_one_grid():
    """Lasers of a confocal capture are the sensor points themselves."""
    result = capture(scan_type="confocal", laser_grid=None, laser_position=None)
    assert result.laser_grid is result.sensor_grid
    np.testing.assert_array_equal(result.laser_legs, result.sensor_legs)


def test_single_has_one_laser_point():
    """The laser point defaults to the wall's centre."""
    assert capture(scan_type="single", laser_grid=None).laser_grid.positions.tolist() == [[[0, 0, 0]]]
    result = capture(scan_type="single", laser_grid=None, laser_point=(0.3, -0.2))
    assert result.laser_grid.positions.tolist() == [[[0.3, -0.2, 0]]]
    assert result.n_lasers == 1


def test_devices_of_a_sphere_stand_in_its_centre():
    """A sphere lit from within has laser and sensor in its centre: every leg is one radius."""
    result = capture(SPHERE, scan_type="confocal", laser_position=None)
    np.testing.assert_allclose(result.laser_legs, np.full((3, 5), 0.8), atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scan_type": "raster"}, "scan_type 'raster': need one of single, confocal, exhaustive"),
        ({"scan_type": "single"}, "one laser point, got 14"),
        ({"scan_type": "confocal"}, "laser_grid must be sensor_grid"),
        ({"laser_energy": 0.0}, "laser_energy: got 0.0"),
        ({"laser_spot_radius": -1.0}, "laser_spot_radius: got -1.0"),
    ],
)
def test_impossible_captures_are_refused(changes, message):
    """Grids must fit the scan type, energies must be positive."""
    with pytest.raises(ValueError, match=message):
        replace(capture(), **changes)


def test_exhaustive_needs_its_lasers():
    """An exhaustive capture without a laser grid is refused."""
    with pytest.raises(ConfigError, match="needs a laser_grid or laser_points"):
        capture(laser_grid=None)
