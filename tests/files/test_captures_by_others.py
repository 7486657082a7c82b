"""Captures as other programs write them: every variant says the same as the original it was made from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.point_captures import cells, point_light, points_header, write_light
from typer.testing import CliRunner

from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.cli.app import app
from nlosrender.errors import FileError
from nlosrender.files.export.export import export_capture
from nlosrender.files.reading.reader import open_capture, read_header
from nlosrender.files.reading.scan import chosen_bounces, read_scan

POINT = (0.1, -0.2, 0.8)
SENSORS = cells(5, 4, 1.0, 0.8)
GRIDS = ("cameraGridPositions", "cameraGridNormals", "laserGridPositions", "laserGridNormals")
Datasets = dict[str, np.ndarray]


def original(folder: Path, scan: str) -> Path:
    """Write a capture of one point without attributes; sizes differ on every axis."""
    header = points_header(scan, SENSORS, bins=(0.7, 0.02, 260), legs=True)
    ours = write_light(folder / "ours.hdf5", header, point_light(header, [POINT]))
    # attributes have lengths and frames in float64, which no other writer's file says
    return variant(ours, folder / "original.hdf5", lambda datasets, attributes: None)


def variant(source: Path, target: Path, change: Callable[[Datasets, dict[str, object]], None]) -> Path:
    """Write the datasets of a capture once more after a change, with no attributes but those it sets."""
    with h5py.File(source) as file:
        datasets = {name: file[name][()] for name in file}
    attributes: dict[str, object] = {}
    change(datasets, attributes)
    with h5py.File(target, "w", userblock_size=512) as file:
        for name, value in datasets.items():
            file[name] = value
        file.attrs.update({name: value for name, value in attributes.items() if name != "third_bounce"})
        if "third_bounce" in attributes:
            file["data"].attrs["third_bounce"] = attributes["third_bounce"]
    return target


def row_major(datasets: Datasets, attributes: dict[str, object]) -> None:
    """Every array in reverse axis order, said by the attribute."""
    attributes["data order"] = "row-major"
    datasets |= {name: value.transpose() for name, value in datasets.items()}


def row_major_unsaid(datasets: Datasets, attributes: dict[str, object]) -> None:
    """The same without the attribute: the number of bins tells."""
    row_major(datasets, attributes)
    attributes.clear()


def no_colour(datasets: Datasets, attributes: dict[str, object]) -> None:
    """(T, bounce, y, x) and (T, bounce, y, x, laser y, laser x)."""
    datasets["data"] = datasets["data"][0]


def row_major_no_colour(datasets: Datasets, attributes: dict[str, object]) -> None:
    """(x, y, bounce, T)."""
    no_colour(datasets, attributes)
    row_major(datasets, attributes)


def mat_2018(datasets: Datasets, attributes: dict[str, object]) -> None:
    """Doubles of rank 2 at least, lists of points that run along x, no colour."""
    no_colour(datasets, attributes)
    for name, value in datasets.items():
        if name in GRIDS:
            datasets[name] = value.reshape(3, -1).astype(np.float64)
        elif name != "data":
            datasets[name] = np.atleast_2d(value).T.astype(np.float64)


def mat_2018_by_columns(datasets: Datasets, attributes: dict[str, object]) -> None:
    """The same with lists of points that run along z, as MATLAB lists a grid (z, x)."""
    grids = {name: datasets[name].swapaxes(1, 2) for name in GRIDS}
    mat_2018(datasets, attributes)
    datasets |= {name: value.reshape(3, -1).astype(np.float64) for name, value in grids.items()}


def no_normals(datasets: Datasets, attributes: dict[str, object]) -> None:
    """A plane has its normals from its points."""
    for name in GRIDS:
        if name.endswith("Normals"):
            del datasets[name]


def single_of_rank_5(datasets: Datasets, attributes: dict[str, object]) -> None:
    """One laser point, and no axes for it."""
    if datasets["data"].ndim == 7:
        datasets["data"] = datasets["data"][..., 0, 0]


def third_first(datasets: Datasets, attributes: dict[str, object]) -> None:
    """The bounce axis begins with the third bounce."""
    datasets["data"] = datasets["data"][:, :, 1:]
    attributes["third_bounce"] = 0


def double_volume(datasets: Datasets, attributes: dict[str, object]) -> None:
    """hiddenVolumeSize as float64: one more reader runs with it."""
    datasets["hiddenVolumeSize"] = np.float64(datasets["hiddenVolumeSize"])


VARIANTS = [
    row_major,
    row_major_unsaid,
    no_colour,
    row_major_no_colour,
    mat_2018,
    mat_2018_by_columns,
    no_normals,
    single_of_rank_5,
    third_first,
    double_volume,
]
CASES = [
    (change, scan)
    for change in VARIANTS
    for scan in ("confocal", "single", "exhaustive")
    # a list of pairs in a .mat file is another variant; rank 5 is for one laser point
    if not (change is single_of_rank_5 and scan != "single")
]


@pytest.mark.parametrize(("change", "scan"), CASES)
def test_a_variant_is_read_as_its_original(tmp_path: Path, change: Callable, scan: str) -> None:
    """Points, normals, legs, times and the third bounce are those of the original, bit for bit."""
    path = original(tmp_path, scan)
    other = variant(path, tmp_path / "other.hdf5", change)
    with open_capture(path) as a, open_capture(other) as b:
        assert b.header.scan_type == scan
        assert (a.header.n_bins, a.header.sensor_grid) == (b.header.n_bins, b.header.sensor_grid)
        for name, value in vars(a.positions).items():
            # a plane's normals from float32 points
            np.testing.assert_allclose(getattr(b.positions, name), value, atol=1e-5 if "normals" in name else 0)
        scans = read_scan(a), read_scan(b)
        for name in ("sensors", "lasers", "sensor_legs", "laser_legs"):
            np.testing.assert_array_equal(getattr(scans[0], name), getattr(scans[1], name))
        thirds = [capture.read_block(bounces=chosen_bounces(capture.header, "3")) for capture in (a, b)]
        np.testing.assert_array_equal(*thirds)
        assert thirds[0].any()
        if change is not third_first:
            np.testing.assert_array_equal(a.read_block(bounces=range(6)), b.read_block(bounces=range(6)))


@pytest.mark.parametrize("change", [row_major, no_colour, mat_2018, no_normals, single_of_rank_5])
def test_compare_export_and_info_take_it(tmp_path: Path, change: Callable) -> None:
    """A variant agrees with its original, exports to the same file, and its check passes."""
    scan = "single" if change is single_of_rank_5 else "confocal"
    path = original(tmp_path, scan)
    other = variant(path, tmp_path / "other.hdf5", change)
    for reference in (path, tmp_path / "ours.hdf5"):
        assert compare_captures(other, reference, Tolerances(max_rel_l2=0)).failures == ()
    name = "phasor_mat" if scan == "single" else "fk"
    files = [export_capture(source, tmp_path / f"{source.stem}.mat", name, "3").path for source in (path, other)]
    with h5py.File(files[0]) as a, h5py.File(files[1]) as b:
        for variable in a:
            np.testing.assert_array_equal(a[variable], b[variable])
    result = CliRunner().invoke(app, ["info", str(other), "--check", "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert (report["violations"], report["readable"], report["complete"]) == ([], True, False)
    assert any("engine" in deviation for deviation in report["deviations"])
    shown = CliRunner().invoke(app, ["info", str(other), "--check"]).stdout
    assert "readable Z-NLOS by another writer, all samples finite" in shown
    assert "attribute 'engine': missing" in shown


def test_a_reconstruction_uses_the_third_bounce_wherever_it_is(tmp_path: Path) -> None:
    """With third_bounce 0 the point is found where it is, from index 0, which holds bounce 3."""
    sensors = cells(16, 12, 1.0, 0.8)
    header = points_header("confocal", sensors, bins=(0.0, 0.02, 260), legs=True)
    ours = write_light(tmp_path / "ours.hdf5", header, point_light(header, [POINT]))
    path = variant(ours, tmp_path / "original.hdf5", lambda datasets, attributes: None)
    settings = ReconstructionSettings(volume_center=POINT, volume_size=(0.5,), voxels=10, wavelength=0.2)
    expected = reconstruct_capture(path, settings)
    found = reconstruct_capture(variant(path, tmp_path / "other.hdf5", third_first), settings)
    assert found.bounces == expected.bounces == (3,)
    np.testing.assert_array_equal(found.volume, expected.volume)


@pytest.mark.parametrize("stored", [7, -1, "first", [0, 1]])
def test_a_third_bounce_that_is_none_is_refused(tmp_path: Path, stored: object) -> None:
    """An attribute that names no index is not taken for the usual one; all bounces together can be used."""

    def change(datasets: Datasets, attributes: dict[str, object]) -> None:
        attributes["third_bounce"] = stored

    other = variant(original(tmp_path, "confocal"), tmp_path / "other.hdf5", change)
    header = read_header(other)
    for bounces in ("3", None):
        with pytest.raises(FileError, match="attribute third_bounce of data is"):
            chosen_bounces(header, bounces)
    assert chosen_bounces(header, "all") == tuple(range(6))
    assert CliRunner().invoke(app, ["info", str(other), "--check"]).exit_code == 1  # a FileError, 3 outside the runner


def test_what_contradicts_itself_is_refused(tmp_path: Path) -> None:
    """Pairs without laser axes, another number of bins, points that are no list of this grid."""

    def pairs(datasets: Datasets, attributes: dict[str, object]) -> None:
        datasets["data"] = datasets["data"][..., 0, 0]

    def bins(datasets: Datasets, attributes: dict[str, object]) -> None:
        datasets["t"] = np.int32(261)

    def scrambled(datasets: Datasets, attributes: dict[str, object]) -> None:
        datasets["cameraGridPositions"] = datasets["cameraGridPositions"].reshape(2, 30)

    path = original(tmp_path, "exhaustive")
    with pytest.raises(FileError, match="isConfocal is 0 and there are 6 laser points, but data has no laser axes"):
        read_header(variant(path, tmp_path / "a.hdf5", pairs))
    result = CliRunner().invoke(app, ["info", str(variant(path, tmp_path / "b.hdf5", bins)), "--check"])
    assert "t: 261, but data has 260 bins" in str(result.exception)
    with (
        open_capture(variant(path, tmp_path / "c.hdf5", scrambled)) as capture,
        pytest.raises(FileError, match=r"cameraGridPositions has shape \(2, 30\), need \(3, 4, 5\), or \(3, 20\)"),
    ):
        _ = capture.positions


def test_a_curved_wall_without_normals_has_none(tmp_path: Path) -> None:
    """Only a plane's normals follow from its points; y-tal files without them are empty there."""
    bent = SENSORS + np.array([0.0, 0.0, 1.0]) * SENSORS[..., :1] ** 2
    header = points_header("confocal", bent, planar_wall=False)
    path = write_light(tmp_path / "bent.hdf5", header, point_light(header, [POINT]))
    other = variant(path, tmp_path / "other.hdf5", no_normals)
    with open_capture(other) as capture:
        assert capture.positions.sensor_normals is None
    with h5py.File(export_capture(other, tmp_path / "tal.hdf5", "tal").path) as file:
        assert isinstance(file["sensor_grid_normals"][()], h5py.Empty)


def turned(path: Path, target: Path, turn: Callable[[np.ndarray], np.ndarray]) -> Path:
    """Write a confocal or exhaustive capture of ours in another order of rows and columns."""

    def change(datasets: Datasets, attributes: dict[str, object]) -> None:
        for name in GRIDS:
            datasets[name] = np.moveaxis(turn(np.moveaxis(datasets[name], 0, -1)), -1, 0)
        data = datasets["data"]
        for first in range(3, data.ndim, 2):
            moved = np.moveaxis(data, (first, first + 1), (0, 1))
            data = np.moveaxis(turn(moved), (0, 1), (first, first + 1))
        datasets["data"] = data

    return variant(path, target, change)


TURNS = [
    lambda grid: grid[::-1],
    lambda grid: grid[:, ::-1],
    lambda grid: grid.swapaxes(0, 1),
    lambda grid: grid[::-1].swapaxes(0, 1),
]


@pytest.mark.parametrize("scan", ["confocal", "exhaustive"])
@pytest.mark.parametrize("turn", TURNS)
def test_compare_aligns_the_order_of_points(tmp_path: Path, scan: str, turn: Callable) -> None:
    """Equal light in another order of rows and columns is equal; one changed sample is found where it is."""
    path = original(tmp_path, scan)
    other = turned(path, tmp_path / "other.hdf5", turn)
    comparison = compare_captures(other, path, Tolerances(max_rel_l2=0))
    assert comparison.failures == ()
    assert any("in another order" in note for note in comparison.aligned)
    with h5py.File(path, "r+") as file:
        file["data"][(0, 20, 1, 3, 1) + ((1, 2) if scan == "exhaustive" else ())] += 1.0
    largest = compare_captures(other, path, Tolerances(max_rel_l2=1)).differences.largest
    assert largest is not None
    assert (largest.sensor, largest.laser) == ((3, 1), (1, 2) if scan == "exhaustive" else (0, 0))


@pytest.mark.parametrize("bins", [30, -20])
def test_compare_aligns_where_bins_begin(tmp_path: Path, bins: int) -> None:
    """Equal light with another t0 is equal; light in a bin that the other does not have is a difference."""
    header = points_header("confocal", SENSORS, bins=(0.7, 0.02, 260), legs=True)
    path = write_light(tmp_path / "a.hdf5", header, point_light(header, [POINT]))
    moved = points_header("confocal", SENSORS, bins=(0.7 + 0.02 * bins, 0.02, 250), legs=True, bounce_indices=(1,))
    other = write_light(tmp_path / "b.hdf5", moved, point_light(moved, [POINT]))
    with h5py.File(path, "r+") as file:
        file["data"][:, :, 0] = 0  # the false second bounce is in every bin
    with h5py.File(other, "r+") as file:
        file["data"][:, :, 0] = 0
    for first, second in ((path, other), (other, path)):
        comparison = compare_captures(first, second, Tolerances(max_rel_l2=1e-6, max_shift=0.01))
        assert comparison.failures == ()
        assert any("bins begin at" in note for note in comparison.aligned)
    outside = 3 if bins > 0 else 259  # of the first file's bins one that the other does not have
    with h5py.File(path, "r+") as file:
        file["data"][0, outside, 1, 2, 3] = 1e3
    largest = compare_captures(path, other, Tolerances(max_rel_l2=1)).differences.largest
    assert largest is not None
    assert (largest.value, largest.reference) == (1e3, 0)


def test_compare_says_when_bins_do_not_meet(tmp_path: Path) -> None:
    """Starts apart by a fraction of a bin, or by more than the window, cannot be compared bin by bin."""
    header = points_header("confocal", SENSORS, bins=(0.7, 0.02, 260), legs=True)
    path = write_light(tmp_path / "a.hdf5", header, point_light(header, [POINT]))
    for start in (0.71, 0.7 + 0.02 * 300):
        moved = points_header("confocal", SENSORS, bins=(start, 0.02, 260), legs=True)
        other = write_light(tmp_path / "b.hdf5", moved, np.zeros((1, 1, 4, 5, 260)))
        comparison = compare_captures(path, other, Tolerances())
        assert [difference.name for difference in comparison.structure] == ["start of bin 0"]


def test_compare_says_when_bounces_are_counted_otherwise(tmp_path: Path) -> None:
    """Index 0 that holds bounce 3 is not compared with one that holds bounce 2."""

    def change(datasets: Datasets, attributes: dict[str, object]) -> None:
        attributes["third_bounce"] = 0

    path = original(tmp_path, "confocal")
    comparison = compare_captures(variant(path, tmp_path / "b.hdf5", change), path, Tolerances())
    assert [difference.name for difference in comparison.structure] == ["bounce of index 0"]
