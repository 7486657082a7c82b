"""Mesh walls: from texture coordinates to places, and what a mesh has to be for that."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.rendering import configured, flat_wall
from support.wall_meshes import flat, globe, sheet, wavy, write_obj, write_uv_ply

from nlosrender.capture.grids import build_capture
from nlosrender.errors import ConfigError
from nlosrender.rendering.stages import place_scene
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.mesh_wall import MeshWall, mesh_wall_from_config

WIDTH, HEIGHT = 2.0, 1.6


def wall_of(folder: Path, surface: Any, columns: int = 7, rows: int = 5, suffix: str = "ply", **keys: Any) -> MeshWall:
    """Write a sheet and read it as a wall."""
    write = write_uv_ply if suffix == "ply" else write_obj
    name = write(folder / f"wall.{suffix}", *sheet(surface, columns, rows))
    pose: dict[str, Any] = {"scale": 1.0, "rotate_deg": (0, 0, 0), "translate": (0, 0, 0), "flip_normals": False}
    config = {**pose, "width": None, "height": None, **keys}
    return mesh_wall_from_config(SimpleNamespace(filename=folder / name, **config))  # type: ignore[arg-type]


def refused(folder: Path, vertices: Any, uvs: Any, faces: Any, **capture: Any) -> str:
    """Return what a config with this mesh as its wall is told."""
    config = flat_wall(capture=capture)
    name = write_uv_ply(folder / "wall.ply", vertices, uvs, faces)
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": name}
    with pytest.raises(ConfigError) as caught:
        place_scene(configured(config, folder=folder))
    return str(caught.value)


def _mesh_wall(name: str, **keys: Any) -> dict[str, Any]:
    """Configuration with a mesh as its wall."""
    config = flat_wall()
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": name, **keys}
    return config


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_a_flat_mesh_is_the_rectangle(tmp_path: Path, suffix: str) -> None:
    """Wall coordinates of a flat mesh are the rectangle's, whatever its file format; it lies in z = 0 exactly."""
    wall = wall_of(tmp_path, flat(WIDTH, HEIGHT), suffix=suffix)
    assert (wall.width, wall.height, wall.area) == pytest.approx((WIDTH, HEIGHT, WIDTH * HEIGHT), rel=1e-12)
    assert wall.is_planar
    xy = (np.random.default_rng(1).random((3, 50, 2)) - 0.5) * [WIDTH, HEIGHT]
    np.testing.assert_allclose(wall.positions(xy), np.concatenate([xy, 0 * xy[..., :1]], axis=-1), atol=1e-12)
    np.testing.assert_array_equal(wall.normals(xy), np.broadcast_to([0.0, 0.0, 1.0], (3, 50, 3)))
    np.testing.assert_allclose(wall.default_device_position, [0, 0, 1], atol=1e-12)


def test_a_pose_moves_the_wall_and_leaves_its_frame(tmp_path: Path) -> None:
    """Scale, rotation and translation are in the pose: the local frame sees the same wall, only larger."""
    here = wall_of(tmp_path, wavy(WIDTH, HEIGHT, 0.1))
    there = wall_of(tmp_path, wavy(WIDTH, HEIGHT, 0.1), scale=2.0, rotate_deg=(30, 40, 50), translate=(1, -2, 3))
    xy = (np.random.default_rng(2).random((40, 2)) - 0.5) * [here.width, here.height]
    # rounding of a few rotations in float64
    np.testing.assert_allclose(there.positions(2 * xy), 2 * here.positions(xy), atol=1e-12)
    np.testing.assert_allclose(there.normals(2 * xy), here.normals(xy), atol=1e-12)
    assert not here.is_planar


def test_a_mirrored_wall_keeps_its_front(tmp_path: Path) -> None:
    """Scales along the axes, one of them negative: points and normals are those of the wall, mirrored and stretched."""
    scale = np.array([-1.0, 1.5, 1.0])
    name = write_uv_ply(tmp_path / "wall.ply", *sheet(wavy(WIDTH, HEIGHT, 0.1), 7, 5))
    here, there = (
        mesh_wall_from_config(configured(_mesh_wall(name, scale=factors), folder=tmp_path).scene.wall)  # type: ignore[arg-type]
        for factors in (1.0, scale.tolist())
    )
    uv = np.random.default_rng(4).random((40, 2)) - 0.5
    points, normals = [], []
    for wall in (here, there):
        xy = uv * [wall.width, wall.height]
        points.append(wall.pose.to_scene(wall.positions(xy)))
        normals.append(wall.pose.direction_to_scene(wall.normals(xy)))
    np.testing.assert_allclose(points[1], points[0] * scale, atol=1e-12)
    expected = normals[0] / scale  # inverse transpose
    np.testing.assert_allclose(normals[1], expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)


def test_points_lie_on_the_surface_that_the_mesh_stands_for(tmp_path: Path) -> None:
    """Of a fine sheet, points at (u, v) are those of the smooth surface to second order, and normals are unit."""
    wall = wall_of(tmp_path, globe(0.8), 160, 120, width=2 * np.pi * 0.8, height=1.6)
    xy = (np.random.default_rng(3).random((300, 2)) - 0.5) * 0.9 * [wall.width, wall.height]
    points = wall.pose.to_scene(wall.positions(xy))
    smooth = np.stack(globe(0.8)(xy[:, 0] / wall.width + 0.5, xy[:, 1] / wall.height + 0.5), axis=1)
    # chords of 0.03 m leave the sphere by 0.03^2 / (8 * 0.8) = 2e-4 m; in latitude the map bends more: 1 / (1 - 0.9^2)
    assert np.abs(points - smooth).max() < 5e-4
    outward = np.einsum("nx,nx->n", wall.pose.direction_to_scene(wall.normals(xy)), smooth / 0.8)
    assert outward.min() > 0.99


def test_flip_normals_lights_the_other_side(tmp_path: Path) -> None:
    """The same points with opposite normals; the frame's z axis follows the lit side."""
    front, back = (wall_of(tmp_path, wavy(WIDTH, HEIGHT, 0.1), flip_normals=flip) for flip in (False, True))
    xy = (np.random.default_rng(4).random((40, 2)) - 0.5) * [WIDTH, HEIGHT]
    here, there = (wall.pose.to_scene(wall.positions(xy)) for wall in (front, back))
    np.testing.assert_allclose(there, here, atol=1e-12)
    turned = back.pose.direction_to_scene(back.normals(xy))
    np.testing.assert_allclose(turned, -front.pose.direction_to_scene(front.normals(xy)), atol=1e-12)
    assert front.pose.rotation[2, 2] > 0.99 > -0.99 > back.pose.rotation[2, 2]


def test_width_and_height_scale_the_wall_coordinates(tmp_path: Path) -> None:
    """Given a width, u from 0 to 1 is that many metres; the mesh does not change."""
    wall = wall_of(tmp_path, flat(WIDTH, HEIGHT), width=1.0)
    assert (wall.width, wall.height) == pytest.approx((1.0, HEIGHT))
    np.testing.assert_allclose(wall.positions([0.25, 0.1]), [0.5, 0.1, 0], atol=1e-12)


def test_the_mean_extents_span_the_area(tmp_path: Path) -> None:
    """Width times height is the area, so that a grid uniform in wall coordinates is uniform in area on average."""
    wall = wall_of(tmp_path, wavy(WIDTH, HEIGHT, 0.2), 30, 20)
    assert wall.width * wall.height == pytest.approx(wall.area, rel=1e-9)
    assert wall.width / wall.height == pytest.approx(WIDTH / HEIGHT, rel=0.1)  # more hills along x


def test_overlapping_texture_coordinates_are_refused_with_their_place(tmp_path: Path) -> None:
    """Two triangles with one (u, v) name two places: the error tells where and which."""
    vertices, uvs, faces = sheet(flat(WIDTH, HEIGHT), 3, 2)
    folded = uvs.copy()
    folded[:, 0] = 1 - np.abs(2 * uvs[:, 0] - 1)
    message = refused(tmp_path, vertices, folded, faces)
    assert "scene.relay_wall.filename" in message
    assert "texture coordinates overlap: (u, v) = (" in message
    assert "lies in the triangles" in message


@pytest.mark.parametrize(
    ("change", "need"),
    [
        (lambda uvs: None, "no texture coordinates"),
        (lambda uvs: uvs * 2, "run from \\(0, 0\\) to \\(2, 2\\), need \\(u, v\\) from 0 to 1"),
        (lambda uvs: uvs * [1, 0], "lie on a line or point"),
    ],
    ids=["none", "beyond 1", "no area"],
)
def test_texture_coordinates_that_name_nothing_are_refused(tmp_path: Path, change: Any, need: str) -> None:
    """There have to be some, within [0, 1], with an area."""
    vertices, uvs, faces = sheet(flat(WIDTH, HEIGHT), 3, 2)
    assert re.search(need, refused(tmp_path, vertices, change(uvs), faces))


def test_a_grid_point_in_a_hole_is_named(tmp_path: Path) -> None:
    """A sensor point that no triangle covers: the error has its wall coordinates and (u, v)."""
    vertices, uvs, faces = sheet(flat(WIDTH, HEIGHT), 4, 3)
    centres = uvs[faces].mean(axis=1)
    whole = MeshWall(*_placed(vertices, uvs, faces))
    holed = MeshWall(*_placed(vertices, uvs, faces[~((centres > 0.25) & (centres < 0.75)).all(axis=1)]))
    assert np.isfinite(whole.positions([0.1, 0.1])).all()
    assert np.isfinite(holed.positions([0.9, 0.7])).all()
    with pytest.raises(ConfigError, match=r"no triangle at wall coordinates \(0.1, 0.1\) m, \(u, v\) = \(0.55, 0.56"):
        holed.positions([[0.9, 0.7], [0.1, 0.1]])
    with pytest.raises(ConfigError, match=r"\(1.5, 0\) m is off the wall, which is 2 x 1.6 m"):
        whole.normals([1.5, 0.0])


def test_a_grid_larger_than_the_mesh_is_refused_with_its_key(tmp_path: Path) -> None:
    """Only the file tells how large a mesh wall is: a grid beyond it is a mistake in the configuration all the same."""
    config = flat_wall(capture={"sensor_grid": {"nx": 3, "ny": 2, "width": 2.5}})
    name = write_uv_ply(tmp_path / "wall.ply", *sheet(flat(WIDTH, HEIGHT), 4, 3))
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": name}
    validated = configured(config, folder=tmp_path)
    wall, _ = place_scene(validated)
    with pytest.raises(ConfigError, match=r"capture.sensor_grid: grid width: got 2.5 m, need > 0 and <= 2 m, the wall"):
        build_capture(validated.capture, wall)


def test_every_point_of_a_scrambled_mesh_is_found(tmp_path: Path) -> None:
    """The order of faces and their corners does not matter, nor do the edges: every (u, v) has its place."""
    vertices, uvs, faces = sheet(flat(WIDTH, HEIGHT), 9, 4)
    generator = np.random.default_rng(5)
    shuffled = np.array([np.roll(face, generator.integers(3)) for face in generator.permutation(faces)])
    wall = MeshWall(*_placed(vertices, uvs, shuffled))
    steps = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 37), np.linspace(-0.5, 0.5, 17)), axis=-1)  # edges, corners
    xy = steps * [WIDTH, HEIGHT]
    np.testing.assert_allclose(wall.positions(xy)[..., :2], xy, atol=1e-12)


def _placed(vertices: Any, uvs: Any, faces: Any) -> tuple[Any, Any, float, float]:
    return Pose.identity(), TriangleMesh(vertices, faces, uvs), WIDTH, HEIGHT


def strips(sliver: float) -> tuple[Any, Any, Any]:
    """Return three curved strips of triangles, the middle one ``sliver`` m wide but with 40 % of u."""
    x, u = np.array([-1.0, 0.0, sliver, 1.0]), np.array([0.0, 0.3, 0.7, 1.0])
    x, v = (values.ravel() for values in np.meshgrid(x, [0.0, 1.0]))
    uvs = np.stack([np.tile(u, 2), v], axis=1)
    y = (v - 0.5) * HEIGHT
    first = np.arange(3)
    faces = np.concatenate([np.stack([first, first + 1, first + 5], 1), np.stack([first, first + 5, first + 4], 1)])
    return np.stack([x, y, 0.1 * np.sin(5 * x + y)], axis=1), uvs, faces


@pytest.mark.parametrize("sliver", [1e-9, 1e-12])
def test_a_point_on_a_sliver_is_refused_before_the_render(sliver: float, tmp_path: Path) -> None:
    """float32 turns a triangle of 1.6 m x 1 nm any way: nothing of it can be lit, and the mistake is the mesh's."""
    config = flat_wall(sensors=(8, 7), capture={"laser_point": [0, 0], "sensor_grid": {"nx": 8, "ny": 7, "width": 1}})
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": write_uv_ply(tmp_path / "wall.ply", *strips(sliver))}
    validated = configured(config, folder=tmp_path)
    wall, _ = place_scene(validated)
    with pytest.raises(ConfigError, match=r"too fine at wall coordinates .* a sliver .* Remove slivers") as caught:
        build_capture(validated.capture, wall)
    assert caught.value.exit_code == 3
    assert caught.value.issues[0].key == "scene.relay_wall.filename"


def test_slivers_beside_the_points_are_no_matter(tmp_path: Path) -> None:
    """A wall may have triangles that float32 loses where no laser or sensor point lies."""
    wall = MeshWall(*_placed(*strips(1e-9)))
    corner = [-0.49 * wall.width, 0.2 * wall.height]
    assert wall.positions(corner)[0] == pytest.approx(-1 + 0.01 / 0.3, abs=1e-6)
    with pytest.raises(ConfigError, match="sliver"):
        wall.positions([0.0, 0.0])


def test_a_wall_of_no_size_is_refused(tmp_path: Path) -> None:
    """A mesh in the wrong unit is told how large it is."""
    assert "it is 1e-20 m large, need 1e-09 to 1e+09 m" in refused(tmp_path, *sheet(flat(1e-20, 1e-20), 3, 2))
