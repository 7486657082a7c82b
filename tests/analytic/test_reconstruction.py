"""Reconstruction against physics: points come back where they are, as sharp as waves allow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.point_captures import Array, cells, point_light, points_header, write_light, write_points

from nlosrender.analysis.reconstruction import phasor
from nlosrender.analysis.reconstruction.backprojection import backproject
from nlosrender.analysis.reconstruction.pulse import Pulse
from nlosrender.analysis.reconstruction.reconstruct import (
    Reconstruction,
    ReconstructionSettings,
    reconstruct_capture,
)
from nlosrender.analysis.reconstruction.spectrum import path_lengths, spectra, unambiguous_period
from nlosrender.analysis.reconstruction.voxel_grid import voxel_grid
from nlosrender.errors import FileError
from nlosrender.files.reading import scan
from nlosrender.files.reading.reader import open_capture

POINT = (0.13, -0.08, 0.82)  # m; on no voxel's centre
WAVELENGTH = 0.12
BOX = {"volume_center": (0.05, 0.0, 0.85), "volume_size": (0.5, 0.3, 0.44), "voxel_size": 0.02}
SENSORS = cells(24, 18, 1.8, 1.4)

SCANS = ("single", "confocal", "exhaustive")


def reconstruct(path: Path, method: str = "phasor", **changes: object) -> Reconstruction:
    """Reconstruct with the settings of this module."""
    return reconstruct_capture(
        path, ReconstructionSettings(**({"method": method, "wavelength": WAVELENGTH} | BOX | changes))
    )


def peak(found: Reconstruction) -> Array:
    """Return x, y, z of the brightest voxel [m]."""
    z, y, x = np.unravel_index(int(found.volume.argmax()), found.volume.shape)
    return np.array([found.grid.x[x], found.grid.y[y], found.grid.z[z]])


FRAMES = [(False, 0.0, "znlos"), (True, 0.0, "scene"), (True, 1.3, "znlos"), (False, -0.37, "scene")]


# every method with every scan, either with every choice of legs, start and frame
@pytest.mark.parametrize(
    ("scan_type", "method", "legs", "start", "frame"),
    [
        pytest.param(scan_type, method, *frame, marks=[] if k // 2 == j else pytest.mark.slow)
        for i, scan_type in enumerate(SCANS)
        for j, method in enumerate(("phasor", "backprojection"))
        for k, frame in enumerate(FRAMES)
        if (i + j + k) % 2 == 0
    ],
)
def test_a_point_comes_back_where_it_is(
    tmp_path: Path, scan_type: str, method: str, legs: bool, start: float, frame: str
) -> None:
    """The brightest voxel lies within one voxel of the point, whatever the scan, the legs, t0 and the frame."""
    header = points_header(scan_type, SENSORS, bins=(start, 0.01, 660), legs=legs, frame=frame)
    found = reconstruct(write_points(tmp_path / "point.hdf5", header, [POINT]), method)
    # half a voxel for its centre; the 1/r factors pull the peak towards the wall by less than another half
    np.testing.assert_allclose(peak(found), POINT, atol=0.02)


@pytest.mark.parametrize("scan_type", SCANS)
def test_two_points_at_different_depths(tmp_path: Path, scan_type: str) -> None:
    """Each of two points gives the largest value of its own half of the volume, and the depth map tells them apart."""
    near, far = (-0.15, 0.1, 0.7), (0.25, -0.1, 1.0)
    header = points_header(scan_type, SENSORS, legs=True, bins=(0.5, 0.01, 660))
    found = reconstruct(write_points(tmp_path / "two.hdf5", header, [near, far]))
    grid = found.grid
    for point, half in ((near, grid.x < 0.05), (far, grid.x >= 0.05)):
        part = np.where(half, found.front_view(), 0)
        y, x = np.unravel_index(int(part.argmax()), part.shape)
        np.testing.assert_allclose([grid.x[x], grid.y[y], found.depth_map()[y, x]], point, atol=0.02)


@pytest.mark.parametrize(("scan_type", "ways"), [("single", 1), ("confocal", 2)])
def test_resolution_follows_the_wavelength(tmp_path: Path, scan_type: str, ways: int) -> None:
    """The width of a point is wavelength * z / aperture (half of it when light goes both ways over the aperture)."""
    z, aperture, voxel = 2.0, 0.8, 0.004  # small angles: the law is the paraxial one
    header = points_header(scan_type, cells(40, 40, aperture, aperture), bins=(3.9, 0.005, 140))
    path = write_points(tmp_path / "point.hdf5", header, [(0.0, 0.0, z)])
    for wavelength in (0.04 * ways, 0.08 * ways):
        line = {"volume_center": (0.0, 0.0, z), "volume_size": (0.8, voxel, voxel), "voxel_size": voxel}
        profile = reconstruct(path, wavelength=wavelength, cycles=20.0, **line).volume[0, 0]
        width = np.count_nonzero(profile > profile.max() / 2) * voxel
        # half the height of |sinc|: 1.207 wavelength z / aperture. The weights 1/r^3 fall by 6 % to the aperture's
        # edges (confocal: 1/r^5, 10 %), the slope there by 2 %: 3 % in width; counting may miss half a voxel per end.
        law = 1.207 * wavelength * z / (aperture * ways)
        assert width == pytest.approx(law, abs=0.03 * law + voxel)


@pytest.mark.parametrize("scan_type", SCANS)
def test_at_the_point_itself_all_waves_are_in_phase(tmp_path: Path, scan_type: str) -> None:
    """The field at a point scatterer is real and positive: no half bin, no leg and no sign is lost on the way."""
    header = points_header(scan_type, cells(12, 9, 1.4, 1.0), legs=True, bins=(1.3, 0.01, 500))
    pulse = Pulse(0.1)
    with open_capture(write_points(tmp_path / "point.hdf5", header, [POINT])) as capture:
        read = scan.read_scan(capture)
        grid = voxel_grid(read, pulse.wavelength, POINT, (0.01,), voxels=1)
        field = phasor.phasor_field(capture, read, grid, pulse, (1,)).item()
    # a deposit shared by two bins has its mean time exactly; half a bin would be 0.3 rad
    assert abs(np.angle(field)) < 0.01


def test_a_stored_grid_may_descend(tmp_path: Path) -> None:
    """Rows and columns stored the other way round are the same capture."""
    found = []
    for order in (1, -1):
        sensors = SENSORS[::order, ::order]
        path = write_points(tmp_path / f"{order}.hdf5", points_header("single", sensors), [POINT])
        found.append(reconstruct(path).volume)
    np.testing.assert_allclose(found[1], found[0], atol=1e-4 * found[0].max())


@pytest.mark.parametrize("scan_type", SCANS)
def test_backprojection_reads_histograms_at_the_voxels_path_length(tmp_path: Path, scan_type: str) -> None:
    """Histograms that hold their own time give the sum of path lengths, legs included, over the bin width."""
    header = points_header(scan_type, cells(3, 2, 0.6, 0.4), legs=True, bins=(0.2, 0.05, 100))
    lasers = 1 if header.confocal else header.laser_positions[..., 0].size
    times = 0.2 + 0.05 * (np.arange(100) + 0.5)
    light = np.broadcast_to(times, point_light(header, []).shape)
    path = write_light(tmp_path / "ramp.hdf5", header, light)
    with open_capture(path) as capture:
        read = scan.read_scan(capture)
        grid = voxel_grid(read, 0.1, (0.1, 0.0, 0.8), (0.4, 0.2, 0.3), voxel_size=0.1)
        found = backproject(capture, read, grid, (1,))
    expected = np.zeros(grid.shape)
    voxels = np.stack(np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")[::-1], axis=-1)
    for x, row, column in np.ndindex(lasers, *read.sensors.shape[:2]):
        sensor = read.sensors[row, column]
        at = (row, column) if read.confocal else np.unravel_index(x, read.lasers.shape[:2])
        ends = ((read.lasers[at], read.laser_legs[at]), (sensor, read.sensor_legs[row, column]))
        expected += sum(np.linalg.norm(voxels - end, axis=-1) + leg for end, leg in ends)
    pairs = lasers * 6
    # the nearest of four samples per bin: an eighth of a bin each at most
    np.testing.assert_allclose(found * 0.05 / pairs, expected / pairs, atol=0.05 / 8)


def direct_field(capture: scan.Scan, light: Array, wavenumbers: Array, pulse: Pulse, voxels: Array) -> Array:
    """Return the phasor field at voxels (n, 3) as the plain sum over lasers, sensors, bins and wavenumbers."""
    total = np.zeros(len(voxels), dtype=complex)
    centres, weights = capture.bin_centres(), pulse.weights(wavenumbers)
    for y, x, row, column in np.ndindex(light.shape[:4]):
        sensor = capture.sensors[row, column]
        laser = sensor if capture.confocal else capture.lasers[y, x]
        leg = capture.sensor_legs[row, column]
        leg = leg + (capture.laser_legs[row, column] if capture.confocal else capture.laser_legs[y, x])
        back = np.linalg.norm(voxels - sensor, axis=-1)
        forth = np.linalg.norm(voxels - laser, axis=-1)
        spectrum = np.exp(-1j * np.outer(wavenumbers, centres - leg)) @ light[y, x, row, column] * weights
        loss = back if capture.confocal else back * forth
        total += (np.exp(1j * np.outer(forth + back, wavenumbers)) @ spectrum) / loss
    return total


@pytest.mark.parametrize("scan_type", SCANS)
def test_the_fast_sum_is_the_plain_sum(tmp_path: Path, scan_type: str) -> None:
    """Convolution by FFT, refinement and interpolation equal the sum they stand for to 1e-4 of the largest value."""
    header = points_header(scan_type, cells(5, 3, 0.5, 0.4), legs=True, bins=(0.6, 0.02, 240))
    points = [(0.1, 0.05, 0.7), (-0.1, 0.0, 0.8)]
    path = write_points(tmp_path / "few.hdf5", header, points)
    pulse = Pulse(0.15, 4.0)
    with open_capture(path) as capture:
        read = scan.read_scan(capture)
        grid = voxel_grid(read, pulse.wavelength, (0.02, 0.01, 0.75), (0.37, 0.21, 0.13), voxel_size=0.033)
        field = phasor.phasor_field(capture, read, grid, pulse, (1,))
    voxels = np.stack(np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    wavenumbers = pulse.wavenumbers(unambiguous_period(read, grid.bounds, pulse))
    expected = direct_field(read, point_light(header, points), wavenumbers, pulse, voxels).reshape(grid.shape)
    np.testing.assert_allclose(field, expected, atol=1e-4 * np.abs(expected).max())


def test_nothing_wraps_around(tmp_path: Path) -> None:
    """A period twice as long, or no light from elsewhere, changes no more than the pulse's cut ends leave."""
    header = points_header("single", cells(6, 4, 1.0, 0.8))
    path = write_points(tmp_path / "far.hdf5", header, [POINT, (0.1, 0.1, 1.9)])  # the second is far behind
    pulse = Pulse(0.2)
    with open_capture(path) as capture:
        read = scan.read_scan(capture)
        grid = voxel_grid(read, 0.2, (0.1, 0.0, 0.8), (0.3, 0.2, 0.3), voxel_size=0.05)
        field = phasor.phasor_field(capture, read, grid, pulse, (1,))
    light = point_light(header, [POINT]).astype(np.float32)
    wavenumbers = pulse.wavenumbers(2 * unambiguous_period(read, grid.bounds, pulse))
    voxels = np.stack(np.meshgrid(grid.z, grid.y, grid.x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    longer = direct_field(read, light, wavenumbers, pulse, voxels).reshape(grid.shape) / 2  # twice as many terms
    # cut at 3 standard deviations: 1.1 % of the peak in frequency, which the step of the sum may or may not include
    np.testing.assert_allclose(np.abs(field), np.abs(longer), atol=0.02 * np.abs(longer).max())


def test_spectra_leave_out_what_no_voxel_can_send(tmp_path: Path) -> None:
    """Light earlier or later than any voxel's, by more than half a pulse, is not in the spectra."""
    header = points_header("single", cells(3, 2, 1.4, 0.8), bins=(0.0, 0.01, 600))
    with open_capture(write_points(tmp_path / "one.hdf5", header, [POINT])) as capture:
        read = scan.read_scan(capture)
    pulse = Pulse(0.1)
    box = (np.array([0.0, -0.1, 0.8]), np.array([0.2, 0.1, 0.9]))
    shortest, longest = path_lengths(read, box, (0, 0))
    # a bin more on either side; the sensor points see the box at different times
    early, late = shortest - pulse.half_length - 0.01, longest + pulse.half_length + 0.01
    times = read.bin_centres()
    outside = ((times < early[..., None]) | (times > late[..., None])).astype(np.float32)
    assert outside.any(axis=-1).all()
    found = spectra(read, outside, slice(0, 2), (0, 0), box, pulse, pulse.wavenumbers(2.0))
    assert not found.any()


def test_a_curved_wall_is_for_backprojection_only(tmp_path: Path) -> None:
    """Points on a cylinder: phasor fields refuse with the reason, backprojection finds the point."""
    flat = cells(24, 18, 1.8, 1.4)
    bent = np.stack([np.sin(flat[..., 0]), flat[..., 1], np.cos(flat[..., 0]) - 1], axis=-1)  # radius 1 m
    header = points_header("confocal", bent, legs=True, bins=(0.0, 0.01, 660), planar_wall=False)
    path = write_points(tmp_path / "bent.hdf5", header, [POINT])
    with pytest.raises(FileError, match=r"curved.*--method backprojection"):
        reconstruct(path)
    np.testing.assert_allclose(peak(reconstruct(path, "backprojection")), POINT, atol=0.02)


def test_bounces_are_chosen(tmp_path: Path) -> None:
    """The third bounce alone by default; ``all`` adds the false second bounce; a file of sums has no third."""
    header = points_header("confocal", cells(12, 10, 1.8, 1.4))
    path = write_points(tmp_path / "apart.hdf5", header, [POINT])
    third, everything = reconstruct(path), reconstruct(path, bounces="all")
    assert third.bounces == (3,)
    assert everything.bounces == (2, 3)
    assert not np.allclose(third.volume, everything.volume, rtol=0.1)
    summed = points_header("confocal", cells(12, 10, 1.8, 1.4), split_bounces=False, bounce_indices=(1,))
    path = write_points(tmp_path / "sums.hdf5", summed, [POINT])
    np.testing.assert_allclose(reconstruct(path).volume, third.volume)
    with pytest.raises(FileError, match=r"sum of all bounces.*--bounces all"):
        reconstruct(path, bounces="3")


@pytest.mark.slow
@pytest.mark.parametrize("scan_type", ["single", "confocal"])
def test_a_rendered_letter_is_recovered(tmp_path: Path, scan_type: str) -> None:
    """The letter of configs/z-letter.yaml comes back: 90 % of the union of true and found pixels are in both."""
    from support.rendering import configured

    from nlosrender import pipeline
    from nlosrender.analysis.reconstruction.score import score_front_view
    from nlosrender.analysis.reconstruction.silhouette import true_silhouette

    text = (Path(__file__).parents[2] / "configs" / "z-letter.yaml").read_text()
    path = tmp_path / "z.hdf5"
    overrides = [f"output.path={path}", f"capture.scan_type={scan_type}"]
    if scan_type == "confocal":
        overrides.append("capture.laser_point=null")
    pipeline.render_capture(configured(text, overrides))
    found = reconstruct_capture(path, ReconstructionSettings())
    score = score_front_view(found.front_view(), true_silhouette(path, found.source_attributes, found.grid))
    # measured: 0.950 and 0.993; the letter's rim is half a wavelength wide and the perimeter 4.5 m long
    assert score.iou > 0.9
    assert score.correlation > 0.9
