"""Exports: orientation, frames and time of every format, with captures whose size differs on every axis."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat
from scipy.io.matlab import matfile_version
from support.point_captures import LASER_POINT, cells, point_light, points_header, write_light, write_points
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.constants import SPEED_OF_LIGHT
from nlosrender.errors import FileError, OptionError
from nlosrender.files.export.export import FORMATS, export_capture

POINT = (0.1, -0.2, 0.8)
SENSORS = cells(5, 4, 1.0, 0.8)  # equal spacings, as one format needs them
BINS = (0.7, 0.02, 260)
SAMPLES = {"fk": "meas", "lct": "rect_data", "phasor_mat": "rect_data", "learned": "measlr"}


def matlab(path: Path) -> dict[str, np.ndarray]:
    """Return the variables of a .mat file with their dimensions as MATLAB names them."""
    if matfile_version(path) != (2, 0):
        return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    with h5py.File(path) as file:  # h5py shows HDF5's order, the reverse of MATLAB's
        return {name: file[name][()].transpose() for name in file}


def on_the_wall(name: str, path: Path) -> np.ndarray:
    """Return an export's samples as (y ascending, x ascending, bin), by the orientation each program is known to have.

    f-k: (y down, x to the left, t); LCT: (x to the right, y down, t); diffraction: (y down, x to the right, t).
    """
    samples = matlab(path)[SAMPLES[name]]
    return {
        "fk": lambda: samples[::-1, ::-1],
        "learned": lambda: samples[::-1, ::-1],
        "lct": lambda: samples.transpose(1, 0, 2)[::-1],
        "phasor_mat": lambda: samples[::-1],
    }[name]()


def scan_for(name: str) -> str:
    """Return a scan type that a format takes."""
    return "single" if name == "phasor_mat" else "confocal"


@pytest.mark.parametrize("name", ["fk", "lct", "phasor_mat", "learned"])
def test_the_first_light_of_a_patch_is_where_the_program_has_that_place(tmp_path: Path, name: str) -> None:
    """A patch to the upper right of the wall (x, y > 0) is seen first where each format has that quarter."""
    sensors = cells(10, 8, 1.0, 0.8)  # even, so that no point is in the middle; half of it is 5 and 4
    header = points_header(scan_for(name), sensors, bins=(0.0, 0.009, 400))
    path = write_points(tmp_path / "x.hdf5", header, [(0.26, 0.17, 0.3)])
    report = export_capture(path, tmp_path / "x.mat", name, "3")
    samples = matlab(report.path)[SAMPLES[name]]
    first = (samples > 0).argmax(axis=-1)
    one, two = np.unravel_index(int(np.argmin(first)), first.shape)
    # the four rules, in indices from 0
    inside = {
        "fk": one < 4 and two < 5,
        "learned": one < 4 and two < 5,
        "lct": one >= 5 and two < 4,
        "phasor_mat": one < 4 and two >= 5,
    }
    assert samples.shape[:2] == ((10, 8) if name == "lct" else (8, 10))
    assert inside[name], (one, two)


@pytest.mark.parametrize("name", FORMATS)
def test_the_order_of_a_captures_rows_does_not_show(tmp_path: Path, name: str) -> None:
    """A capture stored from the top left, from the right, or column by column, exports as the original does."""
    scan = "exhaustive" if name == "tal" else scan_for(name)
    header = points_header(scan, SENSORS, bins=BINS, legs=True)
    light = point_light(header, [POINT])
    expected = contents(export_capture(write_light(tmp_path / "a.hdf5", header, light), tmp_path / "a.out", name).path)
    for turn in (lambda grid: grid[::-1], lambda grid: grid[:, ::-1], lambda grid: grid.swapaxes(0, 1)):
        lasers = header.laser_positions if scan == "single" else turn(header.laser_positions)
        sensors = turn(SENSORS)
        turned = points_header(
            scan, sensors, lasers if scan != "confocal" else sensors, bins=BINS, legs=True
        )  # fmt: skip
        over_sensors = np.moveaxis(turn(np.moveaxis(light, (2, 3), (0, 1))), (0, 1), (2, 3))
        stored = turn(over_sensors) if scan == "exhaustive" else over_sensors
        report = export_capture(write_light(tmp_path / "b.hdf5", turned, stored), tmp_path / "b.out", name)
        found = contents(report.path)
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            np.testing.assert_array_equal(found[key], value, err_msg=key)


def contents(path: Path) -> dict[str, object]:
    """Return everything an export says but the name of its source."""
    if path.read_bytes()[:4] == b"\x89HDF":
        with h5py.File(path) as file:
            return {name: file[name][()] for name in file if name != "scene_info"}
    return matlab(path)


@pytest.mark.parametrize("frame", ["znlos", "scene"])
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_tal_has_x_first_and_the_wall_in_z_0(tmp_path: Path, scan: str, frame: str) -> None:
    """H[t, lx, ly, sx, sy] is our sample [ly, lx, sy, sx, t]; positions are the wall's own, whatever the frame."""
    header = points_header(scan, SENSORS, bins=BINS, legs=True, frame=frame)
    path = write_points(tmp_path / "x.hdf5", header, [POINT])
    report = export_capture(path, tmp_path / "tal.hdf5", "tal", "3", legs="keep")
    assert report.losses == ("the legs are left in: of y-tal's methods only bp and pf_dev take them off",)
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


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_tal_takes_the_legs_off(tmp_path: Path, scan: str) -> None:
    """By default every histogram's mean time is its path on the scene's side, energy is kept, and it is said."""
    header = points_header(scan, SENSORS, bins=BINS, legs=True)
    report = export_capture(write_points(tmp_path / "x.hdf5", header, [POINT]), tmp_path / "x.out", "tal", "3")
    assert any("legs laser -> wall and wall -> sensor are taken off" in loss for loss in report.losses)
    with h5py.File(report.path) as file:
        stored = file["H"][()] if scan == "exhaustive" else file["H"][()][:, None, None]
        assert (file["t_start"][()], bool(file["t_accounts_first_and_last_bounces"][()])) == (0, False)
    found = stored.transpose(2, 1, 4, 3, 0)
    light = point_light(header, [POINT])
    np.testing.assert_allclose(found.sum(axis=-1), light.sum(axis=-1), rtol=1e-5)  # float32
    mean = (np.arange(found.shape[-1]) + 0.5) @ found[..., None] / found.sum(axis=-1)[..., None]
    back = np.linalg.norm(SENSORS - POINT, axis=-1)
    forth = back if scan == "confocal" else np.linalg.norm(header.laser_positions - POINT, axis=-1)[..., None, None]
    np.testing.assert_allclose(mean[..., 0] * 0.02, np.broadcast_to(forth + back, light.shape[:-1]), atol=1e-4)


@pytest.mark.parametrize(("legs", "start"), [(True, 0.7), (False, 0.55), (True, -0.31)])
def test_fk_histograms_start_at_the_wall_once_shifted(tmp_path: Path, legs: bool, start: float) -> None:
    """Shifted by floor(tofgrid / bin), as the authors' program does it, light arrives at 2 r to within two bins."""
    header = points_header("confocal", SENSORS, bins=(start, 0.02, 310), legs=legs)
    path = write_points(tmp_path / "x.hdf5", header, [POINT])
    report = export_capture(path, tmp_path / "fk.mat", "fk", "3")
    found = matlab(report.path)
    bin_ps = found["bin_resolution"].item() * 1e12
    assert bin_ps == pytest.approx(0.02 / SPEED_OF_LIGHT * 1e12)
    assert found["wall_size"].item() == 2.0  # the header's, of which width is the larger
    light, delay = on_the_wall("fk", report.path), found["tofgrid"][::-1, ::-1]
    assert light.shape[2] >= 512
    distance = np.linalg.norm(SENSORS - POINT, axis=-1)
    for row, column in np.ndindex(4, 5):
        shifted = np.roll(light[row, column], -int(delay[row, column] // bin_ps))
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
        rectified = on_the_wall(name, report.path)
        n_bins = rectified.shape[2]
        # the light-cone transform resamples powers of two; diffraction halves the number twice
        assert n_bins & (n_bins - 1) == 0 if name == "lct" else n_bins % 4 == 0
        light = point_light(header, [POINT])[0, 0]
        np.testing.assert_allclose(rectified.sum(axis=-1), light.sum(axis=-1), rtol=1e-5)
        mean = (np.arange(n_bins) + 0.5) @ rectified[..., None] / rectified.sum(axis=-1)[..., None]
        back = np.linalg.norm(SENSORS - POINT, axis=-1)
        forth = back if name == "lct" else np.linalg.norm(np.subtract(POINT, (*LASER_POINT, 0.0)))
        np.testing.assert_allclose(mean[..., 0] * 0.02, forth + back, atol=1e-4)  # float32 sums
        assert any("counted from the wall" in loss for loss in report.losses) == (legs or start != 0)


@pytest.mark.parametrize(("key", "width"), [("final_meas", 0.004), ("data", 0.013)])
def test_networks_get_512_bins_of_32_ps(tmp_path: Path, key: str, width: float) -> None:
    """Whatever the capture's bins, mean times are paths without legs; `data` has time first, what is cut is said."""
    header = points_header("confocal", SENSORS, bins=(0.7, width, 1100), legs=True)
    path = write_points(tmp_path / "x.hdf5", header, [POINT])
    report = export_capture(path, tmp_path / "x.mat", "learned", "3", key=key)
    samples = matlab(report.path)[key]
    light = (samples.transpose(1, 2, 0) if key == "data" else samples)[::-1, ::-1]
    assert light.shape == (4, 5, 512)
    np.testing.assert_allclose(light.sum(axis=-1), point_light(header, [POINT])[0, 0].sum(axis=-1), rtol=1e-5)
    mean = (np.arange(512) + 0.5) @ light[..., None] / light.sum(axis=-1)[..., None]
    bin_opl = 32e-12 * SPEED_OF_LIGHT
    path_lengths = 2 * np.linalg.norm(SENSORS - POINT, axis=-1)
    # light is somewhere in the bin it falls into, and before that somewhere in the capture's
    np.testing.assert_allclose(mean[..., 0] * bin_opl, path_lengths, rtol=0, atol=(bin_opl + width) / 2)
    assert not any("left out" in loss for loss in report.losses)
    far = points_header("confocal", SENSORS, bins=(0.0, 0.013, 1100))
    path = write_points(tmp_path / "far.hdf5", far, [POINT, (0.0, 0.0, 6.0)])  # 512 bins end at 4.91 m
    report = export_capture(path, tmp_path / "far.mat", "learned", "3", key=key)
    strength = [np.sum(np.linalg.norm(SENSORS - place, axis=-1) ** -4.0) for place in (POINT, (0.0, 0.0, 6.0))]
    share = 100 * strength[1] / sum(strength)
    assert any(loss.startswith(f"{share:.3g} % of the light") for loss in report.losses), report.losses


def test_phasor_mat_names_spacing_bins_and_the_fixed_point(tmp_path: Path) -> None:
    """ts in seconds, one spacing, what the aperture spans, and the laser point's (row, column) from 1."""
    header = points_header("single", SENSORS, cells(1, 1, 1, 1) + np.array([0.2, -0.1, 0.0]))
    report = export_capture(write_points(tmp_path / "on.hdf5", header, [POINT]), tmp_path / "on.mat", "phasor_mat", "3")
    found = matlab(report.path)
    assert found["ts"].item() == pytest.approx(0.01 / SPEED_OF_LIGHT)
    assert found["sampling_spacing"].item() == pytest.approx(0.2)
    np.testing.assert_allclose(found["aperturefullsize"], [[0.6, 0.8]], rtol=1e-6)  # float32 positions
    # x = 0.2 is the fourth of -0.4 to 0.4, y = -0.1 the third from the top of 0.3 to -0.3
    np.testing.assert_array_equal(found["SPAD_index"], [[3, 4]])
    assert report.losses == ()
    header = points_header("single", SENSORS, cells(1, 1, 1, 1) + np.array([0.13, -0.1, 0.0]))
    report = export_capture(write_points(tmp_path / "off.hdf5", header, [POINT]), tmp_path / "off.mat", "phasor_mat")
    assert any("not on the sensor grid" in loss for loss in report.losses)
    assert any("bounces 2, 3 are summed" in loss for loss in report.losses)


@pytest.mark.parametrize("name", ["fk", "phasor_mat"])
def test_version_73_files_are_matlabs_own(tmp_path: Path, name: str) -> None:
    """512 bytes of MATLAB's before HDF5's, version 2.0, and the class of every variable."""
    path = write_points(tmp_path / "x.hdf5", points_header(scan_for(name), SENSORS), [POINT])
    report = export_capture(path, tmp_path / "x.mat", name)
    content = report.path.read_bytes()
    assert content.startswith(b"MATLAB 7.3 MAT-file")
    assert content[116:128] == bytes(8) + b"\x00\x02IM"
    assert content[512:520] == b"\x89HDF\r\n\x1a\n"
    assert matfile_version(report.path) == (2, 0)
    with h5py.File(report.path) as file:
        classes = {name: file[name].attrs["MATLAB_class"] for name in file}
        assert classes.pop(SAMPLES[name]) == b"single"
        assert set(classes.values()) == {b"double"}


FULL_DISK = """
import resource, sys
from nlosrender.errors import FileError
from nlosrender.files.export.export import export_capture
for source, name in zip(sys.argv[1::2], sys.argv[2::2]):
    # a limit on the size of files stands in for the full disk: the same error comes from the same call
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    try:
        export_capture(source, source + ".out", name, "3")
    except FileError as error:
        print(name, error)
"""


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    """Every format says that the disk is full; HDF5 alone would end the process."""
    arguments = []
    for name in FORMATS:
        header = points_header(scan_for(name), cells(10, 8, 1.0, 0.8))
        light = np.random.default_rng(0).random((1, 1, 8, 10, 400))  # does not pack
        arguments += [str(write_light(tmp_path / f"{name}.hdf5", header, light)), name]
    before = sorted(tmp_path.iterdir())
    done = subprocess.run([sys.executable, "-c", FULL_DISK, *arguments], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(FORMATS)
    assert all("cannot be written: File too large" in line for line in lines)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_a_capture_beyond_2_gib_is_exported(tmp_path: Path, write_sparse: Callable) -> None:
    """512 x 512 points of 2048 bins fit into no version 7 file, but into 7.3."""
    path = write_sparse(tmp_path / "large.hdf5", 512, 2048, lit=(100, 30, 700))
    report = export_capture(path, tmp_path / "large.mat", "fk", "3")
    with h5py.File(report.path) as file:
        assert file["meas"].shape == (2048, 512, 512)
        assert file["meas"][700, 511 - 30, 511 - 100] == 1
    with pytest.raises(FileError, match="ends at 2 GiB"):
        export_capture(path, tmp_path / "large.mat", "lct", "3")


@pytest.fixture
def write_sparse() -> Callable:
    """Writer of a confocal capture with one lit sample: ``write_sparse(path, n, n_bins, lit=(row, column, bin))``."""

    def write(path: Path, n: int, n_bins: int, lit: tuple[int, int, int]) -> Path:
        header = points_header("confocal", cells(4, 4, 1.0, 1.0))
        write_points(path, header, [POINT])
        sensors = cells(n, n, 1.0, 1.0)
        row, column, time_bin = lit
        with h5py.File(path, "r+") as file:
            del file["data"], file["cameraGridPositions"], file["laserGridPositions"]
            del file["cameraGridNormals"], file["laserGridNormals"]
            positions = np.stack([sensors[..., 0], np.zeros((n, n)), sensors[..., 1]]).astype("f4")
            normals = np.broadcast_to(np.array([0, -1, 0], "f4")[:, None, None], positions.shape)
            for grid in ("camera", "laser"):
                file[f"{grid}GridPositions"], file[f"{grid}GridNormals"] = positions, normals
            data = file.create_dataset("data", (1, n_bins, 6, n, n), "f4", chunks=(1, n_bins, 1, 16, 8))
            data[0, time_bin, 1, row, column] = 1
            data.attrs["bounce_indices"] = [0, 1]
        return path

    return write


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    """Pairs into confocal formats, grids into single ones, unequal spacings, curved walls, unknown names."""
    paths = {
        scan: write_points(tmp_path / f"{scan}.hdf5", points_header(scan, SENSORS), [POINT])
        for scan in ("single", "confocal", "exhaustive")
    }
    for name, scan in (("fk", "single"), ("lct", "exhaustive"), ("learned", "single")):
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
    sheared = SENSORS + np.array([0.3, 0.0, 0.0]) * SENSORS[..., 1:2]
    skew = write_points(tmp_path / "skew.hdf5", points_header("confocal", sheared), [POINT])
    with pytest.raises(FileError, match=r"no grid along the wall's axes.*tal"):
        export_capture(skew, tmp_path / "out.mat", "fk")
    with pytest.raises(OptionError, match="need one of tal, fk, lct, phasor_mat, learned"):
        export_capture(paths["single"], tmp_path / "out.mat", "mat")
    with pytest.raises(OptionError, match="--legs: belongs to --format tal"):
        export_capture(paths["confocal"], tmp_path / "out.mat", "fk", legs="keep")
    with pytest.raises(OptionError, match="--key: got '2 b'"):
        export_capture(paths["confocal"], tmp_path / "out.mat", "learned", key="2 b")
    with pytest.raises(FileError, match="is read for this and would be replaced"):
        export_capture(paths["single"], paths["single"], "tal")
    assert not list(tmp_path.glob("*out*"))


def test_the_command(tmp_path: Path) -> None:
    """Default names, the report and its notes."""
    path = write_points(tmp_path / "scan.hdf5", points_header("confocal", SENSORS), [POINT])
    for name in ("tal", "fk", "lct", "learned"):
        result = CliRunner().invoke(app, ["export", str(path), "--format", name, "--bounces", "3", "--json"])
        assert result.exit_code == 0, result.output
        report = json.loads(result.stdout)
        assert Path(report["written"]).exists()
        assert Path(report["written"]).stem == f"scan-{name}"
        assert bool(report["losses"]) == (name != "tal")
    result = CliRunner().invoke(app, ["export", str(path), "--format", "tal", "--legs", "keep"])
    assert f"wrote {tmp_path / 'scan-tal.hdf5'}" in result.output
    assert "note: bounces 2, 3 are summed" in result.output
