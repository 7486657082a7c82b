"""Exports: axes, frames and time of every format, with captures whose size differs on every axis."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from point_captures import LASER_POINT, cells, point_light, points_header, write_points
from scipy.io import loadmat
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.errors import FileError, OptionError
from nlosrender.files.exports import FORMATS, export_capture
from nlosrender.units import SPEED_OF_LIGHT

POINT = (0.1, -0.2, 0.8)
SENSORS = cells(5, 4, 1.0, 0.8)  # equal spacings, as one format needs them
BINS = (0.7, 0.02, 260)


@pytest.mark.parametrize("frame", ["znlos", "scene"])
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_tal_has_x_first_and_the_wall_in_z_0(tmp_path: Path, scan: str, frame: str) -> None:
    """H[t, lx, ly, sx, sy] is our sample [ly, lx, sy, sx, t]; positions are the wall's own, whatever the frame."""
    header = points_header(scan, SENSORS, bins=BINS, legs=True, frame=frame)
    path = write_points(tmp_path / "x.hdf5", header, [POINT])
    report = export_capture(path, tmp_path / "tal.hdf5", "tal", "3")
    assert report.losses == ()
    light = point_light(header, [POINT]).astype(np.float32)
    with h5py.File(report.path) as file:
        expected = light.transpose(4, 1, 0, 3, 2)
        if scan != "exhaustive":
            expected = expected[:, 0, 0]
        np.testing.assert_array_equal(file["H"], expected)
        assert file["H_format"][0] == (2 if scan == "exhaustive" else 1)
        # float32 positions of up to 4 m in the file
        np.testing.assert_allclose(file["sensor_grid_xyz"], SENSORS.transpose(1, 0, 2), atol=1e-6)
        np.testing.assert_allclose(file["laser_grid_xyz"], header.laser_positions.transpose(1, 0, 2), atol=1e-6)
        np.testing.assert_allclose(file["laser_xyz"], header.laser_position, atol=1e-6)
        np.testing.assert_allclose(file["sensor_xyz"], header.sensor_position, atol=1e-6)
        np.testing.assert_allclose(file["sensor_grid_normals"], np.broadcast_to([0, 0, 1.0], (5, 4, 3)), atol=1e-6)
        assert (file["delta_t"][()], file["t_start"][()]) == (0.02, 0.7)
        assert file["t_accounts_first_and_last_bounces"][()]
        volume = json.loads(file["scene_info"].asstr()[()])["volume"]
        np.testing.assert_allclose(volume["center"], [0.05, 0.05, 0.85], atol=1e-6)
        np.testing.assert_allclose(volume["size"], [0.7, 0.5, 0.5], atol=1e-6)


@pytest.mark.parametrize(("legs", "start"), [(True, 0.7), (False, 0.55), (True, -0.31)])
def test_fk_histograms_start_at_the_wall_once_shifted(tmp_path: Path, legs: bool, start: float) -> None:
    """Shifted by floor(tofgrid / bin), as the authors' program does it, light arrives at 2 r to within two bins."""
    header = points_header("confocal", SENSORS, bins=(start, 0.02, 310), legs=legs)
    path = write_points(tmp_path / "x.hdf5", header, [POINT])
    report = export_capture(path, tmp_path / "fk.mat", "fk", "3")
    found = loadmat(report.path)
    bin_ps = found["bin_resolution"].item() * 1e12
    assert bin_ps == pytest.approx(0.02 / SPEED_OF_LIGHT * 1e12)
    assert found["wall_size"].item() == 2.0  # the header's, of which width is the larger
    distance = np.linalg.norm(SENSORS - POINT, axis=-1)
    for row, column in np.ndindex(4, 5):
        shifted = np.roll(found["meas"][row, column], -int(found["tofgrid"][row, column] // bin_ps))
        mean = (np.arange(len(shifted)) + 0.5) @ shifted / shifted.sum() * 0.02
        assert 0 <= mean - 2 * distance[row, column] + 1e-6 < 0.02  # floor: late by less than a bin
    assert any("grid is 5 x 4" in loss for loss in report.losses)
    assert any("32 ps" in loss for loss in report.losses)


@pytest.mark.parametrize(("legs", "start"), [(True, 0.7), (False, 0.0), (False, 0.55), (True, -0.31)])
def test_lct_and_phasor_time_is_counted_from_the_wall(tmp_path: Path, legs: bool, start: float) -> None:
    """The mean arrival in every rectified histogram is its path length on the scene's side, energy is kept."""
    for scan, name in (("confocal", "lct"), ("single", "phasor_mat")):
        header = points_header(scan, SENSORS, bins=(start, 0.02, 310), legs=legs)
        path = write_points(tmp_path / f"{scan}.hdf5", header, [POINT])
        report = export_capture(path, tmp_path / f"{name}.mat", name, "3")
        found = loadmat(report.path)["rect_data"]
        rectified = found if name == "lct" else found.transpose(2, 1, 0)  # (y, x, T) and (T, x, y)
        light = point_light(header, [POINT])[0, 0]
        np.testing.assert_allclose(rectified.sum(axis=-1), light.sum(axis=-1), rtol=1e-5)
        mean = (np.arange(rectified.shape[2]) + 0.5) @ rectified[..., None] / rectified.sum(axis=-1)[..., None]
        back = np.linalg.norm(SENSORS - POINT, axis=-1)
        forth = back if name == "lct" else np.linalg.norm(np.subtract(POINT, (*LASER_POINT, 0.0)))
        np.testing.assert_allclose(mean[..., 0] * 0.02, forth + back, atol=1e-4)  # float32 sums
        assert any("counted from the wall" in loss for loss in report.losses) == (legs or start != 0)


def test_phasor_mat_names_spacing_bins_and_the_fixed_point(tmp_path: Path) -> None:
    """ts in seconds, one spacing, and the laser point's place on the grid as (x, y) from 0."""
    header = points_header("single", SENSORS, cells(1, 1, 1, 1) + np.array([0.2, -0.1, 0.0]))
    report = export_capture(write_points(tmp_path / "on.hdf5", header, [POINT]), tmp_path / "on.mat", "phasor_mat", "3")
    found = loadmat(report.path)
    assert found["ts"].item() == pytest.approx(0.01 / SPEED_OF_LIGHT)
    assert found["sampling_spacing"].item() == pytest.approx(0.2)
    np.testing.assert_array_equal(found["SPAD_index"], [[3, 1]])
    assert report.losses == ()
    header = points_header("single", SENSORS, cells(1, 1, 1, 1) + np.array([0.13, -0.1, 0.0]))
    report = export_capture(write_points(tmp_path / "off.hdf5", header, [POINT]), tmp_path / "off.mat", "phasor_mat")
    assert any("not on the sensor grid" in loss for loss in report.losses)
    assert any("bounces 2, 3 are summed" in loss for loss in report.losses)


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    """Pairs into confocal formats, grids into single ones, unequal spacings, curved walls, unknown names."""
    paths = {
        scan: write_points(tmp_path / f"{scan}.hdf5", points_header(scan, SENSORS), [POINT])
        for scan in ("single", "confocal", "exhaustive")
    }
    for name, scan in (("fk", "single"), ("lct", "exhaustive")):
        with pytest.raises(FileError, match=f"is {scan}: .* confocal captures only"):
            export_capture(paths[scan], tmp_path / "out.mat", name)
    for scan in ("confocal", "exhaustive"):
        with pytest.raises(FileError, match=f"is {scan}: .* one fixed point"):
            export_capture(paths[scan], tmp_path / "out.mat", "phasor_mat")
    uneven = write_points(tmp_path / "uneven.hdf5", points_header("single", cells(5, 4, 1.0, 1.0)), [POINT])
    with pytest.raises(FileError, match=r"0.2 m apart along x and 0.25 m along y"):
        export_capture(uneven, tmp_path / "out.mat", "phasor_mat")
    bent = SENSORS + np.array([0.0, 0.0, 1.0]) * SENSORS[..., :1] ** 2
    curved = write_points(tmp_path / "bent.hdf5", points_header("confocal", bent, planar_wall=False), [POINT])
    with pytest.raises(FileError, match=r"curved relay wall.*tal"):
        export_capture(curved, tmp_path / "out.mat", "lct")
    with pytest.raises(OptionError, match="need one of tal, fk, lct, phasor_mat"):
        export_capture(paths["single"], tmp_path / "out.mat", "mat")
    with pytest.raises(FileError, match="is the capture itself"):
        export_capture(paths["single"], paths["single"], "tal")
    assert not list(tmp_path.glob("*out*"))


def test_the_command(tmp_path: Path) -> None:
    """Default names, the report and its notes."""
    path = write_points(tmp_path / "scan.hdf5", points_header("confocal", SENSORS), [POINT])
    for name in FORMATS[:3]:
        result = CliRunner().invoke(app, ["export", str(path), "--format", name, "--bounces", "3", "--json"])
        assert result.exit_code == 0, result.output
        report = json.loads(result.stdout)
        assert Path(report["written"]).exists()
        assert Path(report["written"]).stem == f"scan-{name}"
        assert bool(report["losses"]) == (name != "tal")
    result = CliRunner().invoke(app, ["export", str(path), "--format", "tal"])
    assert f"wrote {tmp_path / 'scan-tal.hdf5'}" in result.output
    assert "note: bounces 2, 3 are summed" in result.output
