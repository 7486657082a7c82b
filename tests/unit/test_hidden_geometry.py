"""Hidden geometry: every item of the configuration lands where the scene says, in the wall's local frame."""

from types import SimpleNamespace

import numpy as np
import pytest

from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import joined_bounds
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Pose, euler_xyz
from nlosrender.scene.surfaces import MeshFile, ShapeDescription, Surface, hidden_surfaces
from nlosrender.scene.transforms import transform_matrix
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.from_normal_up([5.0, -2.0, 1.0], [1, 0.5, 0.2], [0, 0.3, 1]), 2.0, 1.5)
BSDF = {"type": "diffuse", "reflectance": 0.4}


def item(type, **keys):
    return SimpleNamespace(type=type, **{"name": None, "bsdf": BSDF, **keys})


def one(config) -> Surface:
    (surface,) = hidden_surfaces([config], WALL.pose)
    return surface


def rotation_about(axis, degrees):
    """The right-handed rotation about a coordinate axis, written out column by column."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[[first, second], [first, second]] = c
    rotation[second, first], rotation[first, second] = s, -s
    return rotation


def test_rectangle_lies_where_the_scene_says():
    """Brought back to the scene, the rectangle has its centre, its axes and its normal."""
    config = item("rectangle", width=0.4, height=0.6, center=[6, -1, 2], normal=[-1, 0, 0], up=[0, 0, 1])
    surface = one(config)
    scene = WALL.pose.to_scene(surface.shape.vertices)
    # normal -x, up z: the rectangle's x axis is up x normal = -y
    np.testing.assert_allclose(scene.min(axis=0), [6, -1.2, 1.7], atol=1e-14)
    np.testing.assert_allclose(scene.max(axis=0), [6, -0.8, 2.3], atol=1e-14)
    assert scene[0] == pytest.approx([6, -0.8, 1.7])
    normals = WALL.pose.direction_to_scene(surface.shape.face_normals())
    np.testing.assert_allclose(normals, [[-1, 0, 0]] * 2, atol=1e-14)
    assert surface.bsdf is BSDF


def test_box_turns_about_x_then_y_then_z():
    """A box's corners are its size, turned about x, y, z in this order, then moved."""
    config = item("box", center=[6, -1, 2], size=[0.3, 0.5, 0.9], rotate_deg=[20, 35, -70])
    mesh = one(config).shape
    rotation = rotation_about(2, -70) @ rotation_about(1, 35) @ rotation_about(0, 20)
    scene = (WALL.pose.to_scene(mesh.vertices) - [6, -1, 2]) @ rotation
    np.testing.assert_allclose(np.abs(scene), np.tile([0.15, 0.25, 0.45], (24, 1)), atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_euler_angles_turn_counter_clockwise(axis):
    """One angle alone is the right-handed rotation about its axis: x -> y -> z -> x by 90 degrees."""
    angles = np.zeros(3)
    angles[axis] = 30.0
    np.testing.assert_allclose(euler_xyz(angles), rotation_about(axis, 30.0), atol=1e-15)
    angles[axis] = 90.0
    turned = euler_xyz(angles) @ np.eye(3)[(axis + 1) % 3]
    np.testing.assert_allclose(turned, np.eye(3)[(axis + 2) % 3], atol=1e-15)


def test_mesh_file_is_scaled_turned_and_moved():
    """A file's point p comes to scale * p, turned about x, y, z, translated, then into the local frame."""
    angles, translate = [20, 35, -70], [1.0, 2.0, 3.0]
    config = item(
        "mesh",
        filename="/a/b.ply",
        scale=2.5,
        rotate_deg=angles,
        translate=translate,
        shading_normals="smooth",
        fit=None,
    )
    surface = one(config)
    assert isinstance(surface.shape, MeshFile)
    assert surface.shape.filename == "/a/b.ply"
    assert surface.shape.normals == "smooth"
    point = np.array([0.3, -0.1, 0.7])
    rotation = rotation_about(2, -70) @ rotation_about(1, 35) @ rotation_about(0, 20)
    expected = WALL.pose.to_local(rotation @ (2.5 * point) + translate)
    np.testing.assert_allclose((surface.shape.to_local @ [*point, 1])[:3], expected, atol=1e-14)
    assert surface.bounds() is None


def test_room_stands_on_the_wall_whatever_its_pose():
    """A room is defined in the wall's frame: the wall's pose does not enter."""
    mesh = one(item("room", size=[3.0, 2.5, 4.0])).shape
    np.testing.assert_allclose(mesh.bounds(), [[-1.5, -1.25, 0], [1.5, 1.25, 4]], atol=1e-14)


def test_letters_face_their_normal():
    """Letters are a flat mesh through their centre with the configured normal and cap height along up."""
    keys = {"text": "LO", "height": 0.5, "thickness": 0.0, "stroke_width": None, "spacing": None}
    mesh = one(item("letters", center=[6, -1, 2], normal=[-1, 0, 0], up=[0, 0, 1], **keys)).shape
    scene = WALL.pose.to_scene(mesh.vertices)
    np.testing.assert_allclose(scene[:, 0], 6.0, atol=1e-14)
    np.testing.assert_allclose([scene[:, 2].min(), scene[:, 2].max()], [1.75, 2.25], atol=1e-14)
    assert np.all(WALL.pose.direction_to_scene(mesh.face_normals())[:, 0] < -0.999)


def test_sphere_and_cylinder_become_descriptions():
    """Centres and ends are moved to the local frame; inside flips the normals."""
    sphere = one(item("sphere", center=[6, -1, 2], radius=0.3, inside=True))
    assert sphere.shape.description == {
        "type": "sphere",
        "center": WALL.pose.to_local([6, -1, 2]).tolist(),
        "radius": 0.3,
        "flip_normals": True,
    }
    cylinder = one(item("cylinder", center=[6, -1, 2], axis=[0, 0, 2], radius=0.1, height=0.5, inside=False))
    description = cylinder.shape.description
    assert (description["radius"], description["flip_normals"]) == (0.1, False)
    np.testing.assert_allclose(WALL.pose.to_scene(description["p0"]), [6, -1, 1.75], atol=1e-14)
    np.testing.assert_allclose(WALL.pose.to_scene(description["p1"]), [6, -1, 2.25], atol=1e-14)


def test_mitsuba_shape_keeps_its_keys_and_gets_the_wall_on_top():
    """to_world steps are applied first to last, then the scene is brought to the local frame."""
    steps = [{"scale": [1, 2, 3]}, {"rotate": {"axis": [0, 0, 2], "angle_deg": 90}}, {"translate": [1, 0, 0]}]
    shape = {"type": "sphere", "center": [0.1, 0.2, 0.3], "to_world": steps}
    description = one(item("mitsuba", shape=shape)).shape.description
    assert (description["type"], description["center"]) == ("sphere", [0.1, 0.2, 0.3])
    # (1, 1, 1) -> (1, 2, 3) -> (-2, 1, 3) -> (-1, 1, 3)
    np.testing.assert_allclose((description["to_world"] @ [1, 1, 1, 1])[:3], WALL.pose.to_local([-1, 1, 3]), atol=1e-14)
    assert shape["to_world"] is steps


def test_to_world_may_be_a_matrix_or_missing():
    """A 4 x 4 list is taken as it is, None is the identity, a number scales evenly."""
    matrix = np.arange(16.0).reshape(4, 4)
    np.testing.assert_array_equal(transform_matrix(matrix.tolist()), matrix)
    np.testing.assert_array_equal(transform_matrix(None), np.eye(4))
    np.testing.assert_array_equal(transform_matrix([{"scale": 2}]), np.diag([2, 2, 2, 1.0]))
    plain = one(item("mitsuba", shape={"type": "cube"})).shape.description["to_world"]
    np.testing.assert_allclose(plain @ WALL.pose.matrix(), np.eye(4), atol=1e-14)


def test_errors_name_the_item():
    """A mistake in the third item is reported under its key."""
    good = item("room", size=[1, 2, 3])
    bad = item("cylinder", center=[0, 0, 1], axis=[0, 0, 0], radius=0.1, height=0.5, inside=False)
    with pytest.raises(ConfigError, match=r"scene\.hidden_geometry\.2: axis .* no direction"):
        hidden_surfaces([good, good, bad], WALL.pose)
    with pytest.raises(ConfigError, match=r"scene\.hidden_geometry\.0: type 'torus'"):
        hidden_surfaces([item("torus")], WALL.pose)


def test_names_and_keys_count_the_items():
    """An item without a name is called by its type and place."""
    room = {"size": [1, 2, 3]}
    surfaces = hidden_surfaces([item("room", **room), item("room", name="hall", **room)], WALL.pose)
    assert [surface.name for surface in surfaces] == ["room-0", "hall"]
    assert [surface.key for surface in surfaces] == ["scene.hidden_geometry.0", "scene.hidden_geometry.1"]


def sphere_points():
    direction = np.random.default_rng(2).normal(size=(500, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_bounds_hold_spheres_and_tilted_cylinders():
    """A sphere's box is exact; a cylinder's box touches its rims on all six sides."""
    box = ShapeDescription({"type": "sphere", "center": [1, 2, 3], "radius": 0.5}).bounds()
    np.testing.assert_allclose(box, [[0.5, 1.5, 2.5], [1.5, 2.5, 3.5]])
    p0, p1 = np.array([0.1, 0.2, 0.3]), np.array([0.5, -0.4, 1.1])
    low, high = ShapeDescription({"type": "cylinder", "p0": p0, "p1": p1, "radius": 0.2}).bounds()
    pose = Pose.from_normal_up(p0, p1 - p0, [0, 1, 0])
    angle = np.linspace(0, 2 * np.pi, 2000)
    rim = 0.2 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) @ pose.rotation.T
    points = np.concatenate([rim + p0, rim + p1])
    # 2000 points on the rim miss its extreme by at most r (1 - cos(pi / 2000)) = 2.5e-7
    np.testing.assert_allclose(low, points.min(axis=0), atol=3e-7)
    np.testing.assert_allclose(high, points.max(axis=0), atol=3e-7)


def test_bounds_hold_transformed_shapes():
    """The box of a transformed sphere holds all its points."""
    to_world = transform_matrix([{"scale": [1, 2, 3]}, {"rotate": {"axis": [1, 2, 3], "angle_deg": 50}}])
    low, high = ShapeDescription({"type": "sphere", "to_world": to_world}).bounds()
    points = sphere_points() @ to_world[:3, :3].T
    assert np.all((points >= low) & (points <= high))
    assert ShapeDescription({"type": "sdfgrid", "to_world": to_world}).bounds() is None


def test_joint_bounds_skip_what_only_a_file_knows():
    """Surfaces of unknown extent do not enter; with none known there is no box."""
    flat = TriangleMesh([[0, 0, 1], [1, 0, 1], [0, 2, 1]], [[0, 1, 2]])
    ball = ShapeDescription({"type": "sphere", "center": [-1, 0, 0], "radius": 0.5})
    file = MeshFile("bunny.ply", np.eye(4))
    surfaces = [Surface("s", "k", shape, BSDF) for shape in (flat, file, ball)]
    np.testing.assert_allclose(joined_bounds(surface.bounds() for surface in surfaces), [[-1.5, -0.5, -0.5], [1, 2, 1]])
    assert joined_bounds(surface.bounds() for surface in surfaces[1:2]) is None
    assert joined_bounds([]) is None
