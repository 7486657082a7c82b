"""Each rule of the layout is checked: break it in a flawless file, and exactly that is reported."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import validate_file

from nlosrender.files.layout import DATASETS


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("frame", ["znlos", "scene"])
@pytest.mark.parametrize("variance", [True, False])
def test_what_is_written_is_flawless(
    tmp_path: Path, header_of: Callable, write_capture: Callable, scan_type: str, frame: str, variance: bool
) -> None:
    """The writer's files have no violations."""
    write_capture(tmp_path / "a.hdf5", header_of(scan_type, frame=frame, n_channels=3), store_variance=variance)
    assert validate_file(tmp_path / "a.hdf5") == []


def replaced(name: str, value: object) -> Callable[[h5py.File], None]:
    """Return a change that stores another value (None: nothing) under ``name``."""

    def change(file: h5py.File) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return change


def edited(name: str, index: object, value: float) -> Callable[[h5py.File], None]:
    """Return a change of some elements."""

    def change(file: h5py.File) -> None:
        file[name][index] = value

    return change


def attribute(name: str, value: object, dataset: str = "/") -> Callable[[h5py.File], None]:
    """Return a change of an attribute; None removes it."""

    def change(file: h5py.File) -> None:
        del file[dataset].attrs[name]
        if value is not None:
            file[dataset].attrs[name] = value

    return change


BROKEN: list[tuple[Callable[[h5py.File], None], str]] = [
    (replaced("t", np.int64(7)), "t: int64, need 32-bit integer"),
    (replaced("t", np.float32(7)), "t: float32, need 32-bit integer"),
    (replaced("t", np.int32([7])), r"t: shape \(1,\), need \(\)"),
    (replaced("t", np.int32(8)), "t: 8, but the shape of data says 7"),
    (replaced("isConfocal", True), "isConfocal: bool, need 32-bit integer"),
    (replaced("isConfocal", np.int32(1)), "isConfocal: 1, but the shape of data says 0"),
    (replaced("cameraGridPoints", np.int32([5, 4])), "cameraGridPoints: int32, need 32-bit floating point"),
    (replaced("cameraGridPoints", np.float32([4, 5])), "cameraGridPoints: 4 x 5, but the shape of data says 5 x 4"),
    (replaced("laserGridPoints", np.float32([2, 3])), "laserGridPoints: 2 x 3, but the shape of data says 3 x 2"),
    (replaced("deltaT", np.float64(0.003)), "deltaT: float64, need 32-bit floating point"),
    (replaced("deltaT", np.float32(-1)), "deltaT: -1.0, need a length > 0"),
    (replaced("hiddenVolumeSize", np.float32([1, 1, 1])), r"hiddenVolumeSize: shape \(3,\), need \(\)"),
    (replaced("hiddenVolumeSize", np.float32(-1)), "hiddenVolumeSize: a negative length"),
    (replaced("laserPosition", np.float32([0, np.nan, 0])), "laserPosition: holds a value that is not finite"),
    (
        replaced("cameraGridPositions", np.zeros((4, 5, 3), "f4")),
        r"cameraGridPositions: shape \(4, 5, 3\), need \(3, 4, 5\)",
    ),
    (edited("cameraGridPositions", np.s_[1], 0.5), "cameraGridPositions: a planar wall lies in Y = 0"),
    (edited("laserGridNormals", np.s_[1], 1.0), r"laserGridNormals: a planar wall faces \(0, -1, 0\)"),
    (edited("laserGridNormals", np.s_[1], 0.5), "laserGridNormals: not unit normals"),
    (edited("cameraGridPositions", np.s_[2], 0.0), "cameraGridPositions: rows must ascend in Z"),
    (edited("laserGridPositions", np.s_[0], 0.0), "laserGridPositions: rows must ascend in Z and columns in X"),
    (edited("data", np.s_[0, 6, 1, 3, 4, 1, 2], np.nan), r"data: nan at index \(0, 6, 1, 3, 4, 1, 2\)"),
    (edited("variance", np.s_[0, 5, 0, 2, 1, 0, 1], np.inf), r"variance: inf at index \(0, 5, 0, 2, 1, 0, 1\)"),
    (replaced("variance", np.zeros((1, 7, 6, 4, 5), "f4")), r"variance: shape \(1, 7, 6, 4, 5\), need that of data"),
    (attribute("data order", "row-major"), "attribute 'data order': row-major, need 'column-major'"),
    (attribute("engine", None), "attribute 'engine': missing, need 'nlosrender'"),
    (attribute("third_bounce", 3, "data"), "attribute 'third_bounce' of data: 3, need 1"),
    *[(replaced(spec.name, None), f"{spec.name}: missing") for spec in DATASETS],
]


@pytest.mark.parametrize(("change", "message"), BROKEN)
def test_each_violation_is_reported(
    tmp_path: Path, header_of: Callable, write_capture: Callable, change: Callable, message: str
) -> None:
    """One change, one line that names it."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of(), store_variance=True)
    with h5py.File(path, "r+") as file:
        change(file)
    found = validate_file(path)
    assert any(re.match(message, line) for line in found), found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.pop("laserSpotPositions"), "has no usable laserSpotPositions"),
        (lambda file: file["laserSpotPositions"].__setitem__((0, 0, 1), np.nan), "laserSpotPositions: .* not finite"),
        (lambda file: file["laserSpotShares"].__setitem__(0, 0.5), "laserSpotShares: need shares .* add up to 1"),
        (lambda file: file["laserSpotShares"].__setitem__(0, np.nan), "laserSpotShares: need shares"),
        (lambda file: file.attrs.__setitem__("laser_flash", 5), "attribute 'laser_flash': 5, need text"),
        (lambda file: file.attrs.__setitem__("footprint_area", -1.0), "attribute 'footprint_area': -1.0, need an area"),
        (lambda file: file.attrs.__delitem__("footprint_area"), "attribute 'footprint_area': missing"),
    ],
)
def test_spots_flash_and_footprint_are_checked(
    tmp_path: Path, header_of: Callable, write_capture: Callable, change: Callable, message: str
) -> None:
    """A file that says so has what it says, or --check fails."""
    path = tmp_path / "a.hdf5"
    spots = np.array([[0.1, 0.2, 0.0], [-0.3, 0.2, 0.0]]), np.array([0.25, 0.75])
    header = replace(header_of(), laser_spots=spots, laser_flash="a cone", footprint=("a disc", 0.01))
    write_capture(path, header)
    assert validate_file(path) == []
    with h5py.File(path, "r+") as file:
        change(file)
    (found,) = validate_file(path)
    assert re.match(message, found)


def test_confocal_lasers_must_be_the_sensors(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """In a confocal file the laser grid is a copy."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of("confocal"))
    with h5py.File(path, "r+") as file:
        file["laserGridPositions"][0, 3, 4] += 0.01
    assert validate_file(path) == [
        "laserGridPositions: differs from cameraGridPositions although the capture is confocal"
    ]


def test_data_of_another_type_and_bounce_axis(tmp_path: Path) -> None:
    """Doubles and a bounce axis of another length are violations, and contiguous data are searched for NaN too."""
    data = np.zeros((2, 7, 4, 3, 5))
    data[1, 6, 2, 1, 4] = np.nan
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["data"] = data
    found = validate_file(tmp_path / "a.hdf5")
    assert "data: float64, need 32-bit floating point" in found
    assert "data: bounce axis of length 4, need 6" in found
    assert "data: 2 channels, need 1, 3 or 4" in found
    assert "data: nan at index (1, 6, 2, 1, 4)" in found


def test_colour_without_names(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Three channels need their names."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of(n_channels=3))
    with h5py.File(path, "r+") as file:
        del file.attrs["channels"]
    assert validate_file(path) == ["attribute 'channels': missing, need the names of the channels"]
