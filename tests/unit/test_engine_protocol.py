"""An engine that has the members of ``Engine`` and no others is planned, rendered, resumed, compared and described."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from support.commands import run
from support.rendering import configured, flat_wall

from nlosrender.analysis.render_plan import plan_render
from nlosrender.config.document import Config
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import EXIT_COMPARISON_EXCEEDED, EXIT_OK, InterruptedRender
from nlosrender.pipeline import render_capture
from nlosrender.rendering.render_report import RenderReport

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 1.0], "normal": [0, 0, -1]}
LIGHT, DEVIATION = 0.75, 0.0625  # [J m^-2 sr^-1], exact in float32
LASERS, SENSORS, BINS = 14, 15, 150
SCENE = flat_wall(
    PLATE,
    scan="exhaustive",
    sensors=(5, 3),
    lasers=(2, 7),
    bins=(0.4, 0.02, BINS),
    max_bounces=4,
    memory_limit="401MB",  # which leaves a batch about 1 MB: many work items
)
Choose = Callable[..., None]


@pytest.fixture
def constant_light(monkeypatch: pytest.MonkeyPatch) -> Choose:
    """Make the constant engine the one that renders, with the light and its deviation."""
    start_backend("llvm")
    from support.constant_engine import ChooseConstant

    from nlosrender.engine import planner

    def choose(light: float, deviation: float = DEVIATION) -> None:
        monkeypatch.setattr(planner, "choose_engine", ChooseConstant(light, deviation))

    choose(LIGHT)
    return choose


def config_in(folder: Path, name: str) -> Config:
    return configured(SCENE | {"output": {"path": str(folder / f"{name}.hdf5")}})


def content(path: Path) -> dict[str, bytes]:
    """Return the bytes of all datasets."""
    with h5py.File(path) as file:
        return {name: np.asarray(file[name][()]).tobytes() for name in file}


def rendered(folder: Path, name: str) -> tuple[Path, RenderReport]:
    report = render_capture(config_in(folder, name))
    return folder / f"{name}.hdf5", report


def test_no_member_but_those_of_the_protocol(constant_light: Choose) -> None:
    """Public attributes are those that ``Engine`` names; light and deviation are its own business."""
    from support.constant_engine import ConstantEngine

    from nlosrender.engine.interface import Engine

    asked = {name for name in dir(Engine) if not name.startswith("_")}
    own = {name for name in (*dir(ConstantEngine), *ConstantEngine.__dataclass_fields__) if not name.startswith("_")}
    assert own == asked | {"light", "deviation"}
    assert ConstantEngine.__mro__ == (ConstantEngine, object)


def test_a_plan(constant_light: Choose, tmp_path: Path) -> None:
    """It says what the engine says of itself."""
    plan = plan_render(config_in(tmp_path, "a"))
    assert (plan.engine, plan.reason, plan.estimate_basis) == ("constant", "asked for by a test", "nothing to compute")
    assert plan.seconds_rendering == 0
    assert "everything" in [work.what for work in plan.skipped]
    assert plan.units > 3


def test_a_render_states_the_closed_forms(constant_light: Choose, tmp_path: Path) -> None:
    """Energy, its error, and the error of H, from the number of bins alone; in the report and in the file."""
    path, report = rendered(tmp_path, "a")
    assert report.engine == "constant"
    assert report.units > 3
    n = LASERS * SENSORS * BINS
    error = DEVIATION / math.sqrt(LIGHT**2 - DEVIATION**2)  # a square of an estimate holds its variance
    assert report.energy == {"2": 0, "3": n * LIGHT, "4": 0}
    assert report.energy_error_per_bounce == pytest.approx(
        {"2": 0, "3": n * DEVIATION, "4": 0}, rel=5e-4
    )  # stated to four digits
    assert report.error_estimate == pytest.approx(error)
    with h5py.File(path) as file:
        data, variance = file["data"][()], file["variance"][()]
    assert np.unique(data).tolist() == [0, LIGHT]
    assert np.count_nonzero(data) == n
    np.testing.assert_array_equal(variance, np.where(data > 0, np.float32(DEVIATION**2), 0))
    done = run(tmp_path, "info", path, "--check", "--json")
    assert done.returncode == EXIT_OK, done.stderr
    said = json.loads(done.stdout)
    assert said["engine"] == "constant"
    assert said["energy"] == {"2": 0, "3": n * LIGHT, "4": 0}
    assert said["error_estimate"] == pytest.approx(error)
    assert said["violations"] == []


def test_an_interrupted_render_goes_on(constant_light: Choose, tmp_path: Path) -> None:
    """To the samples and stated numbers of one that was not."""
    whole, report = rendered(tmp_path, "whole")

    def stop(share: float) -> None:
        if share >= 0.4:
            os.kill(os.getpid(), signal.SIGTERM)

    config = config_in(tmp_path, "parts")
    with pytest.raises(InterruptedRender, match="work items are finished and saved"):
        render_capture(config, stop)
    resumed = render_capture(config, resume=True)
    assert 0 < resumed.resumed_units < resumed.units
    assert content(tmp_path / "parts.hdf5") == content(whole)
    for stated in ("samples", "energy", "energy_error_per_bounce", "error_estimate", "error_estimate_per_bounce"):
        assert getattr(resumed, stated) == getattr(report, stated)


def test_captures_are_compared(constant_light: Choose, tmp_path: Path) -> None:
    """Equal light is equal; other light is found by its difference and by the stored variances."""
    first, second = (rendered(tmp_path, name)[0] for name in ("first", "second"))
    constant_light(LIGHT + 2 * DEVIATION)
    other = rendered(tmp_path, "other")[0]
    assert run(tmp_path, "compare", second, first).returncode == EXIT_OK
    assert run(tmp_path, "compare", second, first, "--z-test").returncode == EXIT_OK
    done = run(tmp_path, "compare", other, first)
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    assert f"relative L2: {2 * DEVIATION / LIGHT:.4g}, " in done.stderr
    assert run(tmp_path, "compare", other, first, "--z-test").returncode == EXIT_COMPARISON_EXCEEDED


def test_the_command_line_renders_by_it(constant_light: Choose, tmp_path: Path) -> None:
    """``plan`` and ``render`` as users call them."""
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(SCENE))
    assert json.loads(run(tmp_path, "plan", "a.yaml", "--json").stdout)["engine"] == "constant"
    done = run(tmp_path, "render", "a.yaml", "-o", "a.hdf5", "--json", "-q")
    assert done.returncode == EXIT_OK, done.stderr
    assert json.loads(done.stdout)["engine"] == "constant"
