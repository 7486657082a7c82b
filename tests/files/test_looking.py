"""Summaries and pictures of captures."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import h5py
import matplotlib.image
import numpy as np
import pytest
from support.partial_captures import write_capture
from support.point_captures import cells, points_header, write_light, write_points

from nlosrender.analysis import laser_view as views
from nlosrender.analysis.capture_table import summary_rows
from nlosrender.analysis.plots import plot_capture
from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.analysis.summary import summarise
from nlosrender.errors import FileError, OptionError
from nlosrender.files.provenance import provenance_attributes
from nlosrender.files.reading.reader import open_capture


def test_summary_says_what_was_written(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Grids as (nx, ny), the exact time axis, bounces by name, provenance unpacked; all of it JSON."""
    provenance = provenance_attributes({"a": 1}, "abc", engine="path", seed=3) | {"samples": 64, "error_estimate": 0.02}
    write_capture(tmp_path / "a.hdf5", header_of(), {**provenance, "seconds": json.dumps({"render": 1.5})})
    summary = summarise(tmp_path / "a.hdf5")
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    expected = {
        "scan_type": "exhaustive",
        "sensor_grid": [5, 4],
        "laser_grid": [3, 2],
        "n_bins": 7,
        "bin_width_opl": 0.003,
        "start_opl": 0.7,
        "bounces": [2, 3],
        "split_bounces": True,
        "max_bounces": 3,
        "channels": "grey",
        "frame": "znlos",
        "account_first_and_last_bounces": True,
        "engine": "path",
        "written_by": "nlosrender",
        "samples": 64,
        "error_estimate": 0.02,
        "config_hash": "abc",
        "seconds": {"render": 1.5},
        "data_shape": [1, 7, 6, 4, 5, 2, 3],
        "size_of_samples": 7 * 6 * 4 * 5 * 2 * 3 * 4,
        "has_variance": False,
    }
    assert {key: summary[key] for key in expected} == expected
    # 7 bins of 3 mm from 0.7 m; 3 mm of light are 10.007 ps
    assert summary["end_opl"] == pytest.approx(0.721, rel=1e-12)
    assert summary["bin_width_ps"] == pytest.approx(10.006923, rel=1e-7)


def test_points_without_extent_state_none(tmp_path: Path) -> None:
    """A single laser point, and a camera's points in no plane, are not told to lie within 0 x 0 m."""
    path = tmp_path / "a.hdf5"
    write_light(path, points_header("single", cells(5, 3, 2.0, 1.6), bins=(0.0, 0.01, 7)), np.zeros((1, 1, 3, 5, 7)))
    with h5py.File(path, "r+") as file:
        file["laserGridSize"][...] = 0
    rows = dict(summary_rows(summarise(path)))
    assert (rows["sensor points"], rows["laser points"]) == ("5 x 3 over 2 x 1.6 m", "1 x 1")


def test_summary_of_files_by_others(tmp_path: Path) -> None:
    """What a file does not say is None; NaN and text that is not JSON do no harm."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["data"] = np.zeros((1, 7, 6, 4, 5), "f4")
        file["deltaT"] = 0.003
        file["t0"] = 0.0
        file["cameraGridSize"] = [np.nan, 1.0]
        file.attrs["seconds"] = "[" * 100_000
        file.attrs["error_estimate"] = np.nan
    summary = summarise(tmp_path / "a.hdf5")
    json.dumps(summary, allow_nan=False)
    assert summary["sensor_grid_size"] == [None, 1.0]
    for key in ("engine", "bounces", "split_bounces", "frame", "error_estimate", "laser_grid_size", "created"):
        assert summary[key] is None, key


def test_summary_reads_no_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, write_capture: Callable
) -> None:
    """No read of a dataset with more than a handful of numbers happens."""
    write_capture(tmp_path / "a.hdf5", header_of())
    true_read = h5py.Dataset.__getitem__

    def read(dataset: h5py.Dataset, *arguments: object) -> object:
        assert dataset.size <= 16, dataset.name
        return true_read(dataset, *arguments)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", read)
    assert summarise(tmp_path / "a.hdf5")["n_bins"] == 7
    with pytest.raises(AssertionError, match="data"), open_capture(tmp_path / "a.hdf5") as capture:
        capture.read_block()  # the guard above does bite


@pytest.mark.parametrize("band_bytes", [1, 10**9])
def test_views_are_sums_of_the_samples(
    tmp_path: Path, header_of: Callable, write_capture: Callable, band_bytes: int
) -> None:
    """Whatever the memory allows at a time, the sums over the wall, bounces and time are those of the whole block."""
    block = write_capture(tmp_path / "a.hdf5", header_of(n_channels=3)).astype(np.float64).mean(axis=0)
    one = block[:, 1, 2]  # (bounce, sensor_y, sensor_x, bin)
    with open_capture(tmp_path / "a.hdf5") as capture:
        view = views.laser_view(capture, (1, 2), band_bytes)
        frames = views.wall_frames(capture, (1, 2), [slice(0, 1), slice(2, 5)], band_bytes)
        point = views.point_histograms(capture, (1, 2), (3, 4))
        row = views.row_over_time(capture, (1, 2), 2)
    # float64 sums of 280 numbers below 1 in another order
    close = {"rtol": 1e-12}
    np.testing.assert_allclose(view.wall, one.sum(axis=(0, 3)), **close)
    np.testing.assert_allclose(view.bounces, one.sum(axis=(1, 2, 3)), **close)
    np.testing.assert_allclose(view.time, one.sum(axis=(0, 1, 2)), **close)
    np.testing.assert_allclose(frames, [one[..., :1].sum(axis=(0, 3)), one[..., 2:5].sum(axis=(0, 3))], **close)
    np.testing.assert_allclose(point, one[:, 3, 4], **close)
    np.testing.assert_allclose(row, one[:, 2].sum(axis=0), **close)
    assert view.brightest == tuple(np.argwhere(view.wall == view.wall.max())[0])


def test_moments_follow_the_light() -> None:
    """Frames lie where light arrives, in order; without light or with one bin there is one frame."""
    time = np.zeros(1000)
    time[400:500] = 1.0
    bins = views.frame_bins(time)
    # shares 0.02, 0.2, 0.45, 0.7, 0.95 of 100 equal bins
    assert bins == [401, 419, 444, 469, 494]
    first, last = views.lit_window(time)
    assert 380 < first < 400
    assert 500 <= last < 520
    assert views.frame_bins(np.zeros(9)) == [4]
    assert views.lit_window(np.zeros(9)) == (0, 8)
    assert views.frame_bins(np.ones(1)) == [0]


@pytest.mark.parametrize(
    ("scan_type", "changes"),
    [
        ("exhaustive", {}),
        ("confocal", {"n_channels": 3, "bounce_indices": (1,), "split_bounces": False}),
        ("single", {"n_bins": 1, "bounce_indices": (1,), "sensor_grid_size": (0.0, 0.0)}),
    ],
)
def test_pictures(tmp_path: Path, header_of: Callable, write_capture: Callable, scan_type: str, changes: dict) -> None:
    """Every kind of capture gives a picture of one size, that is neither empty nor accompanied by other files."""
    name = "cost $x_{1$.hdf5"  # not a formula
    write_capture(tmp_path / name, header_of(scan_type, **changes), {"error_estimate": 0.01})
    assert plot_capture(tmp_path / name, tmp_path / "a.png") == tmp_path / "a.png"
    image = matplotlib.image.imread(tmp_path / "a.png")
    assert image.shape[:2] == (988, 1820)
    assert image[..., :3].std() > 0.05
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.png", name]


def test_a_dark_capture_has_a_picture(tmp_path: Path, header_of: Callable) -> None:
    """No light at all is no reason to fail."""
    write_capture(tmp_path / "a.hdf5", header_of())
    plot_capture(tmp_path / "a.hdf5", tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("picture", "points", "error", "message"),
    [
        ("a.png", {"laser": (2, 0)}, OptionError, r"--laser: got 2,0, need a row from 0 to 1 and a column from 0 to 2"),
        ("a.png", {"pixel": (0, 5)}, OptionError, r"--pixel: got 0,5, need a row from 0 to 3 and a column from 0 to 4"),
        ("a.jpeg", {}, OptionError, r"--output: got 'a.jpeg', need a name that ends in one of \.png, \.pdf, \.svg"),
        ("none/a.png", {}, FileError, r"there is no folder"),
        ("capture.png", {}, FileError, r"is read for this and would be replaced"),
    ],
)
def test_pictures_that_cannot_be(
    tmp_path: Path,
    header_of: Callable,
    write_capture: Callable,
    picture: str,
    points: dict,
    error: type[Exception],
    message: str,
) -> None:
    """Points outside and unusable names are refused; nothing is written, and never over the capture."""
    path = tmp_path / "capture.png"
    write_capture(path, header_of())
    before = path.read_bytes()
    with contextlib.chdir(tmp_path), pytest.raises(error, match=message):
        plot_capture(path, Path(picture), **points)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def spoilt(path: Path, value: float, everywhere: bool) -> Path:
    """Write a confocal capture whose samples, or one of them, are ``value``."""
    write_points(path, points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, 0.8)])
    with h5py.File(path, "r+") as file:
        samples = file["data"][...]
        samples[(...,) if everywhere else (0, 100, 1, 2, 3)] = value
        file["data"][...] = samples
    return path


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_picture_of_numbers_that_are_none_is_refused(tmp_path: Path, value: float, everywhere: bool) -> None:
    """One such sample makes every sum one; the message says what is wrong and which command tells where."""
    path = spoilt(tmp_path / "a.hdf5", value, everywhere)
    with pytest.raises(FileError, match=r"a\.hdf5: data holds numbers that are not finite; see `nlosrender info"):
        plot_capture(path, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


def test_a_picture_of_negative_numbers_is_drawn(tmp_path: Path) -> None:
    """Measured captures dip below zero, dark ones with their background taken off everywhere."""
    assert plot_capture(spoilt(tmp_path / "a.hdf5", -1.0, everywhere=True), tmp_path / "a.png").exists()


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_volume_that_overflows_is_refused(tmp_path: Path) -> None:
    """Sums of samples at the end of float32 are infinite: no volume, and no picture of one."""
    path = spoilt(tmp_path / "a.hdf5", 3e38, everywhere=True)
    with pytest.raises(FileError, match="so large that the volume is not finite"):
        reconstruct_capture(path, ReconstructionSettings(voxels=8))
