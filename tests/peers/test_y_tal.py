"""Our files in y-tal, the Z-NLOS authors' own library, which runs in an environment of its own (make peers)."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from patch_captures import (
    BIN_WIDTH,
    GRIDS,
    LASER,
    N_BINS,
    PATCH,
    PATCH_EDGE,
    SENSOR,
    START_OPL,
    Grid,
    PatchCapture,
    arrival_bins,
    file_point,
    lit_bins,
    render_patch,
)

from nlosrender.files.reading.reader import open_capture

PEER = Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"
READ = Path(__file__).with_name("read_with_y_tal.py")

pytestmark = [
    pytest.mark.peers,
    pytest.mark.skipif(not PEER.exists(), reason="y-tal is not installed: make peers puts it into .venv-peers"),
]

FLOAT32 = 1.2e-7  # half a unit in the last place of coordinates below 2 m
# captures that y-tal 0.20.0 misreads, beside those without legs
FAULTY = {
    "six_columns": ("single", Grid(6, 4, 1.8, 1.5), None),
    "one_laser_column": ("exhaustive", Grid(3, 5, 1.7, 1.6), Grid(1, 2, 1.2, 0.9)),
}

Dumps = dict[str, dict[str, np.ndarray]]


def faulty(what: str) -> pytest.MarkDecorator:
    """Mark a law that y-tal breaks by itself; strict, so that a version that keeps it is noticed."""
    return pytest.mark.xfail(strict=True, raises=AssertionError, reason=f"y-tal 0.20.0 {what}")


@pytest.fixture(scope="module")
def volume() -> np.ndarray:
    """Points (5, 7, 9, 3) around the patch in the file's frame [m], 6 cm apart; the middle one is the patch."""
    steps = [0.06 * np.arange(-half, half + 1) for half in (2, 3, 4)]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1) + file_point(PATCH)


@pytest.fixture(scope="module")
def y_tal(captures: dict[str, PatchCapture], volume: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Dumps:
    """What y-tal reads from every capture, by the capture's name."""
    folder = tmp_path_factory.mktemp("y_tal")
    np.save(folder / "volume.npy", volume)
    special = {name: render_patch(folder / f"{name}.hdf5", *scan) for name, scan in FAULTY.items()}
    special["no_legs"] = render_patch(folder / "no_legs.hdf5", "single", *GRIDS["single"], legs=False)
    paths = [capture.path for capture in (captures | special).values()]
    # HOME: y-tal may leave a settings file there
    environment = {"HOME": str(folder), "PATH": os.environ.get("PATH", "")}
    run = subprocess.run([PEER, READ, folder, *paths], env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    return {path.stem: dict(np.load(folder / f"{path.stem}.npz")) for path in paths}


@pytest.mark.parametrize("name", GRIDS)
def test_h_is_what_we_wrote_with_x_first(captures: dict[str, PatchCapture], y_tal: Dumps, name: str) -> None:
    """y-tal's H[t, lx, ly, sx, sy] is our sample [ly, lx, sy, sx, t], bit for bit: its first grid axis is x."""
    with open_capture(captures[name].path) as capture:
        ours = capture.read_block().sum(axis=(0, 1)).transpose(4, 1, 0, 3, 2)
    if name != "exhaustive":
        ours = ours[:, 0, 0]
    assert ours.max() > 0
    np.testing.assert_array_equal(y_tal[name]["H"], ours)


@pytest.mark.parametrize("name", GRIDS)
def test_light_arrives_when_the_positions_of_y_tal_say(
    captures: dict[str, PatchCapture], y_tal: Dumps, name: str
) -> None:
    """H[:, i, j] belongs to sensor_grid_xyz[i, j] (and laser_grid_xyz[i, j]): path lengths from them give its bins."""
    found = y_tal[name]
    lasers, sensors = found["laser_grid_xyz"].astype(float), found["sensor_grid_xyz"].astype(float)
    if name == "exhaustive":
        lasers = lasers[:, :, None, None]  # H is (t, lx, ly, sx, sy)
    earliest, latest = arrival_bins(lasers, sensors, float(found["t_start"]), float(found["delta_t"]))
    assert earliest.shape == found["H"].shape[1:]
    first, last = lit_bins(found["H"])
    assert (first >= earliest).all()
    assert (last <= latest).all()


@pytest.mark.parametrize("name", GRIDS)
def test_positions_and_normals(captures: dict[str, PatchCapture], y_tal: Dumps, name: str) -> None:
    """Grid index [i, j] is column i and row j of the wall; X follows wall x, Z wall y; the wall faces -Y."""
    found, capture = y_tal[name], captures[name]
    for grid, points in (("sensor", capture.sensors.expected()), ("laser", capture.laser_points())):
        expected = points.swapaxes(0, 1)
        np.testing.assert_allclose(found[f"{grid}_grid_xyz"], expected, atol=FLOAT32)
        normals = np.broadcast_to([0, -1, 0], expected.shape)
        np.testing.assert_allclose(found[f"{grid}_grid_normals"], normals, atol=FLOAT32)
    np.testing.assert_allclose(found["laser_xyz"], file_point(LASER), atol=FLOAT32)
    np.testing.assert_allclose(found["sensor_xyz"], file_point(SENSOR), atol=FLOAT32)


@pytest.mark.parametrize("name", GRIDS)
def test_time_axis_and_conventions(y_tal: Dumps, name: str) -> None:
    """Bins, their start and width [m], the legs, the order of axes and the kind of scan come out as rendered."""
    found = y_tal[name]
    assert found["H"].shape[0] == N_BINS
    assert (found["delta_t"], found["t_start"]) == (np.float32(BIN_WIDTH), np.float32(START_OPL))
    assert found["t_accounts_first_and_last_bounces"]
    assert found["H_format"] == ("T_Lx_Ly_Sx_Sy" if name == "exhaustive" else "T_Sx_Sy")
    assert found["sensor_grid_format"] == found["laser_grid_format"] == "X_Y_3"
    assert found["misfit"] == ""
    assert found["is_confocal"] == found["is_laser_paired_to_sensor"] == (name == "confocal")
    np.testing.assert_allclose(found["volume_center"], file_point(PATCH), atol=FLOAT32)
    np.testing.assert_allclose(found["volume_size"], 3 * [PATCH_EDGE], rtol=1e-5)
    assert not found["volume_rotation"].any()


@pytest.mark.parametrize("name", GRIDS)
def test_back_projection_finds_the_patch(y_tal: Dumps, name: str) -> None:
    """y-tal's own reconstruction of our file is brightest where the patch is, the middle of the volume."""
    brightness = y_tal[name]["back_projection"]
    assert brightness.shape == (5, 7, 9)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (2, 3, 4)


@faulty("parses the scene_info it has just built as YAML")
@pytest.mark.parametrize("name", GRIDS)
def test_read_capture(y_tal: Dumps, name: str) -> None:
    """y-tal's one-call reader opens the file."""
    assert y_tal[name]["read_capture"] == ""


@faulty("takes a 7-D file with 6 columns for one with bounces there")
def test_six_sensor_columns(y_tal: Dumps) -> None:
    """A single capture with six columns of sensor points is (t, x, y)."""
    assert y_tal["six_columns"]["H"].shape == (N_BINS, 6, 4)


@faulty("drops every axis of length 1")
def test_one_laser_column(y_tal: Dumps) -> None:
    """An exhaustive capture keeps an axis of one laser point."""
    assert y_tal["one_laser_column"]["H"].shape == (N_BINS, 1, 2, 3, 5)


@faulty("takes the legs for included in every Z-NLOS file")
def test_legs_left_out(y_tal: Dumps) -> None:
    """A file that leaves out the first and last leg is taken for one that does."""
    assert not y_tal["no_legs"]["t_accounts_first_and_last_bounces"]
