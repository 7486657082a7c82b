"""Ground truth: depth, normals, albedo, positions, instances, occupancy and poses in closed form."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from nlosrender.capture.part import Selection
from nlosrender.config.document import Config
from nlosrender.config.load import parse_config
from nlosrender.errors import ConfigError
from nlosrender.files.parts.merge import merge_captures
from nlosrender.files.truth_datasets import GroundTruth
from nlosrender.files.validation import check_file
from nlosrender.pipeline import render_capture
from nlosrender.rendering.ground_truth import ground_truth
from nlosrender.rendering.stages import describe_capture, load_scene, started_backend
from nlosrender.scene.meshes.letters import letters_mesh
from nlosrender.scene.meshes.primitives import box_mesh
from nlosrender.scene.pose import Pose, euler_xyz

TOLERANCE = 1e-4  # m
KINDS = "[depth, normal, albedo, position, instance, occupancy, poses]"
WALL = "{type: rectangle, width: 2.0, height: 1.6}"


def config_of(*items: str, wall: str = WALL, more: str = "", folder: Path = Path("/tmp")) -> Config:
    """Return the configuration of a capture of 21 x 15 sensor points with all of the ground truth."""
    listed = "".join(f"    - {item}\n" for item in items)
    text = f"""\
scene:
  relay_wall: {wall}
  hidden_geometry:
{listed}capture: {{scan_type: confocal, sensor_grid: {{nx: 21, ny: 15}}}}
time_axis: {{bin_width_opl: 0.1, n_bins: 64}}
render: {{max_bounces: 3, target_error: 0.2}}
output: {{ground_truth: {KINDS}{more}}}
"""
    return parse_config(text, "truth.yaml", folder)


def truth_of(*items: str, **keys: object) -> GroundTruth:
    """Return the ground truth of some items."""
    config = config_of(*items, **keys)
    started_backend(config)
    built = load_scene(config)
    return ground_truth(config, built, describe_capture(config, built.wall, built)[0])


def grid(nx: int = 21, ny: int = 15, width: float = 2.0, height: float = 1.6) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of the sensor points (ny, nx)."""
    return np.meshgrid(((np.arange(nx) + 0.5) / nx - 0.5) * width, ((np.arange(ny) + 0.5) / ny - 0.5) * height)


def test_plate() -> None:
    """Before a plate the depth is its distance, elsewhere there is nothing."""
    found = truth_of(
        "{type: rectangle, width: 0.7, height: 0.5, center: [0.2, -0.1, 0.9], bsdf: {type: diffuse, reflectance: 0.3}}"
    ).datasets
    x, y = grid()
    inside = (np.abs(x - 0.2) < 0.35) & (np.abs(y + 0.1) < 0.25)
    assert np.array_equal(found["gt_instance"], inside.astype(int))
    assert np.array_equal(np.isnan(found["gt_depth"]), ~inside)
    assert found["gt_depth"][inside] == pytest.approx(0.9, abs=TOLERANCE)
    # the file's frame: (X, Y, Z) = (x, -z, y); the plate looks to the wall
    assert pytest.approx(np.tile([0, 1, 0], (inside.sum(), 1)), abs=1e-6) == found["gt_normal"][:, inside].T
    expected = np.stack([x, np.full_like(x, -0.9), y])[:, inside]
    assert found["gt_position"][:, inside] == pytest.approx(expected, abs=TOLERANCE)
    assert found["gt_albedo"].shape == (1, 15, 21)
    assert found["gt_albedo"][0, inside] == pytest.approx(0.3, abs=1e-6)


def test_tilted_plane_before_a_turned_wall() -> None:
    """The depth of a tilted plane is linear in x and y, in whatever pose the wall stands."""
    wall = "{type: rectangle, width: 2.0, height: 1.6, center: [3, -2, 7], normal: [1, 2, -0.5], up: [0.2, 1, 1]}"
    frame = Pose.from_normal_up([3, -2, 7], [1, 2, -0.5], [0.2, 1, 1])
    normal = np.array([0.3, -0.4, -1.0]) / np.linalg.norm([0.3, -0.4, -1.0])
    center, axes = frame.to_scene([0.0, 0.0, 1.2]).tolist(), frame.direction_to_scene([normal, [0, 1, 0]]).tolist()
    item = f"{{type: rectangle, width: 9, height: 9, center: {center}, normal: {axes[0]}, up: {axes[1]}}}"
    found = truth_of(item, wall=wall).datasets
    x, y = grid()
    depth = 1.2 - (normal[0] * x + normal[1] * y) / normal[2]
    assert found["gt_depth"] == pytest.approx(depth, abs=TOLERANCE)
    seen = truth_of(item, wall=wall, more=", frame: scene").datasets
    positions = frame.to_scene(np.stack([x, y, depth], axis=-1))
    assert np.moveaxis(seen["gt_position"], 0, -1) == pytest.approx(positions, abs=TOLERANCE)
    assert seen["gt_normal"][:, 3, 4] == pytest.approx(axes[0], abs=1e-6)


def test_sphere() -> None:
    """Depth and normal of a sphere, and its volume."""
    found = truth_of("{type: sphere, radius: 0.45, center: [-0.3, 0.1, 0.8]}").datasets
    x, y = grid()
    rho = np.hypot(x + 0.3, y - 0.1)
    inside = rho < 0.45
    assert np.array_equal(found["gt_instance"] == 1, inside)
    height = np.sqrt(0.45**2 - rho[inside] ** 2)
    assert found["gt_depth"][inside] == pytest.approx(0.8 - height, abs=TOLERANCE)
    normal = np.stack([x[inside] + 0.3, height, y[inside] - 0.1]) / 0.45
    assert found["gt_normal"][:, inside] == pytest.approx(normal, abs=1e-4)


def test_from_within_a_sphere_wall() -> None:
    """Along the normals of a sphere wall everything lies towards its middle: a ball there is equally far from all."""
    wall = "{type: sphere, center: [0, 0, 0], radius: 1.0, width: 1.5, height: 1.2}"
    found = truth_of("{type: sphere, radius: 0.25, center: [0, 0, 0]}", wall=wall).datasets
    assert found["gt_depth"] == pytest.approx(0.75, abs=TOLERANCE)


def volume(datasets: dict) -> float:
    """Return the occupied volume [m^3]."""
    edges = np.abs(np.diff(datasets["gt_occupancy_bounds"].astype(float), axis=0))[0]
    return float(datasets["gt_occupancy"].sum(dtype=float) * edges.prod() / datasets["gt_occupancy"].size)


SOLIDS = [
    ("{type: sphere, radius: 0.45, center: [-0.3, 0.1, 0.8]}", 4 / 3 * np.pi * 0.45**3),
    ("{type: box, size: [0.5, 0.6, 0.7], center: [0.1, 0, 0.9], rotate_deg: [20, 30, 40]}", 0.21),
    ("{type: box, size: [0.5, 0.6, 0.7], center: [0.1, 0, 0.9]}", 0.21),
    ("{type: letters, text: O, height: 1.2, thickness: 0.2, center: [0, 0, 0.9]}", None),
    (
        "{type: mesh, filename: inside-out.obj, fit: {largest: 0.8}, translate: [0, 0, 1], rotate_deg: [0, 30, 0]}",
        0.064,
    ),
]


@pytest.mark.parametrize(("item", "expected"), SOLIDS, ids=["sphere", "turned box", "box", "letter", "inside out"])
def test_volume(item: str, expected: float | None, tmp_path: Path) -> None:
    """The occupied volume is that of the item to 1 %, wherever its faces turn to."""
    mesh = box_mesh((1, 2, 4), Pose(np.eye(3), np.array([5.0, 6, 7])))
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {c + 1} {b + 1} {a + 1}" for a, b, c in mesh.faces]
    (tmp_path / "inside-out.obj").write_text("\n".join(lines))
    found = truth_of(item, more=", ground_truth_grid: {nx: 48, ny: 40, nz: 30}", folder=tmp_path).datasets
    assert found["gt_occupancy"].shape == (30, 40, 48)
    assert found["gt_depth"].shape == (40, 48)
    if expected is None:  # a prism: the area of its front times its thickness
        expected = 0.2 * letters_mesh("O", 1.2).area
    assert volume(found) == pytest.approx(expected, rel=0.01)


def test_where_voxels_lie() -> None:
    """Voxels count along the wall's normal, y and x; near and far, where given, are the same in all captures."""
    more = ", ground_truth_grid: {nx: 20, ny: 16, nz: 10, near: 0.5, far: 1.5}"
    item = "{type: box, size: [0.3, 0.2, 0.2], center: [0.55, -0.3, 1.2]}"
    found = truth_of(item, more=more).datasets
    expected = np.zeros((10, 16, 20))
    expected[6:8, 4:6, 14:17] = 1  # x 0.4 to 0.7, y -0.4 to -0.2, z 1.1 to 1.3
    assert found["gt_occupancy"] == pytest.approx(expected, abs=1e-4)
    assert found["gt_occupancy_bounds"] == pytest.approx(np.array([[-1, -0.5, -0.8], [1, -1.5, 0.8]]))


def test_sheets_and_rooms_have_no_inside() -> None:
    """A sheet fills the voxels that it passes through, one along each ray; a room from within does, too."""
    more = ", ground_truth_grid: {nx: 20, ny: 16, nz: 10, near: 0.0, far: 2.0}"
    sheet = "{type: rectangle, width: 9, height: 9, center: [0, 0, 1.1], normal: [0.2, 0, -1]}"
    found = truth_of(sheet, more=more).datasets["gt_occupancy"]
    assert found.sum(axis=0) == pytest.approx(1)
    assert set(np.unique(found)) <= {0, 0.25, 0.5, 0.75, 1}  # rays per voxel: 4
    room = truth_of("{type: room, size: [3, 3, 1.5]}", more=more).datasets["gt_occupancy"]
    assert np.argwhere(room.sum(axis=(1, 2))).ravel().tolist() == [7]


ITEMS = (
    "{name: ball, type: sphere, radius: 0.2, center: [-0.5, 0.3, 0.8]}",
    "{name: plate, type: rectangle, width: 0.5, height: 0.4, center: [0.4, 0.3, 0.7]}",
    "{name: brick, type: box, size: [0.4, 0.3, 0.2], center: [0.4, -0.4, 0.9]}",
    "{name: tube, type: cylinder, radius: 0.15, height: 0.5, center: [-0.5, -0.4, 0.9]}",
)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 0, 2), (2, 3, 1, 0)])
def test_instances_follow_the_items(order: tuple[int, ...]) -> None:
    """Numbers and names are those of the list of items, whatever order the renderer has its shapes in."""
    truth = truth_of(*(ITEMS[item] for item in order))
    assert list(truth.items) == [("ball", "plate", "brick", "tube")[item] for item in order]
    x, y = grid()
    for name, at in {"ball": (-0.5, 0.3), "plate": (0.4, 0.3), "brick": (0.4, -0.4), "tube": (-0.5, -0.4)}.items():
        nearest = np.hypot(x - at[0], y - at[1]).argmin()
        assert truth.datasets["gt_instance"].ravel()[nearest] == 1 + truth.items.index(name)


def test_poses(tmp_path: Path) -> None:
    """A pose takes an item's own coordinates to the file's: corners of a box and of a mesh file of any unit."""
    mesh = box_mesh((1, 2, 4), Pose(np.eye(3), np.array([5.0, 6, 7])))
    (tmp_path / "a.obj").write_text(
        "\n".join(
            [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces]
        )
    )
    angles = [20, -30, 40]
    found = truth_of(
        f"{{type: mesh, filename: a.obj, fit: {{largest: 0.8}}, translate: [0.1, 0.2, 1], rotate_deg: {angles}}}",
        f"{{type: box, size: [0.2, 0.2, 0.2], center: [0.1, 0.2, 1], rotate_deg: {angles}}}",
        folder=tmp_path,
    ).datasets["gt_poses"]
    turned = euler_xyz(angles) @ (np.array([0.1, 0.2, 0.4]) * [1, -1, 1]) + [0.1, 0.2, 1]
    expected = [turned[0], -turned[2], turned[1], 1]
    corner = np.array([5.5, 5, 9, 1.0])  # of the file: half of 1, 2, 4 from its middle
    assert found[0] @ corner == pytest.approx(expected, abs=1e-9)
    assert found[1] @ [0.1, -0.2, 0.4, 1] == pytest.approx(expected, abs=1e-9)


def test_in_the_file(tmp_path: Path) -> None:
    """The datasets stand at the root of the capture's file, which stays a valid Z-NLOS file."""
    config = config_of(ITEMS[0], more=f", path: {tmp_path / 'a.hdf5'}")
    render_capture(config)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert {name for name in file if name.startswith("gt_")} == {
            *(f"gt_{kind}" for kind in ("depth", "normal", "albedo", "position", "instance", "occupancy", "poses")),
            "gt_occupancy_bounds",
        }
        assert file["gt_instance"].dtype == np.int32
        assert file["gt_depth"].dtype == np.float32
        assert file["gt_instance"].attrs["names"] == '["ball"]'
        expected = truth_of(ITEMS[0]).datasets["gt_depth"].astype(np.float32)
        assert np.array_equal(file["gt_depth"][...], expected, equal_nan=True)
    check = check_file(tmp_path / "a.hdf5")
    assert not check.violations
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        del file["gt_normal"]
        file["gt_normal"] = np.zeros((3, 15, 20), dtype=np.float32)
    assert "gt_normal: shape (3, 15, 20)" in check_file(tmp_path / "a.hdf5").violations[0]


def test_parts_have_it(tmp_path: Path) -> None:
    """The parts of a capture hold all of its ground truth, and so does the capture that is made of them."""
    config = config_of(ITEMS[0], more=f", path: {tmp_path / 'a.hdf5'}")
    parts = []
    for number in (1, 2):
        parts.append(tmp_path / f"{number}.hdf5")
        output = config.output.model_copy(update={"path": parts[-1]})
        render_capture(config.model_copy(update={"output": output}), selection=Selection(shard=(number, 2)))
    merge_captures(parts, tmp_path / "whole.hdf5")
    render_capture(config)
    with h5py.File(tmp_path / "whole.hdf5") as whole, h5py.File(tmp_path / "a.hdf5") as alone:
        assert set(whole) == set(alone)
        assert all(whole[name][()].tobytes() == alone[name][()].tobytes() for name in alone if name.startswith("gt_"))


def test_mistakes() -> None:
    """Kinds are told; a camera sees the scene itself."""
    with pytest.raises(ConfigError, match=r"ground_truth\.0: got 'deph' .* Did you mean depth"):
        parse_config(
            "scene: {relay_wall: {type: rectangle, width: 1, height: 1}}\n"
            "capture: {scan_type: confocal, sensor_grid: {nx: 2, ny: 2}}\noutput: {ground_truth: [deph]}",
            "z.yaml",
            Path("/tmp"),
        )
    with pytest.raises(ConfigError, match=r"ground_truth: is seen from a grid on a relay wall"):
        parse_config(
            "scene: {emitters: [{type: point, position: [0, 1, 1], intensity: 1}]}\n"
            "capture:\n  scan_type: line_of_sight\n"
            "  camera: {position: [0, 0, 0], look_at: [0, 0, 1], width: 4, height: 3}\n"
            "output: {ground_truth: [depth]}",
            "z.yaml",
            Path("/tmp"),
        )
    with pytest.raises(ConfigError, match=r"far: got 0\.5, need more than near, 1 m"):
        config_of(ITEMS[0], more=", ground_truth_grid: {nx: 2, ny: 2, near: 1, far: 0.5}")
