"""Measured captures: files of counts, whoever wrote the ideal one, and what is refused."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.partial_captures import write_capture
from support.point_captures import cells, point_light, points_header, write_light

from nlosrender.analysis.measured_plot import measured_pair
from nlosrender.config.sensor import SensorConfig
from nlosrender.config.sensor_load import load_sensor
from nlosrender.errors import ConfigError, FileError, NlosError
from nlosrender.files.export.export import export_capture
from nlosrender.files.measured import few_counts, measure_capture
from nlosrender.files.reading.reader import open_capture, read_header
from nlosrender.files.validation import check_file

POINTS = [(0.1, -0.2, 0.8), (-0.2, 0.1, 1.0)]
BINS = (0.7, 0.02, 260)
EXPOSURE = {"pulses": 100_000, "photons_per_pulse": {"mean": 0.2}}


def sensor(**keys: object) -> SensorConfig:
    """A sensor with these keys; 1e5 pulses of 0.2 photons on average."""
    values = EXPOSURE | keys
    return load_sensor(None, None, [f"sensor.{key}={json.dumps(value)}" for key, value in values.items()])


def ideal(folder: Path, scan: str = "single", **changes: Any) -> Path:
    """A capture of two points, the second bounce bright: 7 x 6 sensor points."""
    header = points_header(scan, cells(7, 6, 1.4, 1.0), bins=BINS, legs=True, bounce_indices=(1,), **changes)
    return write_light(folder / f"{scan}.hdf5", header, point_light(header, POINTS))


def counts_of(path: Path, dataset: str = "data") -> np.ndarray:
    """All samples of index 1 of the bounce axis; the others are empty."""
    with h5py.File(path) as file:
        samples = file[dataset][()]
    assert not samples[:, :, [0, 2, 3, 4, 5]].any()
    return samples[0, :, 1]


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_counts_are_a_capture(tmp_path: Path, scan: str) -> None:
    """Every reader of the ideal file reads the measured one: same points, same scan, integers for samples."""
    source, target = ideal(tmp_path, scan), tmp_path / "counts.hdf5"
    report = measure_capture(source, target, sensor(jitter_fwhm_ps=150, pile_up="first_photon", seed=3))
    check = check_file(target)
    assert check.is_ours
    assert not check.violations
    with h5py.File(source) as before, h5py.File(target) as after:
        for name in before:
            if name not in ("data", "variance"):
                np.testing.assert_allclose(after[name][()], before[name][()], atol=1e-6, err_msg=name)
        assert after["data"].attrs["unit"] == "counts"
        for name in ("frame", "scan_type", "file_to_scene", "relay_wall_to_scene"):
            assert np.array_equal(after.attrs[name], before.attrs[name]) or np.allclose(
                after.attrs[name], before.attrs[name]
            )
    counts = counts_of(target)
    assert np.array_equal(counts, np.rint(counts))
    assert counts.sum() == report.measurement["counts"]
    # 5 sigma of the detections, a binomial
    expected = float(str(report.measurement["expected_counts"]))
    assert abs(counts.sum() - expected) < 5 * expected**0.5
    export_capture(target, tmp_path / "tal.hdf5", "tal", "all")


def test_the_same_counts_for_any_number_of_threads_and_another_seed_makes_others(tmp_path: Path) -> None:
    """Bit for bit; an exhaustive capture with blocks of every laser point."""
    source, found = ideal(tmp_path, "exhaustive"), []
    for threads, seed in ((1, 1), (4, 1), (2, 2)):
        for mode in ({"pile_up": "none"}, {"pile_up": "first_photon"}, {"pile_up": "dead_time", "dead_time_ps": 3000}):
            target = tmp_path / "counts.hdf5"
            measure_capture(source, target, sensor(seed=seed, **mode), threads=threads)
            found.append(counts_of(target))
    for one, four, other in zip(found[:3], found[3:6], found[6:], strict=True):
        assert np.array_equal(one, four)
        # of independent counts (a - b)^2 / (a + b) is 1 on average, less what pile-up takes of their variance
        lit = one + other > 40
        assert 0.75 < ((one - other)[lit] ** 2 / (one + other)[lit]).mean() < 1.15
        assert not np.array_equal(one, other)


def test_expectations_and_their_corrections(tmp_path: Path) -> None:
    """Without shot noise the three modes are their means; what pile-up takes and background adds can be undone."""
    source = ideal(tmp_path)
    background = {"ambient_rate": 2e5, "dark_count_rate": 1e5, "repetition_rate": 4e7, "shot_noise": False}
    free, target = tmp_path / "free.hdf5", tmp_path / "target.hdf5"
    measure_capture(source, free, sensor(**background))
    truth = counts_of(free)
    assert truth.sum() == pytest.approx(6 * 7 * 100_000 * (0.2 + 3e5 * 260 * 0.02 / 299792458), rel=1e-5)
    for mode in ({"pile_up": "first_photon"}, {"pile_up": "dead_time", "dead_time_ps": 4000}):
        report = measure_capture(source, target, sensor(**background, **mode))
        assert counts_of(target).sum() < 0.95 * truth.sum()
        assert report.measurement["lost_to_pile_up"] == pytest.approx(
            1 - counts_of(target).sum() / truth.sum(), abs=1e-6
        )
        undone = tmp_path / "undone.hdf5"
        measure_capture(target, undone, None, corrections=("pile_up",))  # of the file of counts
        np.testing.assert_allclose(counts_of(undone), truth, rtol=0.01)
        measure_capture(source, undone, sensor(**background, **mode), corrections=("pile_up", "background"))
        assert counts_of(undone).sum() == pytest.approx(6 * 7 * 100_000 * 0.2, rel=1e-3)
        with pytest.raises(FileError, match="corrected by the sensor that counted them"):
            measure_capture(target, undone, sensor(), corrections=("pile_up",))
        with pytest.raises(FileError, match="corrected for pile_up, background already"):
            measure_capture(undone, tmp_path / "twice.hdf5", None, corrections=("pile_up",))


def test_afterpulses_and_crosstalk_add_what_they_say(tmp_path: Path) -> None:
    """p / (1 - p) more counts where all delays are in the bins, and a share of the light at its own delay."""
    source, target = ideal(tmp_path), tmp_path / "counts.hdf5"
    # all of the period is in the bins, so every afterpulse is
    whole = {"repetition_rate": 299792458 / 5.2, "shot_noise": False}
    measure_capture(source, target, sensor(**whole))
    plain = counts_of(target).sum()
    for p, decay in ((0.05, 800.0), (0.3, [500.0, 3000.0])):
        measure_capture(source, target, sensor(**whole, afterpulse_probability=p, afterpulse_decay_ps=decay))
        assert counts_of(target).sum() == pytest.approx(plain / (1 - p), rel=1e-5)
    measure_capture(source, target, sensor(**whole, crosstalk={"share": 0.25, "delay_opl": 0.7 + 3.5 * 0.02}))
    counts = counts_of(target)
    assert counts.sum() == pytest.approx(1.25 * plain, rel=1e-5)
    assert counts[3].sum() == pytest.approx(0.25 * plain, rel=1e-5)


def test_brightness_relative_and_physical(tmp_path: Path) -> None:
    """The brightest histogram, the mean of all, and J m^-2 sr^-1 through an aperture."""
    source, target = ideal(tmp_path), tmp_path / "counts.hdf5"
    quiet = {"shot_noise": False, "pulses": 1}
    measure_capture(source, target, sensor(**quiet))
    assert counts_of(target).sum(axis=0).mean() == pytest.approx(0.2, rel=1e-5)
    measure_capture(source, target, sensor(**quiet, photons_per_pulse={"brightest": 0.7}))
    assert counts_of(target).sum(axis=0).max() == pytest.approx(0.7, rel=1e-5)
    optics = {"wavelength_nm": 532, "aperture_solid_angle": 2e-5, "transmission": 0.5, "photon_detection_ratio": 0.4}
    measure_capture(source, target, sensor(**quiet, photons_per_pulse=None, **optics))
    with h5py.File(source) as file:
        energy = file["data"][()].sum()  # J m^-2 sr^-1
    photon = 6.62607015e-34 * 299792458 / 532e-9
    area = 2.0 * 1.6 / 42  # of a cell
    assert counts_of(target).sum() == pytest.approx(energy * area * 2e-5 * 0.5 * 0.4 / photon, rel=1e-5)


def test_zones_sum_what_they_see(tmp_path: Path) -> None:
    """All zones together see all the light of their rectangle; seen from the sensor or on the wall."""
    source, target = ideal(tmp_path, "exhaustive"), tmp_path / "zones.hdf5"
    measure_capture(
        source, target, sensor(shot_noise=False, pulses=1, zones={"nx": 3, "ny": 2, "width": 1.4, "height": 1.0})
    )
    assert not check_file(target).violations
    with open_capture(source) as capture:
        light = capture.read_block()[0].sum(axis=0)  # (ly, lx, ny, nx, bins)
    zone = light[:, :, :3, 2:5].sum(axis=(2, 3))
    with open_capture(target) as capture:
        zones = capture.read_block()[0, 0]
        assert capture.header.sensor_grid == (2, 3)
    np.testing.assert_allclose(zones[:, :, 0, 1], zone * zones.sum() / light.sum(), rtol=1e-4, atol=1e-6)
    angles = {"nx": 3, "ny": 2, "width_deg": 45, "height_deg": 30}
    measure_capture(source, target, sensor(shot_noise=False, zones=angles))
    with open_capture(target) as capture:
        places = capture.positions.sensor_positions
        assert (np.diff(places[..., 0], axis=1) > 0).all()  # X of the file is the wall's x: zones are not mirrored
        assert (np.diff(places[..., 2], axis=0) > 0).all()
    with pytest.raises(ConfigError, match=r"zones: zone in row 0, column 0 has no sensor point"):
        measure_capture(source, target, sensor(zones={"nx": 40, "ny": 2}))


def test_files_by_others_are_measured(tmp_path: Path) -> None:
    """Without an attribute, in the layout's frame: the same counts as ours."""
    source, plain = ideal(tmp_path), tmp_path / "plain.hdf5"
    with h5py.File(source) as ours, h5py.File(plain, "w") as theirs:
        for name in ours:
            if name != "variance":
                theirs[name] = ours[name][()]
    targets = tmp_path / "a.hdf5", tmp_path / "b.hdf5"
    for path, target in zip((source, plain), targets, strict=True):
        # float32 of t0 and deltaT: bins of their own, not those of the file
        measure_capture(path, target, sensor(bin_width_opl=0.04, start_opl=0.8, n_bins=100, shot_noise=False))
    np.testing.assert_allclose(counts_of(targets[0]), counts_of(targets[1]), rtol=1e-3, atol=0.1)
    with h5py.File(targets[0]) as one, h5py.File(targets[1]) as other:
        for name in ("cameraGridPositions", "cameraPosition", "laserGridNormals"):
            np.testing.assert_allclose(one[name][()], other[name][()], atol=1e-6)
    physical = sensor(photons_per_pulse=None, wavelength_nm=532, aperture_solid_angle=1e-5)
    with pytest.raises(ConfigError, match=r"does not say that its data are in J m\^-2 sr\^-1"):
        measure_capture(plain, targets[1], physical)


REFUSED = {
    "a response longer than the bins": (
        {"jitter_fwhm_ps": 30_000},
        r"sensor.jitter_fwhm_ps: 99.9 % of the response take 25.1692 m, and all bins 5.2 m",
    ),
    "bins beyond the period": (
        {"repetition_rate": 1e8, "n_bins": 260},
        r"sensor.n_bins: got 260 bins .* need at most 149",
    ),
    "a gate beside the bins": (
        {"gate": [7.0, 8.0]},
        r"sensor.gate: got \[7.0, 8.0\], need some of the bins, from 0.7 to 5.9",
    ),
}


@pytest.mark.parametrize(("keys", "message"), REFUSED.values(), ids=REFUSED)
def test_a_detector_that_does_not_fit_is_refused(tmp_path: Path, keys: dict[str, object], message: str) -> None:
    """With the numbers, and no file is left."""
    with pytest.raises(ConfigError, match=message):
        measure_capture(ideal(tmp_path), tmp_path / "counts.hdf5", sensor(**keys))
    assert not (tmp_path / "counts.hdf5").exists()


def test_warnings_have_numbers(tmp_path: Path) -> None:
    """A period that cuts the signal, and bins that cut it, are legal."""
    source, said = ideal(tmp_path), []
    measure_capture(source, tmp_path / "a.hdf5", sensor(repetition_rate=1e8), warn=said.append)
    assert "the capture is 5.2 m long and the period 2.99792 m" in said[0]
    measure_capture(source, tmp_path / "a.hdf5", sensor(n_bins=100), warn=said.append)
    assert "the bins are from 0.7 to 2.7 m, the capture from 0.7 to 5.9 m" in said[1]


def test_what_cannot_be_measured(tmp_path: Path) -> None:
    """Counts, negative light, and captures that are no counts are not replaced by counts."""
    source, target = ideal(tmp_path), tmp_path / "counts.hdf5"
    with pytest.raises(FileError, match="names no sensor"):
        measure_capture(source, target, None)
    measure_capture(source, target, sensor(pulses=1))
    header = read_header(target)
    assert header.is_measured
    assert "shot noise is more than 10%" in next(few_counts(header))
    with pytest.raises(FileError, match="holds counts already"):
        measure_capture(target, tmp_path / "again.hdf5", sensor())
    measure_capture(source, target, sensor())  # counts are replaced by counts
    assert not [*few_counts(read_header(target))]
    other = ideal(tmp_path, "confocal")
    with pytest.raises(FileError, match="is not a measured capture by nlosrender"):
        measure_capture(source, other, sensor())
    with h5py.File(source, "r+") as file:
        file["data"][0, 5, 1, 2, 3] = -1.0
    with pytest.raises(FileError, match="holds negative light, -1"):
        measure_capture(source, target, sensor())


def test_light_of_no_capture_makes_background_alone(tmp_path: Path) -> None:
    """A dark capture is measured like any other."""
    source, target = ideal(tmp_path), tmp_path / "counts.hdf5"
    with h5py.File(source, "r+") as file:
        file["data"][...] = np.zeros(file["data"].shape, np.float32)
    report = measure_capture(source, target, sensor(ambient_rate=1e6))
    assert report.measurement["signal_to_background"] == 0
    assert isinstance(report.measurement, dict)
    with pytest.raises(NlosError, match="also use --correct pile_up"):
        measure_capture(source, target, sensor(pile_up="first_photon"), corrections=("background",))


def test_truth_goes_with_the_counts(tmp_path: Path) -> None:
    """What the ideal file says of the hidden scene is in the file that a network is trained on."""
    source, target = ideal(tmp_path), tmp_path / "counts.hdf5"
    with h5py.File(source, "r+") as file:
        file["gt_depth"] = np.full((6, 7), 0.8, np.float32)
    measure_capture(source, target, sensor())
    with h5py.File(target) as file:
        assert (file["gt_depth"][()] == np.float32(0.8)).all()


@pytest.mark.parametrize(("channels", "name"), [(3, "rgb"), (4, "stokes")])
def test_a_detector_knows_no_colour(tmp_path: Path, channels: int, name: str) -> None:
    """Colours are averaged, and of polarised light it is the intensity."""
    header = points_header("single", cells(7, 6, 1.4, 1.0), bins=BINS, bounce_indices=(1,), n_channels=channels)
    light = point_light(header, POINTS).astype(np.float32)
    block = np.stack([light * factor for factor in (1.0, 2.0, 6.0, -1.0)[:channels]])[:, None]
    source, target = write_capture(tmp_path / "source.hdf5", header, block), tmp_path / "counts.hdf5"
    measure_capture(source, target, sensor(shot_noise=False, pulses=1, photons_per_pulse={"mean": 1}))
    with h5py.File(target) as file:
        assert file["data"].shape[0] == 1
        assert "channels" not in file.attrs
    expected = light[0, 0].transpose(2, 0, 1)[..., None, None]
    np.testing.assert_allclose(counts_of(target), expected * 42 / expected.sum(), rtol=1e-5)
    assert not check_file(target).violations


@pytest.mark.parametrize("detector_bins", [1500, pytest.param(30, marks=pytest.mark.slow)])
def test_many_blocks_are_the_whole(tmp_path: Path, detector_bins: int) -> None:
    """More points than are counted at once, and fewer bins than the capture has: nothing is missing or there twice."""
    header = points_header("confocal", cells(70, 47, 1.4, 1.0), bins=(0.9, 0.004, 1500), bounce_indices=(1,))
    source, target = write_light(tmp_path / "a.hdf5", header, point_light(header, POINTS)), tmp_path / "counts.hdf5"
    width = 0.004 * 1500 / detector_bins
    measure_capture(source, target, sensor(shot_noise=False, pulses=1, bin_width_opl=width))
    counts, light = counts_of(target), counts_of(source)
    joined = light.reshape(detector_bins, -1, 47, 70).sum(axis=1)
    np.testing.assert_allclose(counts, joined * counts.sum() / joined.sum(), rtol=1e-4, atol=1e-7)


def test_a_response_that_is_gone(tmp_path: Path) -> None:
    """Its counts can be read, and drawn as any capture; another measurement needs another sensor."""
    source, target, curve = ideal(tmp_path), tmp_path / "counts.hdf5", tmp_path / "curve.npy"
    np.save(curve, [1.0, 3.0, 1.0])
    measure_capture(source, target, sensor(jitter_file=str(curve), jitter_file_bin_ps=40))
    curve.unlink()
    with pytest.raises(FileError, match=r"its sensor cannot be used: sensor.jitter_file: got .*curve.npy"):
        measure_capture(target, tmp_path / "b.hdf5", None, corrections=("pile_up",))
    with open_capture(target) as capture, ExitStack() as stack:
        assert measured_pair(capture, None, stack) is None


@pytest.mark.parametrize(
    ("values", "message"), [([1, -2], "holds -2"), ([0, 0], "holds no light"), ([], "holds no light")]
)
def test_a_response_of_nonsense(tmp_path: Path, values: list[float], message: str) -> None:
    """Told with the file's name, by its key."""
    np.save(tmp_path / "curve.npy", np.array(values, float))
    with pytest.raises(ConfigError, match=rf"sensor.jitter_file: .*curve.npy {message}"):
        measure_capture(
            ideal(tmp_path), tmp_path / "b.hdf5", sensor(jitter_file=str(tmp_path / "curve.npy"), jitter_file_bin_ps=40)
        )
