"""``nlosrender render`` as its users meet it: files, reports, exit codes."""

import json

import h5py
import pytest
from support.commands import run
from support.partial_captures import validate_file

SCENE = """
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9], normal: [0, 0, -1], bsdf: BSDF}
capture:
  scan_type: SCAN
  sensor_grid: {nx: 4, ny: 3}
  LASERS
time_axis: {bin_width_opl: 0.05, n_bins: auto}
render: {max_bounces: 4, spp: 64, engine: ENGINE}
"""
LASERS = {"single": "laser_point: [0.2, 0.1]", "confocal": "", "exhaustive": "laser_grid: {nx: 2, ny: 5}"}


def write_config(folder, scan="single", engine="path", bsdf="{type: diffuse, reflectance: 0.7}"):
    path = folder / "scene.yaml"
    text = SCENE.replace("SCAN", scan).replace("LASERS", LASERS[scan]).replace("BSDF", bsdf).replace("ENGINE", engine)
    path.write_text(text)
    return path


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_render_leaves_a_valid_file_and_an_honest_report(scan, tmp_path):
    """One command, one file of the fixed layout, and a JSON report that agrees with it."""
    config = write_config(tmp_path, scan)
    done = run(tmp_path, "render", config, "-o", "capture.hdf5", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert set(report["seconds"]) == {"scene", "compile", "render", "compress", "write", "total"}
    assert report["error_estimate"] > 0
    assert report["out_of_window"] == 0
    assert validate_file(tmp_path / "capture.hdf5") == []
    with h5py.File(tmp_path / "capture.hdf5") as file:
        assert file["data"].shape[:5] == (1, report["n_bins"], 6, 3, 4)
        assert file["data"].shape[5:] == ((5, 2) if scan == "exhaustive" else () if scan == "confocal" else (1, 1))
        # float32 samples: the sum of n of them is off by less than n * 6e-8 of it
        assert file["data"][...].sum(dtype=float) == pytest.approx(sum(report["energy"].values()), rel=1e-5)
        assert json.loads(file.attrs["config"])["render"]["spp"] == 64
        assert json.loads(file.attrs["warnings"]) == report["warnings"]
        assert file.attrs["engine_reason"] == report["reason"]
        assert "second bounce: no light goes straight" in file.attrs["omitted_work"]  # the wall is planar


@pytest.mark.parametrize("part", [("--lasers", "0:99"), ("--shard", "1/16")])
def test_a_part_that_the_capture_does_not_have(part, tmp_path):
    """A mistake in the arguments, exit code 2, though only the configuration tells; nothing is left."""
    config = write_config(tmp_path, "exhaustive")
    done = run(tmp_path, "render", config, "-o", "a.hdf5", *part)
    assert (done.returncode, f"error: {' '.join(part)}: " in done.stderr) == (2, True), done.stderr
    assert list(tmp_path.iterdir()) == [config]


def test_the_output_defaults_to_the_name_of_the_configuration(tmp_path):
    """scene.yaml gives scene.hdf5 in the current folder, and the report says so."""
    done = run(tmp_path, "render", write_config(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "wrote scene.hdf5" in done.stdout
    assert (tmp_path / "scene.hdf5").exists()


def test_set_overrides_a_key(tmp_path):
    """Shell loops sweep with --set."""
    done = run(tmp_path, "render", write_config(tmp_path), "--set", "capture.sensor_grid.nx=7", "--json")
    assert done.returncode == 0, done.stderr
    with h5py.File(tmp_path / "scene.hdf5") as file:
        assert file["data"].shape[4] == 7


def test_quiet_prints_nothing(tmp_path):
    """--quiet is for loops whose output is looked at only when something fails."""
    done = run(tmp_path, "render", write_config(tmp_path), "--quiet")
    assert (done.returncode, done.stdout) == (0, "")


def test_what_only_mitsuba_rejects_is_reported_with_its_place(tmp_path):
    """A parameter that Mitsuba does not accept ends in exit 3 with file:line:column, and no file is written."""
    config = write_config(tmp_path, bsdf="{type: hair, no_such_parameter: 3}")
    done = run(tmp_path, "render", config)
    assert done.returncode == 3, done.stderr
    assert "scene.yaml:5:" in done.stderr
    assert "scene.hidden_geometry.0.bsdf" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.yaml"]


def test_a_mesh_that_is_no_mesh_is_reported_with_its_place(tmp_path):
    """Garbage in a .ply ends in exit 3, naming the file and the key."""
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n1 2")
    text = write_config(tmp_path).read_text()
    start = text.index("    - {type: rectangle")
    text = text[:start] + "    - {type: mesh, filename: broken.ply}\n" + text[text.index("capture:") :]
    (tmp_path / "scene.yaml").write_text(text)
    done = run(tmp_path, "render", "scene.yaml")
    assert done.returncode == 3, done.stderr
    assert "broken.ply" in done.stderr
    assert "scene.yaml:5:" in done.stderr


def test_an_output_folder_that_is_missing_is_found_before_rendering(tmp_path):
    """Nothing long starts when its result could not be written."""
    done = run(tmp_path, "render", write_config(tmp_path), "-o", "missing/capture.hdf5")
    assert done.returncode == 3
    assert "missing" in done.stderr


def test_a_capture_that_cannot_fit_is_refused(tmp_path):
    """The memory limit is checked before anything is allocated."""
    settings = ("--set", "time_axis.n_bins=1000000000", "--set", "render.memory_limit=1GB")
    done = run(tmp_path, "render", write_config(tmp_path), *settings)
    assert done.returncode == 3, done.stderr
    assert "memory_limit" in done.stderr


@pytest.mark.parametrize("command", ["render", "merge", "doctor", "new", "validate", "schema", "info", "plot"])
def test_help_ends_with_an_example(command, tmp_path):
    """Each command's --help shows one real call and what it creates."""
    done = run(tmp_path, command, "--help")
    assert done.returncode == 0
    assert f"nlosrender {command}" in done.stdout
    assert "Example" in done.stdout
