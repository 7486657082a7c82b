"""How a capture is cut, by memory, interruptions or shards, changes no bit of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.partial_captures import validate_file
from support.rendering import configured, flat_wall

from nlosrender.capture.part import WHOLE, Selection
from nlosrender.errors import FileError, InterruptedRender, RenderError
from nlosrender.files.parts.merge import merge_captures
from nlosrender.pipeline import render_capture
from nlosrender.rendering.render_report import RenderReport

PLATE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, 0, 0.9], "normal": [0, 0, -1]}
BALL = {"type": "sphere", "center": [0.5, 0.2, 1.1], "radius": 0.2}
TIGHT = {"memory_limit": "401MB"}  # leaves a batch 1 MB


def scene(scan: str = "exhaustive", **render: Any) -> dict[str, Any]:
    bins = (1.6, 0.02, 100)
    return flat_wall(PLATE, BALL, scan=scan, sensors=(5, 3), lasers=(2, 7), bins=bins, max_bounces=4, **render)


def render(scene: dict[str, Any], path: Path, selection: Selection = WHOLE, **options: Any) -> RenderReport:
    config = configured({**scene, "output": {"path": str(path)}})
    return render_capture(config, selection=selection, **options)


def assert_same_samples(one: Path, other: Path) -> None:
    with h5py.File(one) as first, h5py.File(other) as second:
        for name in ("data", "variance"):
            np.testing.assert_array_equal(first[name][()], second[name][()])
        assert first["data"][()].any()
        more = ("energy_error", "energy_error_per_bounce", "error_estimate_per_bounce")
        for name in ("samples", "error_estimate", "out_of_window_energy", "energy", "capture_hash", *more):
            assert first.attrs[name] == second.attrs[name], name


LIGHTS = {"spp": None, "target_error": 0.2, "engine": "virtual_lights"}


@pytest.mark.parametrize(
    ("scan", "count", "goal"),
    [
        ("single", 2, {"spp": 64}),
        ("confocal", 3, {"spp": 64}),
        ("exhaustive", 4, {"spp": 64}),
        pytest.param("single", 2, LIGHTS, marks=pytest.mark.slow),
        pytest.param("confocal", 3, LIGHTS, marks=pytest.mark.slow),
        pytest.param("exhaustive", 4, LIGHTS, marks=pytest.mark.slow),
    ],
)
def test_shards_merged_are_the_whole(tmp_path: Path, scan: str, count: int, goal: dict[str, Any]) -> None:
    """Shards rendered with less memory than the whole, then merged: the same samples, errors and energies."""
    whole = render(scene(scan, **goal), tmp_path / "whole.hdf5")
    paths = [tmp_path / f"{number}.hdf5" for number in range(1, count + 1)]
    for number, path in enumerate(paths, 1):
        report = render(scene(scan, **goal, **TIGHT), path, Selection(shard=(number, count)))
        assert report.part is not None
        assert validate_file(path) == []
    merged = merge_captures(paths, tmp_path / "merged.hdf5")
    assert_same_samples(tmp_path / "whole.hdf5", tmp_path / "merged.hdf5")
    assert (merged.energy, merged.error_estimate) == (whole.energy, whole.error_estimate)
    assert validate_file(tmp_path / "merged.hdf5") == []


class _Interruption:
    """A progress callback that stops the render hard when its share exceeds a limit."""

    def __init__(self, limit: float, error: type[BaseException]):
        self.limit, self.error = limit, error

    def __call__(self, share: float) -> None:
        if share > self.limit:
            raise self.error


@pytest.mark.parametrize("memory", ["600MB", "402MB"])
def test_going_on_with_other_memory(tmp_path: Path, memory: str) -> None:
    """Units of another size than those that are finished leave nothing out and do nothing twice."""
    many = {**scene(spp=32), "time_axis": {"start_opl": 1.6, "bin_width_opl": 0.02, "n_bins": 400}}
    many["render"] = {**many["render"], "memory_limit": "403MB"}
    render(many, tmp_path / "whole.hdf5")
    path = tmp_path / "a.hdf5"
    with pytest.raises(InterruptedRender, match=r"interrupted; \d+ work items are finished and saved"):
        render(many, path, progress=_Interruption(0.4, KeyboardInterrupt))
    assert not path.exists()
    many["render"] = {**many["render"], "memory_limit": memory}
    report = render(many, path, resume=True)
    assert 0 < report.resumed_units < report.units
    assert_same_samples(tmp_path / "whole.hdf5", path)


def test_an_unknown_failure_keeps_what_is_finished(tmp_path: Path) -> None:
    """Even a mistake in the program costs no more than the unit in flight; one that repeats itself costs everything."""
    with pytest.raises(ZeroDivisionError):
        render(scene(spp=16, **TIGHT), tmp_path / "a.hdf5", progress=_Interruption(0.5, ZeroDivisionError))
    assert render(scene(spp=16, **TIGHT), tmp_path / "a.hdf5").resumed_units > 0
    with pytest.raises(RenderError):
        render(scene(spp=16, **TIGHT), tmp_path / "b.hdf5", progress=_Interruption(0.5, RenderError))
    assert [path.name for path in tmp_path.iterdir()] == ["a.hdf5"]


def test_what_cannot_be_resumed_is_refused(tmp_path: Path) -> None:
    """Another configuration names what differs; the memory limit and the name of the output do not count."""
    path = tmp_path / "a.hdf5"
    with pytest.raises(FileError, match="no unfinished render to resume"):
        render(scene(spp=16), path, resume=True)
    with pytest.raises(InterruptedRender):
        render(scene(spp=16, **TIGHT), path, progress=_Interruption(0.5, KeyboardInterrupt))
    with pytest.raises(FileError, match=r"config\.render\.spp: 16 then, 32 now"):
        render(scene(spp=32, **TIGHT), path)
    assert render(scene(spp=32), path, resume=False).resumed_units == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.hdf5"]


def test_the_time_limit_counts_earlier_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A render that goes on shares out what is left of its time, not all of it again."""
    limited = scene(spp=None, time_limit_s=1.5, **TIGHT)
    with pytest.raises(InterruptedRender):
        render(limited, tmp_path / "a.hdf5", progress=_Interruption(0.7, KeyboardInterrupt))
    from nlosrender.engine.path.engine import PathEngine

    true_render, limits = PathEngine.render, []

    def recording(self, batch, budget, *more, **options):
        limits.append(budget.time_limit_s)
        return true_render(self, batch, budget, *more, **options)

    monkeypatch.setattr(PathEngine, "render", recording)
    report = render(limited, tmp_path / "a.hdf5")
    assert report.resumed_units > 0
    # at most 30 % of the time is left, as every unit before has used at least its share of it
    assert limits[0] * (report.units - report.resumed_units) < 0.4 * 1.5


def test_a_changed_mesh_is_another_capture(tmp_path: Path) -> None:
    """The name of a file stands for its content; where it lies does not matter."""
    from nlosrender.files.identity import capture_hash

    triangle = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    triangle += (
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 {z}\n0.3 0 1\n0 0.3 1\n3 0 1 2\n"
    )
    hashes = []
    for name, height in (("a", 1), ("b", 1), ("c", 2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "t.ply").write_text(triangle.format(z=height))
        config = configured(flat_wall({"type": "mesh", "filename": "t.ply"}), folder=tmp_path / name)
        hashes.append(capture_hash(json.loads(config.model_dump_json())))
    assert hashes[0] == hashes[1] != hashes[2]
