"""The pieces of a reconstruction: lattices, interpolation, pulses, voxels, silhouettes, scores."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.point_captures import POSE, cells, points_header, write_points
from support.rendering import configured

from nlosrender.analysis.reconstruction.lattice import (
    OVERSAMPLING,
    Axis,
    covering,
    interpolation_matrix,
    lattice_of,
)
from nlosrender.analysis.reconstruction.propagation import Propagator
from nlosrender.analysis.reconstruction.pulse import Pulse, default_wavelength, pulse_warnings, sampling_limit
from nlosrender.analysis.reconstruction.reconstruct import (
    Reconstruction,
    ReconstructionSettings,
    reconstruct_capture,
)
from nlosrender.analysis.reconstruction.score import otsu_threshold, score_front_view
from nlosrender.analysis.reconstruction.silhouette import true_silhouette
from nlosrender.analysis.reconstruction.threads import in_threads
from nlosrender.analysis.reconstruction.voxel_grid import VoxelGrid, voxel_grid
from nlosrender.config.load import config_to_dict
from nlosrender.errors import FileError, NlosError, OptionError
from nlosrender.files.reading.reader import open_capture
from nlosrender.files.reading.scan import Scan, read_scan


def scan_of(path: Path, scan_type: str = "single", **changes: object) -> Scan:
    """Return the scan of a capture with 7 x 4 sensor points, 0.1 m and 0.15 m apart."""
    header = points_header(scan_type, cells(7, 4, 0.7, 0.6), **changes)
    with open_capture(write_points(path / "scan.hdf5", header, [(0.0, 0.0, 0.8)])) as capture:
        return read_scan(capture)


@pytest.mark.parametrize("frame", ["znlos", "scene"])
def test_a_scan_is_in_the_walls_frame(tmp_path: Path, frame: str) -> None:
    """Whatever the file's frame, points and the hidden box are as they were given, and know the way to the scene."""
    found = scan_of(tmp_path, "exhaustive", frame=frame, legs=True, bins=(0.0, 0.01, 600))
    header = points_header("exhaustive", cells(7, 4, 0.7, 0.6))
    # float32 positions of 1 to 4 m in the file
    np.testing.assert_allclose(found.sensors, header.sensor_positions, atol=1e-6)
    np.testing.assert_allclose(found.lasers, header.laser_positions, atol=1e-6)
    np.testing.assert_allclose(found.hidden_aabb, header.hidden_bounds, atol=1e-6)
    np.testing.assert_allclose(found.wall_to_scene, POSE.matrix(), atol=1e-12)
    legs = np.linalg.norm(header.sensor_positions - header.sensor_position, axis=-1)
    np.testing.assert_allclose(found.sensor_legs, legs, atol=1e-6)
    assert found.planar


def test_a_lattice_is_recognised_and_turned_to_ascend() -> None:
    """Points that descend along an axis give the same lattice, and say so; points off their places are refused."""
    points = cells(5, 3, 1.0, 0.9)
    straight, turned = lattice_of(points), lattice_of(points[::-1, ::-1])
    assert (turned.x, turned.y) == (straight.x, straight.y)
    assert (straight.flips, turned.flips) == ((), (0, 1))
    assert straight.x.step == pytest.approx(0.2)
    assert straight.y.step == pytest.approx(0.3)
    moved = points.copy()
    moved[1, 2, 0] += 0.01  # 5 % of the spacing
    with pytest.raises(FileError, match=r"3 x 5 points .* not equally spaced .*backprojection"):
        lattice_of(moved)


def test_single_rows_and_points_are_lattices() -> None:
    """A row takes the step of the other axis, a point any."""
    row = lattice_of(cells(4, 1, 0.8, 0.8))
    assert row.y == Axis(0.0, pytest.approx(0.2), 1)
    assert lattice_of(cells(1, 1, 0.8, 0.8)).x.count == 1


def test_interpolation_is_exact_within_the_band() -> None:
    """Waves of 2 * OVERSAMPLING samples per period or longer are interpolated to 1e-4."""
    wanted = np.linspace(-0.3, 0.45, 23)
    start, stop = covering(wanted, 0.11, 0.05)
    matrix = interpolation_matrix(wanted, 0.11 + start * 0.05, 0.05, stop - start)
    samples = 0.11 + np.arange(start, stop) * 0.05
    for wavenumber in (0.0, 0.4, 0.8, 1.0):
        k = wavenumber * np.pi / (0.05 * OVERSAMPLING)
        np.testing.assert_allclose(matrix @ np.exp(1j * k * samples), np.exp(1j * k * wanted), atol=1e-4)


@pytest.mark.parametrize("ways", [1, 2])
def test_propagation_is_the_sum_over_points(ways: int) -> None:
    """Fields from a coarse 5 x 3 lattice equal the Rayleigh-Sommerfeld sum to 1e-4, at any fineness."""
    random = np.random.default_rng(1)
    lattice = lattice_of(cells(5, 3, 0.5, 0.4) + np.array([0.03, -0.02, 0.01]))
    x, y, z = np.linspace(-0.16, 0.2, 12), np.linspace(-0.1, 0.17, 7), 0.6
    wavenumbers = np.linspace(20.0, 80.0, 9)
    shape = (len(wavenumbers), 2, 3, 5)
    values = (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(np.complex64)
    propagator = Propagator(lattice, x, y, ways)
    dx = x[:, None] - lattice.x.coordinates()
    dy = y[:, None] - lattice.y.coordinates()
    distance = np.sqrt(dy[:, None, :, None] ** 2 + dx[None, :, None, :] ** 2 + (z - lattice.height) ** 2)
    total = 0.0
    for index, field in propagator.fields(values, wavenumbers, z):
        kernel = np.exp(1j * ways * wavenumbers[index] * distance) / distance
        expected = np.einsum("yxab,lab->lyx", kernel, values[index])
        np.testing.assert_allclose(field, expected, atol=1e-4 * np.abs(expected).max())
        total = total + expected
    np.testing.assert_allclose(propagator.summed_field(values, wavenumbers, z), total, atol=1e-4 * np.abs(total).max())
    assert len(propagator.refinements) > 1


def test_the_pulse_is_the_sum_of_its_wavenumbers() -> None:
    """Summed over its wavenumbers a pulse has its carrier's wavelength and its envelope, and repeats no earlier."""
    pulse = Pulse(0.1, 6.0)
    wavenumbers = pulse.wavenumbers(2.0)
    t = np.linspace(-0.9, 0.9, 301)
    wave = np.exp(1j * np.outer(t, wavenumbers)) @ pulse.weights(wavenumbers)
    expected = np.exp(2j * np.pi * t / 0.1 - t**2 / (2 * pulse.sigma**2))
    # the band is cut at 3 standard deviations: 0.3 % of the integral
    np.testing.assert_allclose(wave / np.abs(wave).max(), expected, atol=5e-3)
    assert pulse.half_length == pytest.approx(0.3)
    with pytest.raises(OptionError, match="--wavelength: got -1"):
        Pulse(-1.0)


def test_the_default_wavelength_has_no_ghosts(tmp_path: Path) -> None:
    """Without a box two spacings, four for confocal captures; a small far box allows shorter ones, bins do not."""
    single, confocal = scan_of(tmp_path), scan_of(tmp_path, "confocal")
    assert default_wavelength(single, None) == pytest.approx(2 * 0.15)
    assert default_wavelength(confocal, None) == pytest.approx(4 * 0.15)
    small = (np.array([-0.1, -0.1, 2.0]), np.array([0.1, 0.1, 2.2]))
    assert sampling_limit(confocal, small) == pytest.approx(2 * 0.15 * 2 * 0.1 / np.hypot(0.1, 2.0))
    assert default_wavelength(confocal, small) == pytest.approx(2 * 0.15)
    assert default_wavelength(replace(single, bin_width_opl=0.2), None) == pytest.approx(0.8)


def test_wavelengths_that_alias_or_blur_are_warned_of(tmp_path: Path) -> None:
    """A wavelength below the grid's limit names the shortest that will do; so does one of few bins."""
    scan = scan_of(tmp_path, bins=(0.0, 0.03, 120))
    box = (np.array([-0.4, -0.3, 0.5]), np.array([0.4, 0.3, 1.0]))
    found = pulse_warnings(scan, Pulse(0.09), box)
    assert len(found) == 2
    assert f"--wavelength {sampling_limit(scan, box):.3g}" in found[0]
    assert "4 bins of 30 mm" in found[1]
    assert not pulse_warnings(scan, Pulse(0.3), box)


def test_the_default_volume_holds_the_hidden_scene(tmp_path: Path) -> None:
    """A margin of 15 % of the longest edge or 1.5 wavelengths on each side, and 128 cubic voxels along the longest."""
    scan = scan_of(tmp_path)
    low, high = points_header("single", cells(2, 2, 1.0, 1.0)).hidden_bounds
    grid = voxel_grid(scan, 0.02)
    assert max(grid.shape) == 128
    margin = 0.15 * 0.7
    half = grid.voxel_size / 2
    np.testing.assert_allclose(grid.bounds[0] - half, low - margin, atol=half + 1e-6)
    np.testing.assert_allclose(grid.bounds[1] + half, high + margin, atol=half + 1e-6)
    assert voxel_grid(scan, 0.2).x[0] == pytest.approx(low[0] - 0.3, abs=0.01)


def test_impossible_volumes_are_refused(tmp_path: Path) -> None:
    """Behind the wall, too many voxels, or nowhere known: each says what to do."""
    scan = scan_of(tmp_path)
    with pytest.raises(OptionError, match=r"z = -0.\d+ m, need z > 0"):
        voxel_grid(scan, 0.1, (0, 0, 0.1), (0.5,))
    with pytest.raises(OptionError, match=r"--voxel-size"):
        voxel_grid(scan, 0.1, (0, 0, 5.0), (9.0,), voxel_size=1e-3)
    with pytest.raises(FileError, match=r"give --volume-center X,Y,Z and --volume-size"):
        voxel_grid(replace(scan, hidden_aabb=None), 0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "phase"}, "need one of phasor, backprojection"),
        ({"bounces": "4"}, "need 3 or all"),
        ({"voxels": 8, "voxel_size": 0.1}, "give one of them"),
        ({"voxels": 0}, "need an integer >= 1"),
        ({"voxel_size": -0.1}, "--voxel-size: got -0.1"),
        ({"volume_size": (1.0, 2.0)}, "--volume-size: got 1,2"),
        ({"volume_center": (1.0,)}, "--volume-center: got 1, need x, y, z"),
    ],
)
def test_impossible_settings_are_refused(changes: dict, message: str) -> None:
    """Each names the option, the value and what is allowed."""
    with pytest.raises(OptionError, match=message):
        ReconstructionSettings(**changes)


def test_wavelengths_that_would_take_forever_are_refused(tmp_path: Path) -> None:
    """Too many wavenumbers, or too fine a lattice: said before memory runs out."""
    header = points_header("single", cells(5, 4, 1.0, 0.8))
    path = write_points(tmp_path / "x.hdf5", header, [(0.0, 0.0, 0.8)])
    with pytest.raises(OptionError, match=r"--wavelength: 1e-06 m is too short .* wavenumbers"):
        reconstruct_capture(path, ReconstructionSettings(wavelength=1e-6, voxels=8))
    with pytest.raises(OptionError, match=r"--wavelength: is too short .* lattice"):
        reconstruct_capture(path, ReconstructionSettings(wavelength=1e-4, cycles=1e4, voxels=8))


def test_damaged_samples_and_missing_devices_are_refused(tmp_path: Path) -> None:
    """Not-a-number in the samples, and counted legs without a position, are errors, not pictures."""
    import h5py

    header = points_header("single", cells(3, 2, 0.6, 0.4), legs=True, bins=(0.0, 0.01, 600))
    path = write_points(tmp_path / "bad.hdf5", header, [(0.0, 0.0, 0.8)])
    with h5py.File(path, "r+") as file:
        file["data"][0, 400, 1, 1, 1, 0, 0] = np.nan
    for method in ("phasor", "backprojection"):
        with pytest.raises(FileError, match="not finite"):
            reconstruct_capture(path, ReconstructionSettings(method, voxels=8))
    with h5py.File(path, "r+") as file:
        del file["cameraPosition"]
    with pytest.raises(FileError, match="no cameraPosition"):
        reconstruct_capture(path, ReconstructionSettings(voxels=8))


def test_darkness_gives_an_empty_volume_and_a_warning(tmp_path: Path) -> None:
    """Light that no voxel can send leaves nothing."""
    header = points_header("confocal", cells(4, 3, 0.8, 0.6))
    path = write_points(tmp_path / "far.hdf5", header, [(0.0, 0.0, 1.7)])
    settings = ReconstructionSettings(volume_center=(0.0, 0.0, 0.4), volume_size=(0.2,), voxels=6, wavelength=0.2)
    found = reconstruct_capture(path, settings)
    assert not found.volume.any()
    assert any("no light" in text for text in found.warnings)


GRID = VoxelGrid(np.arange(-0.59, 0.6, 0.02), np.arange(-0.49, 0.5, 0.02), np.arange(0.81, 1.2, 0.02), 0.02)


def silhouette_of(*items: dict, wall: dict | None = None) -> np.ndarray:
    """Return the silhouette on ``GRID`` of hidden items."""
    scene = {"relay_wall": {"type": "rectangle", "width": 2.0, "height": 2.0, **(wall or {})}, "hidden_geometry": items}
    config = configured({"scene": scene, "capture": {"scan_type": "confocal", "sensor_grid": {"nx": 2, "ny": 2}}})
    return true_silhouette(Path("x.hdf5"), {"config": json.dumps(config_to_dict(config))}, GRID)


def test_silhouettes_have_the_shapes_area_and_place() -> None:
    """Rectangle, sphere, cylinder: area and centroid of the projection, in the wall's frame whatever its pose."""
    rectangle = {"type": "rectangle", "width": 0.4, "height": 0.2, "center": [0.2, -0.1, 1.0], "normal": [0, 0, -1]}
    sphere = {"type": "sphere", "center": [-0.3, 0.2, 1.0], "radius": 0.2}
    cylinder = {"type": "cylinder", "center": [0.1, 0, 1.0], "axis": [1, 0, 0], "radius": 0.1, "height": 0.5}
    for item, area in ((rectangle, 0.08), (sphere, np.pi * 0.04), (cylinder, 0.1)):
        found = silhouette_of(item)
        assert found.sum() * 0.02**2 == pytest.approx(area, rel=0.02)  # 64 corners for a circle: 0.2 %; subpixels
        weights = found / found.sum()
        assert (weights.sum(axis=0) @ GRID.x, weights.sum(axis=1) @ GRID.y) == pytest.approx(
            item["center"][:2], abs=0.003
        )
    wall = {"center": [5, 6, 7], "normal": [1, 0, 0], "up": [0, 0, 1]}  # x along the scene's y, y along its z
    turned = silhouette_of(rectangle | {"center": [6.0, 6.2, 6.9], "normal": [-1, 0, 0], "up": [0, 0, 1]}, wall=wall)
    np.testing.assert_allclose(turned, silhouette_of(rectangle), atol=1e-6)


def test_the_silhouette_of_a_mesh_file(tmp_path: Path) -> None:
    """A file is read, scaled and moved as the renderer would; a missing one is an error."""
    path = tmp_path / "square.obj"
    path.write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n")
    item = {"type": "mesh", "filename": str(path), "scale": 0.2, "translate": [0.1, -0.2, 1.0]}
    square = {"type": "rectangle", "width": 0.4, "height": 0.4, "center": [0.1, -0.2, 1.0], "normal": [0, 0, -1]}
    np.testing.assert_allclose(silhouette_of(item), silhouette_of(square), atol=0.26)  # a subpixel row at the rim
    assert silhouette_of(item).sum() == pytest.approx(silhouette_of(square).sum(), rel=0.03)


def test_silhouettes_take_what_lies_in_the_volumes_depth() -> None:
    """A wall behind the volume is not part of the front view."""
    behind = {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [0, 0, 1.5], "normal": [0, 0, -1]}
    sphere = {"type": "sphere", "center": [-0.3, 0.2, 1.0], "radius": 0.2}
    np.testing.assert_array_equal(silhouette_of(behind, sphere), silhouette_of(sphere))
    with pytest.raises(FileError, match="does not carry"):
        true_silhouette(Path("x.hdf5"), {}, GRID)


def test_a_scene_without_a_relay_wall_has_no_silhouette() -> None:
    """What a camera sees itself and what is hidden from it stand in one list there: all of it would be the truth."""
    camera = {"position": [0, 0, 2], "look_at": [0, 0, 0], "fov_deg": 60, "width": 3, "height": 2}
    wall = {"type": "rectangle", "width": 2.0, "height": 2.0, "center": [0, 0, 0], "normal": [0, 0, 1]}
    config = {
        "scene": {"hidden_geometry": [wall]},
        "capture": {"scan_type": "confocal", "camera": camera},
        "time_axis": {"bin_width_opl": 0.01, "n_bins": 9},
        "output": {"path": "a.hdf5"},
    }
    with pytest.raises(FileError, match=r"no relay wall.* hidden"):
        true_silhouette(Path("x.hdf5"), {"config": json.dumps(config)}, GRID)


def test_scores_of_known_pictures() -> None:
    """The silhouette itself scores 1 and 1; its negative -1 and 0; shifted by half its width, a third of the union."""
    square = np.zeros((20, 30))
    square[5:15, 8:18] = 1
    perfect = score_front_view(0.3 * square, square)
    assert (perfect.correlation, perfect.iou) == pytest.approx((1, 1))
    negative = score_front_view(1 - square, square)
    assert (negative.correlation, negative.iou) == pytest.approx((-1, 0))
    assert score_front_view(np.roll(square, 5, axis=1), square).iou == pytest.approx(1 / 3)
    with pytest.raises(NlosError, match="outside the front view"):
        score_front_view(square, np.zeros_like(square))
    with pytest.raises(NlosError, match="same everywhere"):
        score_front_view(np.ones_like(square), square)


def test_otsu_parts_two_populations() -> None:
    """Between two normal populations the threshold lies where Otsu's criterion, computed plainly, is largest."""
    random = np.random.default_rng(2)
    values = np.concatenate([random.normal(0.2, 0.03, 900), random.normal(0.7, 0.05, 300)])

    def between(threshold: float) -> float:
        low, high = values[values <= threshold], values[values > threshold]
        return len(low) * len(high) * (low.mean() - high.mean()) ** 2

    best = max(between(threshold) for threshold in np.linspace(0.25, 0.65, 200))
    assert between(otsu_threshold(values)) == pytest.approx(best, rel=1e-3)


def test_depths_lie_between_voxels() -> None:
    """The depth of a smooth peak is found to a tenth of a voxel, at the volume's ends to the voxel."""
    places = np.array([[0.953, 1.0], [1.088, 0.7]])
    volume = np.exp(-(((GRID.z[:, None, None] - places) / 0.06) ** 2)).astype(np.float32)
    unused = {"method": "phasor", "wavelength": 0.1, "cycles": 5.0, "bounces": (3,), "source": Path("x.hdf5")}
    frame = {"source_attributes": {}, "wall_to_file": np.eye(4), "wall_to_scene": None, "seconds": 0.0, "warnings": ()}
    found = Reconstruction(volume, GRID, **unused, **frame).depth_map()
    np.testing.assert_allclose(found, [[0.953, 1.0], [1.088, GRID.z[0]]], atol=0.002)


def test_errors_in_threads_reach_the_caller() -> None:
    """What a piece of work raises is raised; progress ends at 1."""
    told: list[float] = []
    in_threads(lambda number: None, 5, told.append)
    assert told[-1] == 1.0

    def fail(number: int) -> None:
        raise FileError(f"piece {number}")

    with pytest.raises(FileError, match="piece"):
        in_threads(fail, 3)
