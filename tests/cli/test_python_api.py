"""``import nlosrender``: what Python and notebooks get is what the command line writes and reads."""

from __future__ import annotations

import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from support.commands import run
from support.rendering import flat_wall

import nlosrender as nr
from nlosrender.config.load import config_hash
from nlosrender.errors import ConfigError, FileError, OptionError

Z = {"type": "letters", "text": "Z", "height": 0.8, "center": [0, 0, 1], "normal": [0, 0, -1]}
SCENE = flat_wall(Z, scan="exhaustive", lasers=(2, 4), bins=(1.5, 0.02, 150), engine="auto", spp=None, max_bounces=4)
SCENE["render"] |= {"target_error": 0.1}
NX = "capture.laser_grid.nx"
SWEEP = flat_wall(Z, sensors=(2, 3), spp=16) | {"sweep": {"keys": {"capture.laser_point": [[0.1, 0.0], [0.3, -0.2]]}}}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> nr.Capture:
    """An exhaustive capture of 3 x 5 sensor points and 4 x 2 laser points (rows x columns)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", nr.NlosWarning)
        return nr.render(SCENE, tmp_path_factory.mktemp("api") / "z.hdf5")


def stored(capture: nr.Capture) -> np.ndarray:
    """Return (bounce, laser_y, laser_x, sensor_y, sensor_x, bin) of a grey file, read without our reader."""
    with h5py.File(capture.path) as file:
        indices = file["data"].attrs["bounce_indices"]
        return file["data"][0].transpose(1, 4, 5, 2, 3, 0)[indices]


# --- import ---


def test_import_loads_nothing_heavy() -> None:
    """``import nlosrender`` takes milliseconds: what a name needs is imported when the name is first asked for."""
    heavy = {"numpy", "mitsuba", "drjit", "h5py", "matplotlib", "pydantic", "yaml", "scipy", "typer", "xarray"}
    code = f"import nlosrender as nr, sys; dir(nr); nr.NlosError; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_opening_a_capture_starts_no_renderer(rendered: nr.Capture) -> None:
    """A machine that cannot render can look at captures."""
    code = f"import nlosrender as nr, sys; nr.open({str(rendered.path)!r}).energy()"
    code += "\nsys.exit(bool({'mitsuba', 'drjit', 'matplotlib', 'xarray'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_name_is_there_and_no_other() -> None:
    """``__all__`` is what there is; a misspelt name is an AttributeError."""
    assert all(callable(getattr(nr, name)) for name in nr.__all__)
    assert set(nr.__all__) <= set(dir(nr))
    with pytest.raises(AttributeError, match="has no attribute 'rendr'"):
        nr.rendr  # noqa: B018


# --- configurations ---


def test_a_mapping_is_the_configuration_that_its_yaml_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash is the same; NumPy values are numbers, and relative file names start at the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "capture.yaml").write_text(yaml.safe_dump(SCENE | {"output": {"path": "deep/z.hdf5"}}))
    grid = {"nx": np.int64(5), "ny": np.float32(3).astype(int)}
    scene = SCENE | {"capture": SCENE["capture"] | {"sensor_grid": grid}, "output": {"path": Path("deep/z.hdf5")}}
    scene["time_axis"] = SCENE["time_axis"] | {"bin_width_opl": np.float64(0.02)}
    of_mapping, of_file = nr.load(scene).config, nr.load("capture.yaml").config
    assert config_hash(of_mapping) == config_hash(of_file)
    assert of_mapping.output.path == of_file.output.path


@pytest.mark.parametrize(
    "changes", [{"capture.laser_grid.nx": 7}, ["capture.laser_grid.nx=7"]], ids=["values", "texts"]
)
def test_changes_are_those_of_set(changes: Any, tmp_path: Path) -> None:
    """Values by dotted key, or texts; over a mapping, a file, or what was loaded, which itself stays as it is."""
    (tmp_path / "z.yaml").write_text(yaml.safe_dump(SCENE))
    loaded = nr.load(SCENE)
    for source in (SCENE, tmp_path / "z.yaml", loaded):
        assert nr.load(source, changes).config.capture.laser_grid.nx == 7  # type: ignore[union-attr]
    assert loaded.config.capture.laser_grid.nx == 2  # type: ignore[union-attr]
    with pytest.raises(OptionError, match="changes: got 5, need texts KEY=VALUE"):
        nr.load(SCENE, [5])  # type: ignore[list-item]
    twice = nr.load(nr.load(SCENE, changes), {"name": "1e3", "render.seed": 5})
    assert (twice.config.name, twice.config.render.seed, twice.config.capture.laser_grid.nx) == ("1e3", 5, 7)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"render": {"spp": float("nan")}}, r"dict: render\.spp: got nan, need a finite number"),
        ({"time_axis": {"n_bins": object()}}, r"dict: time_axis\.n_bins: got object, need numbers"),
        ({"time_axis": {3: 4}}, r"dict: time_axis: got 3 as a key, need text"),
        ({"capture": {"sensor_gird": {}}}, r"dict: capture\.sensor_gird: unknown key\. Did you mean sensor_grid"),
        ({"scene": {"relay_wall": {"type": "rectangle", "width": 0}}}, r"dict: scene\.relay_wall\.width: got 0"),
        ({"geometry": [], "num_bins": 3, "scene": None}, r"dict: .*scene: got nothing"),
    ],
)
def test_a_mistake_in_a_mapping_names_its_key(changed: dict[str, Any], message: str) -> None:
    """As one in a file does; there is no line to name."""
    with pytest.raises(ConfigError, match=message) as caught:
        nr.load(SCENE | changed)
    assert all(issue.place == "dict" for issue in caught.value.issues)


def test_a_mapping_inside_itself_is_refused() -> None:
    """Not followed forever."""
    scene: dict[str, Any] = dict(SCENE)
    scene["scene"] = scene
    with pytest.raises(ConfigError, match="nested deeper than 32 levels"):
        nr.load(scene)


def test_a_sweep_is_no_single_capture() -> None:
    """It has a length and a configuration for each capture; ``render`` and ``plan`` want one."""
    sweep = nr.load(SWEEP)
    points = [config.capture.laser_point for config in sweep]
    assert (len(sweep), points) == (2, [(0.1, 0.0), (0.3, -0.2)])
    for call in (nr.plan, nr.render, lambda source: nr.load(source).to_dict()):
        with pytest.raises(ConfigError, match="sweep: this makes many captures"):
            call(SWEEP)
    with pytest.raises(OptionError, match="has no sweep; use render"):
        nr.render_all(SCENE)


def test_validate_and_plan_say_what_the_commands_say(tmp_path: Path) -> None:
    """The same warnings, engine and sizes."""
    (tmp_path / "z.yaml").write_text(yaml.safe_dump(SCENE))
    printed = run(tmp_path, "validate", "z.yaml").stderr
    assert [f"warning: z.yaml: {warning}" for warning in nr.validate(SCENE).warnings] == printed.splitlines()
    plan = nr.plan(SCENE)
    shown = run(tmp_path, "plan", "z.yaml").stdout
    assert f"{plan.engine}: {plan.reason}" in shown
    assert plan.sensor_grid == (5, 3)
    assert plan.laser_grid == (2, 4)


# --- rendering ---


def test_a_render_writes_what_the_command_writes(rendered: nr.Capture, tmp_path: Path) -> None:
    """Bit for bit; and the capture that comes back has the report."""
    (tmp_path / "z.yaml").write_text(yaml.safe_dump(SCENE))
    assert run(tmp_path, "render", "z.yaml", "-o", "z.hdf5", "-q").returncode == 0
    assert np.array_equal(stored(nr.open(tmp_path / "z.hdf5")), stored(rendered))
    assert rendered.report is not None
    assert rendered.energy() == rendered.report.energy
    assert nr.open(rendered.path).report is None


def test_progress_and_warnings_reach_the_caller(tmp_path: Path) -> None:
    """Shares that end at 1; warnings at the caller's own line."""
    shares: list[float] = []
    with pytest.warns(nr.NlosWarning, match="account_first_and_last_bounces") as caught:
        nr.render(flat_wall(Z, sensors=(2, 3), spp=16), tmp_path / "a.hdf5", progress=shares.append)
    assert shares[-1] == pytest.approx(1)
    assert sorted(shares) == shares
    assert {warning.filename for warning in caught} == {__file__}


@pytest.mark.filterwarnings("ignore::nlosrender.NlosWarning")
def test_outputs_are_guarded_as_by_the_command(tmp_path: Path) -> None:
    """Another capture is replaced with ``overwrite`` alone, a text never, and its own YAML never."""
    scene, target = flat_wall(Z, sensors=(2, 3), spp=16), tmp_path / "a.hdf5"
    nr.render(scene, target)
    first = nr.render(scene, target).energy()
    with pytest.raises(FileError, match="--overwrite"):
        nr.render(scene, target, {"render.seed": 3})
    assert nr.render(scene, target, {"render.seed": 3}, overwrite=True).energy() != first
    with pytest.raises(OptionError, match="overwrite and resume exclude each other"):
        nr.render(scene, target, overwrite=True, resume=True)
    with pytest.raises(FileError, match="resume"):
        nr.render(scene, tmp_path / "b.hdf5", resume=True)
    (tmp_path / "z.yaml").write_text(yaml.safe_dump(scene))
    with pytest.raises(FileError, match="is read for this"):
        nr.render(tmp_path / "z.yaml", tmp_path / "z.yaml")


@pytest.mark.filterwarnings("ignore::nlosrender.NlosWarning")
def test_a_sweep_renders_into_captures_in_its_order(tmp_path: Path) -> None:
    """Of each value the capture that it alone would give."""
    first, second = nr.render_all(SWEEP | {"output": {"path": str(tmp_path / "{index:05d}.hdf5")}})
    alone = nr.render({key: SWEEP[key] for key in SWEEP if key != "sweep"}, tmp_path / "alone.hdf5")
    assert np.array_equal(second.numpy(), alone.numpy())
    assert not np.array_equal(first.numpy(), alone.numpy())


# --- captures ---


def test_numpy_is_the_file_in_memory_order(rendered: nr.Capture) -> None:
    """(channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin), whole and in parts, by bounce number."""
    whole = stored(rendered)
    assert rendered.numpy().shape == (1, 3, 4, 2, 3, 5, 150)
    assert np.array_equal(rendered.numpy()[0], whole)
    part = rendered.numpy(lasers=(2, None), sensors=(slice(1, 3), 4), bounces=[4, 3])
    assert np.array_equal(part[0], whole[[2, 1], 2:3, :, 1:3, 4:5])
    assert np.array_equal(rendered.numpy(bounces=3)[0], whole[1:2])


def test_frames_histograms_and_energies_are_sums_of_the_samples(rendered: nr.Capture) -> None:
    """A frame is one bin, a histogram one point, an energy everything of a bounce; in metres and seconds."""
    whole = stored(rendered).astype(np.float64)
    opl = rendered.opl()
    assert opl[:2] == pytest.approx([1.51, 1.53])
    index = int(whole.sum(axis=(0, 1, 2, 3, 4)).argmax())
    frame = rendered.frame(rendered.time()[index], laser=(3, 1))
    assert np.allclose(frame, whole[:, 3, 1, ..., index].sum(axis=0), rtol=1e-12)
    # points lie 0.4 m apart in x and 1.6 / 3 m in y: the nearest to (0.75, 0.3) is in the last column and row
    assert np.array_equal(rendered.histogram(0.75, 0.3), whole[:, 2, 1, 2, 4])
    assert np.array_equal(rendered.histogram(pixel=(0, 3), laser=(1, 0)), whole[:, 1, 0, 0, 3])
    sums = whole.sum(axis=(1, 2, 3, 4, 5))
    # samples are float32: each is off by a relative 2^-24 at most, and none is negative
    assert list(rendered.energy().values()) == pytest.approx(list(sums), rel=2.0**-23)


def test_energies_of_a_file_that_states_none_are_read(rendered: nr.Capture, tmp_path: Path) -> None:
    """The same numbers under the same names."""
    copy = tmp_path / "copy.hdf5"
    copy.write_bytes(rendered.path.read_bytes())
    with h5py.File(copy, "r+") as file:
        del file.attrs["energy"]
    assert nr.open(copy).energy() == pytest.approx(rendered.energy(), rel=2.0**-23)


def test_xarray_has_names_metres_and_seconds(rendered: nr.Capture) -> None:
    """Dimensions by name; places on the wall in m, times in s; a part keeps its coordinates."""
    pytest.importorskip("xarray")
    samples = rendered.xarray()
    assert samples.dims == ("channel", "bounce", "laser_y", "laser_x", "sensor_y", "sensor_x", "time")
    assert np.array_equal(samples.values, rendered.numpy())
    assert samples.sensor_x.values == pytest.approx([-0.8, -0.4, 0, 0.4, 0.8], abs=1e-6)  # float32 positions
    assert samples.laser_y.values == pytest.approx([-0.45, -0.15, 0.15, 0.45], abs=1e-6)
    assert samples.time.values == pytest.approx(samples.opl.values / 299792458.0)
    assert samples.attrs["units"] == "J m^-2 sr^-1"
    part = rendered.xarray(sensors=(slice(1, 3), 4), bounces=3)
    assert part.equals(samples.isel(sensor_y=slice(1, 3), sensor_x=[4]).sel(bounce=[3]))


@pytest.mark.filterwarnings("ignore::nlosrender.NlosWarning")
def test_listed_points_have_places_of_their_own(tmp_path: Path) -> None:
    """No rectangle has their coordinates; the nearest of them is found."""
    pytest.importorskip("xarray")
    scene = flat_wall(Z, spp=16)
    points = [[0.5, 0.25], [-0.5, 0.25], [0.25, -0.5], [0.0, 0.75]]
    del scene["capture"]["sensor_grid"]
    capture = nr.render(scene, tmp_path / "list.hdf5", {"capture.sensor_points": points})
    samples = capture.xarray()
    places = np.stack([samples.sensor_position_x, samples.sensor_position_y], axis=-1)[0]
    assert places == pytest.approx(np.array(points), abs=1e-6)
    assert np.array_equal(capture.histogram(0.2, -0.4), capture.histogram(pixel=(0, 2)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda capture: capture.numpy(bounces=5), "bounces: got .5., need some of 2, 3, 4"),
        (lambda capture: capture.numpy(bounces=[]), "bounces: got .., need some of"),
        (lambda capture: capture.numpy(bounces=3.0), "bounces: got 3.0, need bounce numbers"),
        (lambda capture: capture.numpy(sensors=3), r"sensors: got 3, need .row, column."),
        (lambda capture: capture.xarray(lasers=(0, slice(0, 4, 2))), r"lasers: got .*, need .* slice of step 1"),
        (lambda capture: capture.histogram(pixel=1), "pixel: got 1, need two integers: row, column"),
        (lambda capture: capture.frame(6e-9, laser=(0, 0, 0)), r"laser: got .0, 0, 0., need two integers"),
        (lambda capture: capture.plot(pixel=(0.5, 1)), "--pixel: got .0.5, 1., need two integers"),
        (lambda capture: capture.frame(1.0), "t: got 1.0, need a time from 5.00346e-09 to below 1.50104e-08 s"),
        (lambda capture: capture.frame(float("nan")), "t: got nan"),
        (lambda capture: capture.frame(6e-9, laser=(4, 0)), "laser: got 4,0, need a row from 0 to 3"),
        (lambda capture: capture.histogram(), r"need two numbers \[m\], or pixel"),
        (lambda capture: capture.histogram(0.0, 0.9), "x, y: got 0, 0.9, off the sensor grid"),
        (lambda capture: capture.histogram(float("nan"), 0), "off the sensor grid"),
        (lambda capture: capture.histogram(pixel=(-1, 0)), "pixel: got -1,0"),
        (lambda capture: capture.plot(laser=(0, 2)), "--laser: got 0,2"),
        (lambda capture: capture.plot(theme="lite"), "--theme: got 'lite'"),
        (lambda capture: capture.reconstruct(bounces=5), "--bounces: got '5'"),
        (lambda capture: capture.measure("m.hdf5", "spad-532", correct=["noise"]), r"correct: got \['noise'\]"),
        (lambda capture: capture.reconstruct("fk"), "--method: got 'fk'"),
    ],
)
def test_what_a_capture_does_not_have_is_refused(rendered: nr.Capture, call: Any, message: str) -> None:
    """With what it has; nothing is clamped or rounded to the nearest."""
    with pytest.raises(OptionError, match=message):
        call(rendered)


def test_numbers_of_numpy_are_numbers(rendered: nr.Capture) -> None:
    """Bounces and points that a computation has found name the same as plain integers do."""
    row, column = brightest = np.argwhere(rendered.numpy()[0, 1, 0, 0].sum(axis=-1) > 0)[-1]
    named = rendered.histogram(pixel=brightest)
    assert np.array_equal(named, rendered.histogram(pixel=(int(row), int(column))))
    for bounce in np.array([3, 4]):
        assert np.array_equal(rendered.numpy(bounces=bounce), rendered.numpy(bounces=int(bounce)))


def test_a_camera_has_no_places_on_a_wall(rendered: nr.Capture, tmp_path: Path) -> None:
    """Its pixels may be empty, with zeros for positions: x and y would find one of them and give its darkness."""
    seen = tmp_path / "camera.hdf5"
    shutil.copy(rendered.path, seen)
    with h5py.File(seen, "r+") as file:
        file.attrs["empty_sensor_points"] = 1
    with pytest.raises(OptionError, match="a camera has no such coordinates; give pixel"):
        nr.open(seen).histogram(0.0, 0.0)


def test_measure_and_reconstruct_are_the_commands(rendered: nr.Capture, tmp_path: Path) -> None:
    """Counts and volume of the command line; a mapping is a sensor, too."""
    options = ["--sensor", "spad-532", "--set", "sensor.exposure_time=1", "--set", "sensor.photons_per_pulse.mean=0.05"]
    assert run(tmp_path, "measure", rendered.path, "-o", "command.hdf5", *options, "-q").returncode == 0
    values = {"exposure_time": 1, "photons_per_pulse": {"mean": 0.05}}
    measured = rendered.measure(tmp_path / "python.hdf5", {"profile": "spad-532"} | values)
    assert np.array_equal(measured.numpy(), nr.open(tmp_path / "command.hdf5").numpy())
    assert measured.energy() == {"all": pytest.approx(measured.numpy().sum(dtype=np.float64))}
    assert run(tmp_path, "reconstruct", rendered.path, "--voxels", 16, "-o", "volume.hdf5", "-q").returncode == 0
    found = rendered.reconstruct(voxels=16)
    with h5py.File(tmp_path / "volume.hdf5") as file:
        assert np.array_equal(file["volume"][()], found.volume)
    with h5py.File(found.save(tmp_path / "saved.hdf5")) as file:
        assert np.array_equal(file["volume"][()], found.volume)
    assert -1 <= found.score().correlation <= 1


def test_a_notebook_shows_tables_and_pictures(rendered: nr.Capture, tmp_path: Path) -> None:
    """HTML without the file's own markup; PNG, which ``save`` writes only under a name that says so."""
    renamed = tmp_path / "<b>.hdf5"
    renamed.write_bytes(rendered.path.read_bytes())
    table = nr.open(renamed)._repr_html_()
    assert "&lt;b&gt;.hdf5" in table
    assert "<b>" not in table
    assert "exhaustive" in table
    picture = rendered.plot(pixel=(1, 2))
    assert picture._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(OptionError, match=r"need a name that ends in one of \.png"):
        picture.save(tmp_path / "python.tiff")


def test_what_is_no_capture_is_not_opened(tmp_path: Path) -> None:
    """At once, with the reader's words."""
    with pytest.raises(FileError, match="there is no such file"):
        nr.open(tmp_path / "none.hdf5")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda capture: nr.load(3), "source: got 3, need a mapping, a Configuration, or the name of a YAML"),
        (lambda capture: nr.plan(None), "source: got None"),
        (lambda capture: nr.load(SCENE, 5), "changes: got 5, need texts KEY=VALUE"),
        (lambda capture: nr.open(capture), "path: got <nlosrender.Capture .*, need the name of a file: text or"),
        (lambda capture: nr.open(b"z.hdf5"), "path: got b'z.hdf5'"),
        (lambda capture: nr.render(SCENE, {"render.seed": 3}), "out: got {'render.seed': 3}, need the name of a file"),
        (lambda capture: capture.plot(ideal=5), "ideal: got 5"),
        (lambda capture: capture.plot().save(None), "path: got None"),
        (lambda capture: capture.reconstruct(voxels=4).save(5), "path: got 5"),
        (lambda capture: capture.measure(5, "spad-532"), "out: got 5"),
        (lambda capture: capture.measure("m.hdf5", 5), "sensor: got 5, need a mapping, a profile or"),
        (lambda capture: capture.measure("m.hdf5", correct=5), "correct: got 5, need a list of some of pile_up"),
        (lambda capture: capture.reconstruct(voxels=4.5), "--voxels: got 4.5, need an integer >= 1"),
        (lambda capture: capture.frame("6e-9"), "t: got '6e-9', need a time"),
        (lambda capture: capture.histogram("0", 0), "x, y: got '0', 0, need two numbers"),
        (lambda capture: nr.start_backend("gpu"), "wanted: got 'gpu', need one of auto, llvm, cuda"),
    ],
)
def test_arguments_of_another_type_are_refused(rendered: nr.Capture, call: Any, message: str) -> None:
    """By the argument's name and what it has to be, as other mistakes are."""
    with pytest.raises(OptionError, match=message):
        call(rendered)
