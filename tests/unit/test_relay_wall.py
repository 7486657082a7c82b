"""Relay walls: wall coordinates, positions, normals, texture coordinates, poses."""

from types import SimpleNamespace

import numpy as np
import pytest

from nlosrender.errors import ConfigError
from nlosrender.scene.pose import Pose, cylinder_pose
from nlosrender.scene.walls.round_walls import CylinderWall, SphereWall
from nlosrender.scene.walls.wall import RectangleWall
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

WALLS = {
    "rectangle": RectangleWall(Pose.identity(), 1.2, 0.7),
    "sphere-inside": SphereWall(np.zeros(3), 0.8),
    "sphere-outside": SphereWall(np.zeros(3), 0.8, inside=False),
    "cylinder-inside": CylinderWall(Pose.identity(), 0.6, 1.3),
    "cylinder-outside": CylinderWall(Pose.identity(), 0.6, 1.3, inside=False),
}
every_wall = pytest.mark.parametrize("wall", WALLS.values(), ids=WALLS.keys())


def wall_points(wall, count=200):
    # 0.98: the derivative at a sphere's pole is infinite, and finite differences must stay on the wall
    return (np.random.default_rng(1).random((count, 2)) - 0.5) * 0.98 * [wall.width, wall.height]


def tangents(wall, xy, step=1e-5):
    """Return d position / dx and / dy by central differences."""
    return [(wall.positions(xy + d) - wall.positions(xy - d)) / (2 * step) for d in step * np.eye(2)]


@every_wall
def test_wall_coordinates_preserve_area(wall):
    """The Jacobian of the wall coordinates is 1 everywhere: dA = dx dy."""
    along_x, along_y = tangents(wall, wall_points(wall))
    jacobian = np.linalg.norm(np.cross(along_x, along_y), axis=-1)
    # Central differences: h^2 / 6 times the third derivative, which near the pole (|y| < 0.98 R) is below
    # 3 / (R^2 (1 - 0.98^2)^2.5) ~ 1.5e4 per m^2: 1e-10 / 6 * 1.5e4 ~ 3e-7; round-off 1e-16 / 1e-5 is less.
    np.testing.assert_allclose(jacobian, 1.0, atol=1e-6)


@every_wall
def test_area_is_that_of_the_wall_coordinates(wall):
    """An area-preserving map keeps the total area: width x height."""
    assert wall.area == pytest.approx(wall.width * wall.height, rel=1e-14)


@every_wall
def test_normals_are_unit_and_perpendicular_to_the_wall(wall):
    """Normals have length 1 and are perpendicular to both tangents."""
    xy = wall_points(wall)
    normals = wall.normals(xy)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-14)
    for tangent in tangents(wall, xy):
        # 1e-6: error of the central differences, see above
        np.testing.assert_allclose(np.sum(tangent * normals, axis=-1), 0.0, atol=1e-6)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_inside_turns_the_normals_inwards(kind):
    """A curved wall lit from within has normals towards its axis or centre, else away from it."""
    xy = wall_points(WALLS[f"{kind}-inside"])
    inside, outside = WALLS[f"{kind}-inside"], WALLS[f"{kind}-outside"]
    away = outside.positions(xy) * ([1, 1, 1] if kind == "sphere" else [1, 0, 1])
    assert np.all(np.sum(away * outside.normals(xy), axis=-1) > 0)
    np.testing.assert_array_equal(inside.normals(xy), -outside.normals(xy))


def test_longitude_starts_at_z_and_grows_towards_x():
    """Wall coordinates (0, 0) are at +z; a quarter of the circumference further is +x; y is up."""
    sphere, cylinder = WALLS["sphere-inside"], WALLS["cylinder-inside"]
    for wall in (sphere, cylinder):
        quarter = wall.width / 4
        expected = wall.radius * np.array([[0, 0, 1], [1, 0, 0], [-1, 0, 0]])
        np.testing.assert_allclose(wall.positions([[0, 0], [quarter, 0], [-quarter, 0]]), expected, atol=1e-15)
    np.testing.assert_allclose(sphere.positions([0.0, 0.8]), [0, 0.8, 0], atol=1e-15)
    np.testing.assert_allclose(cylinder.positions([0.0, 0.65]), [0, 0.65, 0.6], atol=1e-15)


@every_wall
def test_points_keep_the_leading_shape(wall):
    """(3, 5, 2) wall coordinates give (3, 5, 3) positions and normals."""
    xy = wall_points(wall, 15).reshape(3, 5, 2)
    assert wall.positions(xy).shape == (3, 5, 3)
    assert wall.normals(xy).shape == (3, 5, 3)
    np.testing.assert_array_equal(wall.positions(xy)[2, 4], wall.positions(xy[2, 4]))


def test_rectangle_description_spans_the_wall():
    """Mitsuba's unit rectangle, transformed, has the wall's corners."""
    wall = WALLS["rectangle"]
    to_world = wall.shape_description()["to_world"]
    np.testing.assert_allclose(to_world @ [1, -1, 0, 1], [0.6, -0.35, 0, 1], atol=1e-15)


@every_wall
@pytest.mark.parametrize("axis", [0, 1])
def test_points_off_the_wall_are_refused(wall, axis):
    """No position is made up beyond the wall's edge, for x, for y, or for NaN."""
    xy = np.zeros((3, 2))
    xy[1, axis] = 0.51 * (wall.width, wall.height)[axis]
    for method in (wall.positions, wall.normals):
        with pytest.raises(ValueError, match="off the wall"):
            method(xy)
    xy[1, axis] = np.nan
    with pytest.raises(ValueError, match="off the wall"):
        wall.positions(xy)


def test_rectangle_from_config_has_its_pose():
    """A wall with normal +x and up +z has its local x axis along scene +y."""
    config = SimpleNamespace(
        bsdf={}, type="rectangle", width=2.0, height=1.5, center=[1, 2, 3], normal=[2, 0, 0], up=[0, 0, 1]
    )
    wall = relay_wall_from_config(config)
    assert (wall.width, wall.height, wall.is_planar) == (2.0, 1.5, True)
    np.testing.assert_allclose(wall.pose.to_scene(wall.positions([0.5, 0.25])), [1, 2.5, 3.25], atol=1e-15)
    np.testing.assert_allclose(wall.pose.direction_to_scene(wall.normals([0.5, 0.25])), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(wall.pose.to_scene(wall.default_device_position), [2, 2, 3], atol=1e-15)


def test_sphere_from_config_keeps_the_scene_axes():
    """A sphere's local frame is the scene's, moved to the centre."""
    wall = relay_wall_from_config(SimpleNamespace(bsdf={}, type="sphere", center=(1, 2, 3), radius=0.5, inside=True))
    np.testing.assert_allclose(wall.pose.to_scene(wall.positions([0, 0])), [1, 2, 3.5], atol=1e-15)
    np.testing.assert_array_equal(wall.pose.to_scene(wall.default_device_position), [1, 2, 3])
    outside = SphereWall(np.zeros(3), 0.5, inside=False)
    np.testing.assert_allclose(outside.default_device_position, [0, 0, 1.5])


@pytest.mark.parametrize("axis", [[0, 3, 0], [0, 0, 2], [1, 0, 0], [-1, 2, 0.5], [1e-4, 0, 1]])
def test_cylinder_from_config_has_its_axis_as_local_y(axis):
    """Every point of the wall is one radius from the configured axis, and wall y runs along it."""
    center = np.array([1.0, -2.0, 0.5])
    config = SimpleNamespace(bsdf={}, type="cylinder", center=center, axis=axis, radius=0.4, height=1.1, inside=False)
    wall = relay_wall_from_config(config)
    direction = np.asarray(axis) / np.linalg.norm(axis)
    xy = wall_points(wall, 20)
    offset = wall.pose.to_scene(wall.positions(xy)) - center
    along = offset @ direction
    np.testing.assert_allclose(along, xy[:, 1], atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(offset - along[:, None] * direction, axis=1), 0.4, atol=1e-14)
    assert np.linalg.det(wall.pose.rotation) == pytest.approx(1.0)


def test_upright_cylinder_has_the_scene_axes():
    """A cylinder along y keeps azimuth 0 at the scene's z."""
    np.testing.assert_allclose(cylinder_pose([0, 0, 0], [0, 5, 0]).rotation, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: RectangleWall(Pose.identity(), 0.0, 1.0), "relay wall width: got 0.0, need a finite number > 0"),
        (lambda: RectangleWall(Pose.identity(), 1.0, np.nan), "relay wall height: got nan"),
        (lambda: SphereWall(np.zeros(3), -1.0), "relay wall radius: got -1.0"),
        (lambda: CylinderWall(Pose.identity(), 1.0, np.inf), "relay wall height: got inf"),
        (lambda: cylinder_pose([0, 0, 0], [0, 0, 0]), "axis .* has no direction"),
        (
            lambda: relay_wall_from_config(SimpleNamespace(bsdf={}, type="torus")),
            "type: got 'torus', need",
        ),
        (lambda: WALLS["rectangle"].positions([0.0, 0.0, 0.0]), r"need \(\.\.\., 2\)"),
    ],
)
def test_impossible_walls_are_refused(build, message):
    """A wall that cannot exist is refused with the value and what is allowed."""
    with pytest.raises((ValueError, ConfigError), match=message):
        build()
