"""``measure`` and ``sensor:`` as a user meets them: files, reports, mistakes with their places."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from support.commands import run
from support.point_captures import cells, points_header, write_points
from support.rendering import flat_wall

from nlosrender.capture.part import Selection
from nlosrender.config.load import load_config, parse_config
from nlosrender.config.template import starter_config
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_USAGE, ConfigError, InterruptedRender
from nlosrender.files.parts.merge import merge_captures
from nlosrender.pipeline import render_capture
from nlosrender.sensor.detector import Detector

EXPOSURE = ("--set", "sensor.exposure_time=0.01", "--set", "sensor.photons_per_pulse.mean=0.05")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture of a point."""
    header = points_header("single", cells(7, 6, 1.4, 1.0), bins=(0.7, 0.02, 260), legs=True)
    return write_points(tmp_path / "ideal.hdf5", header, [(0.1, -0.2, 0.8)])


def test_a_profile_an_exposure_and_what_is_told(capture: Path) -> None:
    """The report, the same in info, and the parameters in the file."""
    done = run(capture.parent, "measure", capture, "-o", "counts.hdf5", "--sensor", "spad-532", *EXPOSURE, "--seed", 7)
    assert done.returncode == 0, done.stderr
    assert "wrote counts.hdf5" in done.stdout
    assert "110000 pulses" in done.stdout
    shown = run(capture.parent, "info", "counts.hdf5", "--check")
    for text in ("lost to pile-up", "profile: spad-532", "seed: 7", "measured from", "matches the Z-NLOS layout"):
        assert text in shown.stdout
    with h5py.File(capture.parent / "counts.hdf5") as file:
        sensor, units = json.loads(file.attrs["sensor"]), json.loads(file.attrs["sensor_keys"])
        assert json.loads(file.attrs["measurement"])["pulses"] == 110000
    assert sensor["jitter_fwhm_ps"] == 95
    assert sensor["seed"] == 7
    assert units["jitter_fwhm_ps"].startswith("ps")
    as_json = run(capture.parent, "measure", capture, "-o", "counts.hdf5", "--sensor", "spad-532", *EXPOSURE, "--json")
    assert json.loads(as_json.stdout)["measurement"]["lost_to_pile_up"] > 0


def test_profiles_are_listed_and_load() -> None:
    """Each with its comments; each is a sensor once what is left to the user is set."""
    listed = run(Path.cwd(), "measure", "--list").stdout
    for name in ("ideal", "poisson", "spad-532", "tmf8828", "vl53l8ch"):
        assert f"{name}:\n" in listed
        text = f"sensor: {{profile: {name}, pulses: 10, photons_per_pulse: {{mean: 1}}}}"
        assert sensor_of(text).profile == name


def test_the_starter_has_a_sensor() -> None:
    """Without its comment signs it is one."""
    lines = starter_config("confocal").splitlines()
    start = lines.index("# sensor:")
    end = lines.index("", start)
    assert "sensor:" in lines[start]
    text = "\n".join([*lines[:start], *(line.removeprefix("# ") for line in lines[start:end]), *lines[end:]])
    assert parse_config(text, "starter.yaml", Path.cwd()).sensor.n_pulses == 11_000_000


def sensor_of(text: str, folder: Path = Path.cwd()) -> object:  # noqa: B008
    """The sensor of a configuration that is else complete."""
    scene = flat_wall(sensors=(5, 3), bins=(1.6, 0.02, 100))
    return parse_config(yaml.safe_dump(dict(scene)) + text, "c.yaml", folder).sensor


def test_names_and_units_of_y_tal(tmp_path: Path) -> None:
    """Another name of a key is the key, in its own unit; a profile of one's own, and keys beside it."""
    text = """
sensor:
  time_jitter_FWHM: 70
  time_jitter_tail: 150
  time_jitter_tail_scale: 0.3
  laser_jitter_FWHM: 20
  frequency: 20
  exposure_time: 2
  external_noise_rate: 100
  dead_time: 50000
  bin_width_ps: 10
  photons_per_pulse: {brightest: 1}
"""
    sensor = sensor_of(text)
    values = (sensor.jitter_fwhm_ps, sensor.jitter_tail_ps, sensor.jitter_tail_share, sensor.laser_jitter_fwhm_ps)
    assert values == (70, 150, 0.3, 20)
    assert sensor.n_pulses == 40_000_000
    assert (sensor.ambient_rate, sensor.dead_time_ps) == (100, 50000)
    assert sensor.bin_width_opl == pytest.approx(0.00299792458)
    np.save(tmp_path / "jitter.npy", [1.0, 2.0])
    (tmp_path / "mine.yaml").write_text("jitter_file: jitter.npy\njitter_file_bin_ps: 5\npulses: 3\n")
    own = sensor_of("sensor: {profile: mine.yaml, pulses: 4, photons_per_pulse: {mean: 1}}", tmp_path)
    assert own.pulses == 4
    assert own.jitter_file == tmp_path / "jitter.npy"


EXPOSED = "pulses: 1, photons_per_pulse: {mean: 1}"
MISTAKES = {
    "pulses: 1": r"c.yaml:\d+:1: sensor.photons_per_pulse: missing",
    "profile: spad-523": r"c.yaml:\d+:19: sensor.profile: got 'spad-523', .* Did you mean spad-532\?",
    "profile: mine.yaml": r"sensor.profile: .*mine.yaml: cannot be read: No such file",
    f"{EXPOSED}, exposure_time: 1": "sensor.exposure_time: got 1 beside pulses 1",
    "exposure_time: 1, photons_per_pulse: {mean: 1}": "sensor.repetition_rate: missing beside exposure_time",
    "pulses: 1, photons_per_pulse: {}": "need one of the two: {brightest: x} or {mean: x}",
    "pulses: 1, photons_per_pulse: {mean: -1}": "got -1, need a number > 0",
    f"{EXPOSED}, gate: [2, 1]": r"sensor.gate: got \[2, 1\], need \[from, to\]",
    f"{EXPOSED}, pile_up: dead_time": "sensor.dead_time_ps: missing",
    f"{EXPOSED}, jitter_file: a.csv": "There is no .*a.csv",
    f"{EXPOSED}, dead_time: 1, dead_time_ps: 2": "another name of it; keep one",
    f"{EXPOSED}, afterpulse_probability: 1.5": "got 1.5, need a number from 0 to 1",
    f"{EXPOSED}, photon_detection_rate: 1": "Did you mean photon_detection_ratio",
    f"{EXPOSED}, zones: {{nx: 3, ny: 3, width: 1}}": "sensor.zones.height: missing",
}


@pytest.mark.parametrize(("keys", "message"), MISTAKES.items())
def test_mistakes_have_a_place(keys: str, message: str, tmp_path: Path) -> None:
    """File, line, key, value, what is allowed."""
    with pytest.raises(ConfigError, match=message):
        sensor_of(f"sensor: {{{keys}}}", tmp_path)


def test_mistakes_on_the_command_line(capture: Path) -> None:
    """Arguments: exit 2; values: exit 3, and no file."""
    folder = capture.parent
    assert run(folder, "measure").returncode == EXIT_USAGE
    assert "--output" in run(folder, "measure", capture).stderr
    assert (
        "need one of pile_up, background"
        in run(folder, "measure", capture, "-o", "c.hdf5", "--correct", "pileup").stderr
    )
    done = run(folder, "measure", capture, "-o", "c.hdf5", "--sensor", "spad-532", "--set", "sensor.pulses=none")
    assert done.returncode == EXIT_BAD_INPUT
    assert "--set sensor.pulses=none: sensor.pulses: got 'none' (text), need an integer >= 1" in done.stderr
    assert "sensor.photons_per_pulse: missing" in done.stderr
    done = run(folder, "measure", capture, "-o", capture, "--sensor", "spad-532", *EXPOSURE)
    assert "is read for this and would be replaced" in done.stderr
    assert not (folder / "c.hdf5").exists()


SENSOR = {"photons_per_pulse": {"brightest": 0.3}, "pulses": 10_000, "jitter_fwhm_ps": 200, "pile_up": "first_photon"}


def configuration(folder: Path, **sensor: object) -> Path:
    """A rendered scene with a sensor."""
    plate = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, 0, 0.9], "normal": [0, 0, -1]}
    scene = flat_wall(plate, scan="exhaustive", sensors=(5, 3), lasers=(2, 7), bins=(1.6, 0.02, 100), spp=64)
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({**scene, "sensor": {**SENSOR, **sensor}}))
    return path


def counts(path: Path) -> np.ndarray:
    """The counts beside the ideal samples."""
    with h5py.File(path) as file:
        return file["counts"][()]


def test_counts_beside_the_ideal_are_the_same_however_it_is_cut(tmp_path: Path) -> None:
    """1, 2 and 7 shards; measure makes the same of the file; the ideal samples are those without a sensor."""
    config = configuration(tmp_path)
    whole = tmp_path / "whole.hdf5"
    render_capture(load_config(config, [f"output.path={whole}"]))
    with h5py.File(whole) as file:
        found = file["counts"][()]
        assert file["counts"].attrs["unit"] == "counts"
        assert found.shape == file["data"].shape
        assert json.loads(file.attrs["measurement"])["counts"] == found.sum() > 0
    for shards in (2, 7):
        parts = [tmp_path / f"{shards}-{i}.hdf5" for i in range(shards)]
        for i, part in enumerate(parts):
            render_capture(load_config(config, [f"output.path={part}"]), selection=Selection(shard=(i + 1, shards)))
            with h5py.File(part) as file:
                assert "counts" not in file
        merge_captures(parts, tmp_path / "merged.hdf5", overwrite=True)
        assert np.array_equal(counts(tmp_path / "merged.hdf5"), found)
    done = run(tmp_path, "measure", whole, "-o", "counts.hdf5")
    assert done.returncode == 0, done.stderr
    with h5py.File(tmp_path / "counts.hdf5") as file:
        assert np.array_equal(file["data"][()], found)
    refused = run(tmp_path, "measure", parts[0], "-o", "part.hdf5")
    assert "is a part of a capture" in refused.stderr


def test_another_sensor_needs_no_other_render(tmp_path: Path) -> None:
    """The section is no part of the capture: its file is replaced, and a render stopped half-way goes on."""
    config, output = configuration(tmp_path), tmp_path / "a.hdf5"
    render_capture(load_config(config, [f"output.path={output}"]))
    with h5py.File(output) as file:
        ideal, name = file["data"][()], file.attrs["capture_hash"]
    first = counts(output)
    render_capture(load_config(config, [f"output.path={output}", "sensor.seed=4"]))
    assert not np.array_equal(counts(output), first)
    render_capture(load_config(config, [f"output.path={output}", "sensor=null"]))
    with h5py.File(output) as file:
        assert "counts" not in file
        assert file.attrs["capture_hash"] == name
        assert np.array_equal(file["data"][()], ideal)


def test_a_sensor_that_does_not_fit_is_told_before_the_render(tmp_path: Path) -> None:
    """With the place in the file."""
    config = configuration(tmp_path, jitter_fwhm_ps=20000)
    done = run(tmp_path, "render", config, "-o", "a.hdf5")
    assert done.returncode == EXIT_BAD_INPUT
    assert "scene.yaml:" in done.stderr
    assert "sensor.jitter_fwhm_ps: 99.9 % of the response take" in done.stderr
    zones = run(
        tmp_path, "validate", configuration(tmp_path, zones={"nx": 2, "ny": 2}), "--set", "capture.scan_type=confocal"
    )
    assert "got zones with scan type confocal" in zones.stderr


def test_a_camera_counts_relative_photons(tmp_path: Path) -> None:
    """A line_of_sight capture is scaled to photons per pulse; a physical scale has no meaning there."""
    lamp = {"type": "rectangle", "width": 1, "height": 1, "center": [0, 0, 0], "normal": [0, 0, 1], "radiance": 1}
    camera = {"position": [0, 0, 2], "look_at": [0, 0, 0], "width": 5, "height": 4}
    config = {
        "scene": {"emitters": [lamp]},
        "capture": {"scan_type": "line_of_sight", "camera": camera},
        "time_axis": {"bin_width_opl": 0.05, "n_bins": 80},
        "render": {"spp": 16},
        "output": {"path": str(tmp_path / "view.hdf5")},
        "sensor": {"photons_per_pulse": {"mean": 0.1}, "pulses": 1000},
    }
    (tmp_path / "view.yaml").write_text(yaml.safe_dump(config))
    render_capture(load_config(tmp_path / "view.yaml"))
    assert counts(tmp_path / "view.hdf5").sum() == pytest.approx(20 * 100, abs=5 * 45)  # 5 sigma of 2000
    done = run(tmp_path, "measure", "view.hdf5", "-o", "counts.hdf5")
    assert done.returncode == 0, done.stderr
    assert run(tmp_path, "info", "counts.hdf5", "--check").returncode == 0
    physical = ("--set", "sensor.photons_per_pulse=null", "--set", "sensor.wavelength_nm=532")
    done = run(tmp_path, "measure", "view.hdf5", "-o", "b.hdf5", *physical, "--set", "sensor.aperture_solid_angle=1e-5")
    assert "of steady lamps, which have no energy per pulse" in done.stderr


def test_pictures_of_counts(capture: Path) -> None:
    """Counts alone, beside the ideal capture, and what is not its ideal capture; comparisons tell counts from light."""
    folder = capture.parent
    run(folder, "measure", capture, "-o", "counts.hdf5", "--sensor", "spad-532", *EXPOSURE)
    done = run(folder, "plot", "counts.hdf5", "--ideal", capture)
    assert done.returncode == 0, done.stderr
    assert (folder / "counts.png").read_bytes().startswith(b"\x89PNG")
    assert "holds no counts that" in run(folder, "plot", capture, "--ideal", "counts.hdf5").stderr
    assert "is not the ideal capture of" in run(folder, "plot", "counts.hdf5", "--ideal", "counts.hdf5").stderr
    assert "samples" in run(folder, "compare", "counts.hdf5", capture).stdout


def test_few_counts_are_told_before_a_reconstruction(capture: Path) -> None:
    """A warning with the number; the volume is written."""
    few = ("--set", "sensor.pulses=100", "--set", "sensor.photons_per_pulse.mean=0.05")
    run(capture.parent, "measure", capture, "-o", "counts.hdf5", "--sensor", "poisson", *few)
    done = run(capture.parent, "reconstruct", "counts.hdf5", "--voxels", "8")
    assert done.returncode == 0, done.stderr
    assert "shot noise is more than 10%" in done.stderr


def test_a_render_that_is_stopped_while_it_counts_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All light is kept, and counted by another sensor then."""
    config, output = configuration(tmp_path), tmp_path / "a.hdf5"

    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Detector, "measure", stopped)
        with pytest.raises((KeyboardInterrupt, InterruptedRender)):
            render_capture(load_config(config, [f"output.path={output}"]))
    assert not output.exists()
    report = render_capture(load_config(config, [f"output.path={output}", "sensor.pulses=77"]))
    assert report.resumed_units == report.units
    with h5py.File(output) as file:
        assert json.loads(file.attrs["measurement"])["pulses"] == 77
        assert json.loads(file.attrs["config"])["sensor"]["pulses"] == 77
        assert file["counts"][()].any()


def test_a_sweep_over_a_sensor(tmp_path: Path) -> None:
    """Keys of the sensor are swept like any other, by their names."""
    config = configuration(tmp_path)
    text = yaml.safe_load(config.read_text())
    text |= {"sweep": {"keys": {"sensor.pulses": [10, 20000]}}, "output": {"path": str(tmp_path / "{index}.hdf5")}}
    config.write_text(yaml.safe_dump(text))
    assert run(tmp_path, "render", config).returncode == 0
    few, many = counts(tmp_path / "0.hdf5").sum(), counts(tmp_path / "1.hdf5").sum()
    assert many > 500 * few
