"""Lists of points on the relay wall: what they may hold, and what of them is a grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.rendering import configured, flat_wall

from nlosrender.capture.grids import listed_points, point_grid
from nlosrender.config.load import config_hash, config_to_dict, load_config
from nlosrender.errors import ConfigError
from nlosrender.files.identity import capture_hash, files_read
from nlosrender.scene.pose import Pose
from nlosrender.scene.walls.wall import RectangleWall

WALL = RectangleWall(Pose.identity(), 2.0, 1.6)
ROOT = Path(__file__).parents[2]


def config_with(points: object, folder: Path, scan: str = "single", **capture: object):
    described = flat_wall(scan=scan, capture={"sensor_points": points, **capture})
    described["capture"].pop("sensor_grid")
    return configured(described, folder=folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n0,0\n", r"points\.csv:1: got \['x', 'y'\], need 2 finite numbers.*Remove a line of names"),
        ("# a\n0,0\n\n0 0\n", r"points\.csv:4: got \[0, 0\] a second time, first in points\.csv:2; remove one"),
        ("0,0\n1,2,3\n", r"points\.csv:2: got \[1, 2, 3\], need 2 finite"),
        ("0,0\n1\n", r"points\.csv:2: got \[1\], need 2 finite"),
        ("0,0\n0,nan\n", r"points\.csv:2: got \[0, nan\], need 2 finite"),
        ("0,0\n0,one\n", r"points\.csv:2: got \[0, 'one'\], need 2 finite"),
        ("0,0\n0,0.9\n", r"points\.csv:2: got \[0, 0\.9\], off the relay wall; need x from -1 to 1 m and y from -0\.8"),
        ("# nothing\n", r"points\.csv holds no points"),
    ],
)
def test_mistakes_in_a_file_are_told_with_their_line(text: str, message: str, tmp_path: Path) -> None:
    """A file is read before anything is rendered, and each mistake has its line."""
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(ConfigError, match=rf"capture\.sensor_points\.file: .*{message}"):
        config_with({"file": "points.csv"}, tmp_path)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], r"sensor_points: got \[\], need at least one point"),
        ([[0, 0], [0, 0.1, 0]], r"sensor_points\.1: got \[0, 0\.1, 0\], need 2 finite"),
        ([[0, 0], [0.5, 0], [0, 0]], r"sensor_points\.2: got \[0, 0\] a second time, first in item 0"),
        ([[0, 0], [1.5, 0]], r"sensor_points\.1: got \[1\.5, 0\], off the relay wall"),
        ({"file": "points.txt"}, r"sensor_points\.file: got 'points\.txt' \(text\), need the name of a \.csv or \.npy"),
        ({"file": "gone.csv"}, r"sensor_points\.file: got gone\.csv, but there is no file"),
        ({"file": "three.npy"}, r"three\.npy holds float64 \(2, 3\), need numbers of shape \(points, 2\)"),
        ({"file": "text.npy"}, r"text\.npy is no array"),
        ({"files": "a.csv"}, r"sensor_points: got a mapping with files, need a list"),
    ],
)
def test_mistakes_in_a_list_are_told_with_their_item(points: object, message: str, tmp_path: Path) -> None:
    """What is no list of points, nor the name of a file of them, is refused."""
    np.save(tmp_path / "three.npy", np.zeros((2, 3)))
    (tmp_path / "text.npy").write_text("1,2\n")
    with pytest.raises(ConfigError, match=message):
        config_with(points, tmp_path)


@pytest.mark.parametrize(
    ("scan", "capture", "message"),
    [
        ("single", {"sensor_grid": {"nx": 2, "ny": 3}}, r"sensor_points: stands beside sensor_grid"),
        ("exhaustive", {"laser_grid": None}, r"laser_grid: missing.*or a list as laser_points"),
        ("single", {"sensor_points": None}, r"sensor_grid: missing.*or a list as sensor_points"),
    ],
)
def test_points_are_a_grid_or_a_list(scan: str, capture: dict[str, object], message: str, tmp_path: Path) -> None:
    """Not both, and not neither."""
    described = flat_wall(scan=scan)
    described["capture"].pop("sensor_grid")
    described["capture"] |= {"sensor_points": [[0, 0]], **capture}
    with pytest.raises(ConfigError, match=message):
        configured(described, folder=tmp_path)


def test_a_list_is_the_same_written_down_or_in_a_file(tmp_path: Path) -> None:
    """Items of the YAML, lines of a .csv and rows of an .npy file are the same points, to the last bit."""
    xy = np.random.default_rng(1).uniform(-0.7, 0.7, (7, 2))
    np.save(tmp_path / "points.npy", xy)
    (tmp_path / "points.csv").write_text("".join(f"{x!r}; {y!r}\n" for x, y in xy.tolist()))
    for points in (xy.tolist(), {"file": "points.csv"}, {"file": "points.npy"}):
        config = config_with(points, tmp_path)
        assert config.capture.n_sensors == 7
        np.testing.assert_array_equal(config.capture.sensor_list.xy, xy)


def test_the_content_of_a_file_is_part_of_the_capture(tmp_path: Path) -> None:
    """Another file of the same name is another capture, the same file elsewhere is not; it is not written over."""
    (tmp_path / "elsewhere").mkdir()
    hashes = []
    for folder, text in ((tmp_path, "0,0\n"), (tmp_path / "elsewhere", "0,0\n"), (tmp_path, "0,0.1\n")):
        (folder / "points.csv").write_text(text)
        resolved = config_to_dict(config_with({"file": "points.csv"}, folder))
        assert list(files_read(resolved)) == [str(folder / "points.csv")]
        hashes.append(capture_hash(resolved))
    assert hashes[0] == hashes[1] != hashes[2]


def test_captures_of_grids_keep_their_hash() -> None:
    """The canonical JSON of a capture without lists does not name them."""
    resolved = config_to_dict(load_config(ROOT / "configs/smoke.yaml"))
    assert not {"sensor_points", "laser_points"} & resolved["capture"].keys()
    assert config_hash(load_config(ROOT / "configs/smoke.yaml", ["capture.sensor_points=null"]))


@pytest.mark.parametrize(("nx", "ny", "size"), [(5, 3, (1.4, 0.8)), (1, 7, None), (6, 1, None), (40, 36, (0.7, 1.3))])
def test_a_grid_is_found_in_a_list_of_its_rows(nx: int, ny: int, size: tuple[float, float] | None) -> None:
    """The lattice of such a list has the grid's rows, columns and cells; a single row has cells without a height."""
    grid = point_grid(WALL, nx, ny, *(size or (None, None)))
    listed = listed_points(WALL, grid.wall_coordinates.reshape(-1, 2))
    assert (listed.ny, listed.nx, listed.is_list) == (1, nx * ny, True)
    np.testing.assert_array_equal(listed.lattice.positions, grid.positions)
    np.testing.assert_array_equal(listed.places, grid.places)
    found = tuple(0.0 if count == 1 else length for count, length in zip((nx, ny), grid.size, strict=True))
    assert listed.lattice.size == found
    assert not listed.lattice.is_list


@pytest.mark.parametrize("change", ["columns first", "one point elsewhere", "uneven", "one missing"])
def test_other_lists_stay_lists(change: str) -> None:
    """Points in another order than row by row, or not equally spaced, are no lattice."""
    xy = point_grid(WALL, 5, 3).wall_coordinates.copy()
    if change == "columns first":
        xy = xy.swapaxes(0, 1)
    elif change == "one point elsewhere":
        xy[1, 2, 0] += 1e-6
    elif change == "uneven":
        xy[:, 2, 0] += 0.01
    flat = xy.reshape(-1, 2)[:-1] if change == "one missing" else xy.reshape(-1, 2)
    listed = listed_points(WALL, flat)
    assert listed.lattice is listed
    assert listed.places.min() == 0
    assert listed.places.max() == 1
