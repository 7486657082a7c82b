"""The file of a capture at listed points, and what reads it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image
from support.rendering import configured, flat_wall

from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
from nlosrender.analysis.plots import plot_capture
from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.analysis.summary import summarise
from nlosrender.errors import ConfigError, FileError
from nlosrender.files.export.export import export_capture
from nlosrender.files.measured import measure_capture
from nlosrender.files.validation import check_file
from nlosrender.pipeline import render_capture

N = 23
BALL = {"type": "sphere", "center": [0.1, -0.05, 0.6], "radius": 0.05}


def described(scan: str, path: Path) -> dict[str, object]:
    angle = np.linspace(0, 2 * np.pi, N, endpoint=False)
    circle = np.stack([0.7 * np.cos(angle), 0.6 * np.sin(angle)], axis=-1).tolist()
    config = flat_wall(BALL, scan=scan, engine="auto", spp=None, target_error=0.05, bins=(0.0, 0.01, 400))
    config["capture"] |= {"sensor_points": circle, "sensor_grid": None, "account_first_and_last_bounces": True}
    return config | {"output": {"path": str(path), "ground_truth": ["depth"]}}


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A confocal capture on an ellipse."""
    path = tmp_path_factory.mktemp("circle") / "circle.hdf5"
    render_capture(configured(described("confocal", path)))
    return path


def test_the_file_is_one_row_and_says_that_it_is_a_list(circle: Path) -> None:
    """Positions are (3, 1, N) in the order given, the attribute names the lists, and the layout holds."""
    with h5py.File(circle) as file:
        positions = file["cameraGridPositions"][()]
        assert file["data"].shape == (1, 400, 6, 1, N)
        assert file["gt_depth"].shape == (1, N)
        assert file.attrs["point_lists"] == "sensor laser"
        np.testing.assert_array_equal(file["cameraGridPoints"], [N, 1])
        np.testing.assert_allclose(file["cameraGridSize"], np.ptp(positions[[0, 2], 0], axis=1), rtol=1e-6)
    assert positions.shape == (3, 1, N)
    angle = np.linspace(0, 2 * np.pi, N, endpoint=False)
    np.testing.assert_allclose(positions[0, 0], 0.7 * np.cos(angle), atol=1e-7)
    checked = check_file(circle)
    assert checked.is_ours
    assert checked.violations == ()
    assert summarise(circle)["point_lists"] == ["sensor", "laser"]


def test_a_ball_is_found_from_a_circle_of_points(circle: Path) -> None:
    """The brightest voxel of the backprojection is on the ball's near side, within two voxels."""
    settings = ReconstructionSettings(method="backprojection", wavelength=0.08, voxel_size=0.02)
    found = reconstruct_capture(circle, settings)
    z, y, x = np.unravel_index(int(found.volume.argmax()), found.volume.shape)
    place = np.array([found.grid.x[x], found.grid.y[y], found.grid.z[z]])
    assert abs(np.linalg.norm(place - BALL["center"]) - BALL["radius"]) < 0.04
    assert place[2] < BALL["center"][2]


def test_what_needs_a_grid_refuses_a_list(circle: Path, tmp_path: Path) -> None:
    """Formats without positions, phasor fields and zones say what they lack; y-tal's format has positions."""
    for name in ("fk", "lct", "learned"):
        with pytest.raises(FileError, match="sensor points are a list, and this format holds no positions"):
            export_capture(circle, tmp_path / "out.mat", name)
    with pytest.raises(FileError, match=r"not equally spaced.*--method backprojection"):
        reconstruct_capture(circle, ReconstructionSettings())
    report = export_capture(circle, tmp_path / "out.hdf5", "tal")
    assert any(f"a grid of {N} x 1" in loss for loss in report.losses)
    with h5py.File(tmp_path / "out.hdf5") as file, h5py.File(circle) as own:
        assert file["H"].shape[1:] == (N, 1)
        np.testing.assert_allclose(file["sensor_grid_xyz"][:, 0, 0], own["cameraGridPositions"][0, 0], atol=1e-6)
        own_sums = own["data"][()].sum(axis=(0, 1, 2, 3))
        np.testing.assert_allclose(file["H"][()].sum(axis=(0, 2)), own_sums, rtol=1e-4)


def test_a_physical_scale_needs_an_area(circle: Path, tmp_path: Path) -> None:
    """The cells of a grid have an area, points of a list do not; with one, its counts are a list, too."""
    keys = {"pulses": 1000, "wavelength_nm": 532.0, "aperture_solid_angle": 1e-3}
    sensor = configured(described("single", tmp_path / "x.hdf5") | {"sensor": keys}).sensor
    with pytest.raises(ConfigError, match="footprint_area: missing: points of a list have no cells"):
        measure_capture(circle, tmp_path / "counts.hdf5", sensor)
    assert sensor is not None
    seen = sensor.model_copy(update={"footprint_area": 1e-4})
    measure_capture(circle, tmp_path / "counts.hdf5", seen)
    assert summarise(tmp_path / "counts.hdf5")["point_lists"] == ["sensor", "laser"]


def test_a_plot_shows_the_points_where_they_are(circle: Path, tmp_path: Path) -> None:
    """Dots lie on the ellipse and nowhere else: the pictures' corners and middles stay dark."""
    frames = np.asarray(Image.open(plot_capture(circle, tmp_path / "circle.png")).convert("L"))[130:480]
    first = frames[:, 100:410]  # of five frames, the first
    assert (first > 120).sum() > 100
    assert first[150:200, 130:180].max() < 60


def test_lists_are_compared_point_by_point(circle: Path, tmp_path: Path) -> None:
    """A list agrees with itself, and is no match for a grid of as many points."""
    assert compare_captures(circle, circle, Tolerances()).failures == ()
    other = described("confocal", tmp_path / "grid.hdf5")
    other["capture"] |= {"sensor_points": None, "sensor_grid": {"nx": N, "ny": 1}}  # type: ignore[operator]
    render_capture(configured(other))
    compared = compare_captures(circle, tmp_path / "grid.hdf5", Tolerances())
    assert f"sensor points: {N} listed, the reference has {N} x 1" in [str(text) for text in compared.structure]
