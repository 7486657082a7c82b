"""``nlosrender plan`` as its users meet it: what it says agrees with what ``render`` then does."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path

import h5py
import pytest
from support.render_processes import plate_scene
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.errors import EXIT_BAD_INPUT, ConfigError

SCENE = plate_scene("""\
capture:
  scan_type: SCAN
  sensor_grid: {nx: 4, ny: 3}
  LASERS
time_axis: {bin_width_opl: 0.05, n_bins: auto}
render: {max_bounces: 4, spp: 64}
""")
VIEW = """
scene:
  hidden_geometry: [{type: rectangle, width: 0.5, height: 0.4, center: [0, 0, 0.9], normal: [0, 0, -1]}]
  emitters: [{type: point, position: [0, 0.3, 0], intensity: 1.0}]
capture:
  scan_type: line_of_sight
  camera: {position: [0, 0, -1], look_at: [0, 0, 1], width: 5, height: 3}
time_axis: {bin_width_opl: 0.05, n_bins: 200}
render: {max_bounces: 3, spp: 16}
"""
LASERS = {"single": "laser_point: [0.2, 0.1]", "confocal": "", "exhaustive": "laser_grid: {nx: 2, ny: 5}"}
KEYS = {
    "engine", "reason", "skipped", "batches", "bytes_per_batch", "n_bins", "window_opl", "file", "seconds_estimate",
    "warnings",
}  # fmt: skip

runner = CliRunner()


@pytest.fixture(autouse=True)
def short_pilot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Half a second per pilot is for users."""
    from nlosrender.engine.backend import start as backend

    backend.start_backend("llvm")  # Mitsuba starts before the engine modules are imported
    from nlosrender.engine.interface import PilotSeconds
    from nlosrender.engine.preflight import time_estimate

    quick = partial(time_estimate.estimate_render_time, pilot=PilotSeconds(tracing=0.02))
    monkeypatch.setattr(time_estimate, "estimate_render_time", quick)
    monkeypatch.chdir(tmp_path)


def write_config(scan: str = "single") -> str:
    Path("scene.yaml").write_text(SCENE.replace("SCAN", scan).replace("LASERS", LASERS[scan]))
    return "scene.yaml"


def run(command: str, *arguments: str):
    result = runner.invoke(app, [command, *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def planned(*arguments: str) -> dict:
    return json.loads(run("plan", *arguments, "--json").stdout)


@pytest.mark.parametrize(
    ("engine", "scan"),
    [("path", "single"), ("auto", "confocal")]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in (("path", "confocal"), ("path", "exhaustive"), ("auto", "single"), ("auto", "exhaustive"))
    ],
)
def test_the_plan_agrees_with_the_render(engine, scan):
    """Bins, window, engine, reason, file size: what is announced is what comes."""
    changes = ["--set", f"render.engine={engine}", "--set", "render.spp=null", "--set", "render.target_error=0.3"]
    config = write_config(scan)
    plan = planned(config, *changes)
    assert set(plan) >= KEYS
    assert not Path("scene.hdf5").exists()
    report = json.loads(run("render", config, *changes, "--json").stdout)
    assert (plan["n_bins"], plan["engine"], plan["reason"]) == (report["n_bins"], report["engine"], report["reason"])
    assert plan["engine"] == ("path" if engine == "path" else "virtual_lights")
    assert plan["warnings"] == report["warnings"] == []
    with h5py.File("scene.hdf5") as file:
        assert plan["n_bins"] == file["data"].shape[1] == file["t"][()]
        assert plan["window_opl"] == pytest.approx([0, plan["n_bins"] * 0.05])
        assert plan["file"]["logical_bytes"] == sum(d.size * d.dtype.itemsize for d in file.values())
    # small: between nothing and everything; large captures are in tests/unit/test_forecast.py
    assert 0 < plan["file"]["disk_bytes_estimate"] < plan["file"]["logical_bytes"] + 100_000
    assert plan["batches"] == 1
    assert plan["bytes_per_batch"] > 0
    assert 0 < plan["seconds_estimate"] < 60


def test_what_the_size_of_a_file_leaves_out_is_said() -> None:
    """Ground truth and counts are written beside the light, and are no part of the size that is told."""
    assert "without" not in planned(write_config("single"))["file"]["assumption"]
    sensor = "sensor={profile: spad-532, exposure_time: 1.0, photons_per_pulse: {mean: 0.05}}"
    both = planned(write_config("single"), "--set", "output.ground_truth=[depth]", "--set", sensor)
    assert both["file"]["assumption"].endswith("without the ground truth and the counts")


def test_the_plan_writes_nothing():
    """The folder is the same afterwards, an earlier capture untouched."""
    config = write_config()
    Path("scene.hdf5").write_text("an earlier capture")
    run("plan", config)
    assert sorted(path.name for path in Path().iterdir()) == ["scene.hdf5", "scene.yaml"]
    assert Path("scene.hdf5").read_text() == "an earlier capture"


def test_the_plan_is_readable():
    """One line per question: which engine and why, what is skipped and why, memory, file, seconds."""
    result = run("plan", write_config("exhaustive"))
    assert "engine   path: spp counts paths" in result.stdout
    assert "skipped  second bounce: no light goes straight" in result.stdout
    assert "skipped  colour: everything in the scene is grey" in result.stdout
    assert "4 x 3 sensor points, 2 x 5 laser points" in result.stdout
    assert [line.split()[0] for line in result.stdout.splitlines()][-6:] == [
        "scan",
        "time",
        "memory",
        "file",
        "takes",
        "units",
    ]
    assert result.stderr == ""


@pytest.mark.parametrize("command", ["plan", "render"])
def test_pointless_geometry_is_said_on_stderr_before_a_render_too(command):
    """A plate with its back to the wall is legal; both commands say what comes of it, once."""
    result = run(command, write_config(), "--set", "scene.hidden_geometry.0.normal=[0, 0, 1]")
    assert result.stderr.count("warning: scene.hidden_geometry.0 (rectangle-0) turns its back to the relay wall") == 1
    assert "warning" not in result.stdout


@pytest.mark.parametrize("command", ["plan", "render"])
def test_what_configuration_and_geometry_both_know_is_said_once(command):
    """An item behind the wall is found without Mitsuba and with it, in the same words."""
    result = run(command, write_config(), "--set", "scene.hidden_geometry.0.center=[0, 0, -1]")
    warnings = [line for line in result.stderr.splitlines() if "H is zero everywhere" not in line]  # sums up the others
    assert "\n".join(warnings).count("lies behind the relay wall") == 1


def test_warnings_are_in_the_report_of_a_render_even_when_it_is_quiet():
    """A machine that reads the JSON hears the same as a user at the terminal."""
    changes = ["--set", "scene.hidden_geometry.0.normal=[0, 0, 1]", "--set", "render.time_limit_s=5"]
    result = run("render", write_config(), *changes, "--json", "--quiet")
    assert all(line.startswith("warning: ") for line in result.stderr.splitlines())  # nothing else
    # the item, that no surface is left, and at the end why H is zero
    assert ["turns its back" in text for text in json.loads(result.stdout)["warnings"]] == [True, False, True]


@pytest.mark.parametrize(("bounces", "takes_all"), [("5", True), ("3", False)])
def test_walks_take_all_the_time_there_is(bounces: str, takes_all: bool) -> None:
    """A time limit alone: patches of the third bounce are done early, walks go on until the end."""
    changes = ["--set", "render.spp=null", "--set", "render.time_limit_s=1000"]
    plan = planned(write_config(), *changes, "--set", f"render.max_bounces={bounces}")
    assert plan["engine"] == "virtual_lights"
    assert (plan["seconds_estimate"] >= 1000) == takes_all  # the start counts, too


@pytest.mark.slow
def test_the_impossible_takes_years() -> None:
    """A target of 1e-12: plan states the years, what to do, and why it is never reached."""
    changes = ["--set", "render.engine=path", "--set", "render.target_error=1e-12"]
    result = run("plan", write_config(), *changes)
    line = next(line for line in result.stdout.splitlines() if line.startswith("takes"))
    years = float(re.match(r"takes    about ([\d.e+]+) years for the whole", line)[1])
    # 1 % takes about a second; errors fall as 1 / paths at the fastest: 1e10 s, 300 years, at least
    assert years > 100
    assert "ask for a larger render.target_error" in result.stderr
    assert "no render gets there" in result.stderr


def test_impossible_sizes_end_in_an_error():
    """Nothing is allocated for a grid that no machine holds; the configuration is to blame, and the place is told."""
    with pytest.raises(ConfigError, match=r"^--set .*: capture\.sensor_grid: 1000000 x 1000000 points take") as caught:
        run("plan", write_config(), "--set", "capture.sensor_grid={nx: 1000000, ny: 1000000}")
    assert caught.value.exit_code == EXIT_BAD_INPUT


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            ["capture.camera.width=9999999", "time_axis.n_bins=auto", "render.memory_limit=8GB"],
            r"camera: 9999999 x 3 pixels take 19.2 GB",
        ),
        (["capture.camera.width=2000000", "capture.camera.height=1000000"], r"camera: got 2_000_000_000_000 pixels"),
        (["time_axis.n_bins=500000000", "render.memory_limit=1GB"], r"memory_limit: one pixel needs .* Raise it"),
        (["time_axis.n_bins=2000000000", "capture.camera.width=1000"], r"n_bins: got 3_000 pixels with 2_000_000_000"),
    ],
)
@pytest.mark.parametrize("command", ["plan", "render"])
def test_pictures_too_large_are_the_cameras_fault(command, changes, message):
    """A camera has pixels and no sensor grid; the key that the user wrote is named, with its place."""
    Path("view.yaml").write_text(VIEW)
    options = [part for change in changes for part in ("--set", change)]
    with pytest.raises(ConfigError, match=rf"^(view\.yaml:\d+:\d+|--set [^ ]+): [a-z_]+\.{message}") as caught:
        run(command, "view.yaml", *options)
    assert caught.value.exit_code == EXIT_BAD_INPUT
    assert "sensor" not in str(caught.value)


def test_the_plan_of_a_view_is_in_a_cameras_words():
    """Pixels and triangles: nothing is hidden, no point is a sensor's, and no bounce is the third."""
    Path("view.yaml").write_text(VIEW)
    result = run("plan", "view.yaml")
    assert "line_of_sight, 5 x 3 pixels, 2 triangles" in result.stdout
    assert "of 15 pixels, " in result.stdout
    assert "(light in as many bins as in the pilot; light does not compress" in result.stdout
    assert not re.search("hidden|sensor|third|bounce(?!s is)", result.stdout)
    done = run("render", "view.yaml")
    assert re.search(r"\d paths per pixel$", done.stdout, re.MULTILINE)
    assert "energy          interactions 0: " in done.stdout
    done = run("render", write_config())
    assert re.search(r"\d paths per sensor point$", done.stdout, re.MULTILINE)
    assert "energy          bounce 2: " in done.stdout


def test_what_only_mitsuba_rejects_has_its_place():
    """As for render: file, line, column and key."""
    config = Path(write_config())
    config.write_text(config.read_text().replace("-1]}", "-1], bsdf: {type: hair, no_such_parameter: 3}}"))
    with pytest.raises(ConfigError, match=r"scene\.yaml:5:\d+: scene\.hidden_geometry\.0\.bsdf"):
        run("plan", str(config))


def test_help_ends_with_an_example():
    """--help shows one real call and what it creates: nothing."""
    text = " ".join(run("plan", "--help").stdout.split())
    assert text.rindex("Example: nlosrender plan configs/z-letter.yaml") > text.rindex("--json")
    assert "writes nothing" in text
