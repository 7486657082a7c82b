"""``sweep``: which captures a file makes, and every mistake in it with its place."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest

from nlosrender.config import sweep_load
from nlosrender.config.document import Config
from nlosrender.config.draws import Draw
from nlosrender.config.load import config_hash, config_to_dict, parse_config, parse_document
from nlosrender.config.sweep import MAX_CAPTURES, SweepConfig
from nlosrender.config.sweep_load import Sweep
from nlosrender.errors import ConfigError

BASE = """\
name: plate
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: rectangle, width: 0.5, height: 0.4, center: [0.1, 0, 0.9]}
capture: {scan_type: single, sensor_grid: {nx: 5, ny: 3}}
"""
N_LINES = BASE.count("\n")


def sweep_of(text: str, *overrides: str, base: str = BASE) -> Sweep:
    """Parse a config with the sweep ``text``, which begins on line 7."""
    sweep = sweep_load.sweep_of(parse_document(base + text, "z.yaml", Path("/tmp"), overrides))
    assert sweep is not None
    return sweep


def problems_of(text: str, *overrides: str, base: str = BASE) -> list[str]:
    """Parse a config with a sweep that has mistakes."""
    with pytest.raises(ConfigError) as caught:
        sweep_of(text, *overrides, base=base)
    return [str(problem) for problem in caught.value.issues]


def swept(values: Any) -> list[Any]:
    """Return what one entry of ``sweep.keys`` stands for."""
    return list(SweepConfig.model_validate({"keys": {"a": values}}).keys["a"])


def test_a_file_without_a_sweep() -> None:
    """A file without a sweep, or with sweep: null, is none; and the key is in no config and no hash."""
    assert sweep_load.sweep_of(parse_document(BASE, "z.yaml", Path("/tmp"))) is None
    assert sweep_load.sweep_of(parse_document(BASE + "sweep: null\n", "z.yaml", Path("/tmp"))) is None
    config = parse_config(BASE + "sweep: null\n", "z.yaml", Path("/tmp"))
    assert "sweep" not in config_to_dict(config)
    assert config_hash(config) == config_hash(parse_config(BASE, "z.yaml", Path("/tmp")))


def test_a_product() -> None:
    """Every combination, the last key fastest; each config is the one that --set makes of the same file."""
    sweep = sweep_of(
        "sweep:\n  keys:\n    capture.laser_point: [[0, 0], [0.1, 0.2]]\n"
        "    scene.hidden_geometry.0.center.2: {range: {start: 0.5, stop: 1.5, n: 3}}\n"
    )
    assert len(sweep) == 6
    depths = [sweep.values(i)["scene.hidden_geometry.0.center.2"] for i in range(6)]
    assert depths == [0.5, 1.0, 1.5] * 2
    assert [str(path) for path in sweep.paths[:2]] == ["plate/00000.hdf5", "plate/00001.hdf5"]
    overrides = ("capture.laser_point=[0.1, 0.2]", "scene.hidden_geometry.0.center.2=1.0")
    alone = parse_config(BASE, "z.yaml", Path("/tmp"), (*overrides, "output.path=plate/00004.hdf5"))
    assert sweep.config(4) == alone


def test_zip() -> None:
    """The first values belong together, then the second ones; draws are one more key."""
    sweep = sweep_of(
        "sweep:\n  mode: zip\n  keys:\n    capture.sensor_grid.nx: [4, 6, 8]\n    capture.sensor_grid.ny: [3, 5, 7]\n"
        "  random: {count: 3, keys: {render.seed: {integers: [0, 9]}}}\n"
    )
    grids = [sweep.config(i).capture.sensor_grid for i in range(len(sweep))]
    assert [(grid.nx, grid.ny) for grid in grids] == [(4, 3), (6, 5), (8, 7)]


def test_draws_with_every_combination() -> None:
    """In a product the draws are one axis: every combination meets the same ones."""
    sweep = sweep_of(
        "sweep:\n  keys: {render.engine: [path, virtual_lights]}\n"
        "  random: {count: 4, seed: 3, keys: {render.seed: {integers: [0, 1000000]}}}\n"
    )
    seeds = [sweep.values(i)["render.seed"] for i in range(8)]
    assert seeds[:4] == seeds[4:]
    assert len(set(seeds)) == 4
    assert [sweep.config(i).render.engine for i in (0, 7)] == ["path", "virtual_lights"]


def test_draws_do_not_depend_on_each_other() -> None:
    """More draws, or draws of further keys, leave the earlier ones as they were; another seed does not."""

    def drawn(count: int, seed: int, more: str = "") -> list[int]:
        keys = f"{{{more}render.seed: {{integers: [0, 99999]}}}}"
        text = f"sweep:\n  random: {{count: {count}, seed: {seed}, keys: {keys}}}\n"
        sweep = sweep_of(text)
        return [sweep.values(i)["render.seed"] for i in range(count)]

    assert drawn(9, 1)[:5] == drawn(5, 1) == drawn(5, 1, "capture.laser_energy: {uniform: [1, 2]}, ")
    assert not set(drawn(5, 1)) & set(drawn(5, 2))


def test_keys_are_drawn_independently() -> None:
    """Two keys with one distribution take different values: their correlation is that of chance."""
    n = 1000
    draw = Draw("uniform", (-1.0, 1.0))
    products = [draw.value("a", 1, number) * draw.value("b", 1, number) for number in range(n)]
    assert sum(products) / n == pytest.approx(0, abs=4 / 3 / math.sqrt(n))  # 4 sigma; var of a product of both is 1 / 9


@pytest.mark.parametrize(
    ("kind", "among", "mean", "deviation"),
    [
        ("uniform", (2.0, 5.0), 3.5, 3 / math.sqrt(12)),
        ("integers", (1, 6), 3.5, math.sqrt(35 / 12)),
        ("choice", (0, 10), 5.0, 5.0),
    ],
)
def test_distributions(kind: str, among: tuple, mean: float, deviation: float) -> None:
    """Draws have the mean of their distribution and stay between its ends."""
    n = 4000
    draws = [Draw(kind, among).value("key", 7, number) for number in range(n)]
    assert min(draws) >= among[0]
    assert max(draws) <= among[-1]
    assert sum(draws) / n == pytest.approx(mean, abs=4 * deviation / math.sqrt(n))  # 4 sigma
    if kind != "uniform":
        assert set(draws) == (set(range(1, 7)) if kind == "integers" else {0, 10})


def test_log_uniform() -> None:
    """The logarithm is uniform: half of the draws between 0.01 and 100 are below 1."""
    n = 4000
    draws = [Draw("log_uniform", (0.01, 100.0)).value("key", 7, number) for number in range(n)]
    below = sum(draw < 1 for draw in draws) / n
    assert below == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(n))  # 4 sigma


@pytest.mark.parametrize(
    ("written", "values"),
    [
        ({"range": {"start": 0.5, "stop": 1.5, "n": 5}}, [0.5, 0.75, 1.0, 1.25, 1.5]),
        ({"range": {"start": 0, "stop": 0.3, "step": 0.1}}, [0, 0.1, 0.2, 0.3]),
        ({"range": {"start": 0, "stop": 1, "step": 0.4}}, [0, 0.4, 0.8]),
        ({"range": {"start": 3, "stop": 1, "step": -1}}, [3, 2, 1]),
        ({"range": {"start": 2, "stop": 2, "n": 1}}, [2]),
        ({"log_range": {"start": 0.01, "stop": 100, "n": 3}}, [0.01, 1.0, 100.0]),
        ([[1, 2], "a", None], [[1, 2], "a", None]),
    ],
)
def test_ranges(written: Any, values: list[Any]) -> None:
    """Ranges include both ends; lists are taken as they are."""
    found = swept(written)
    assert found == (pytest.approx(values, rel=1e-12, abs=1e-12) if isinstance(written, dict) else values)


def test_a_range_of_integers_is_one() -> None:
    """Keys that take integers can be swept by a range."""
    assert all(type(value) is int for value in swept({"range": {"start": 8, "stop": 32, "n": 4}}))
    assert len(sweep_of("sweep: {keys: {capture.sensor_grid.nx: {range: {start: 2, stop: 8, step: 2}}}}\n")) == 4


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "need a list of values"),
        (3, "need a list of values"),
        ({"ranje": {}}, "need a list of values"),
        ({"range": {"start": 0, "stop": 1}}, "need start, stop and n or step"),
        ({"range": {"start": 0, "stop": 1, "n": 2, "step": 1}}, "need start, stop and n or step"),
        ({"range": {"start": "0", "stop": 1, "n": 2}}, "need a number"),
        ({"range": {"start": 0, "stop": 1, "n": 0}}, "got 0, need 1 to 100000 values"),
        ({"range": {"start": 0, "stop": 1, "step": 0}}, "need a step that leads"),
        ({"range": {"start": 0, "stop": 1, "step": -0.1}}, "need a step that leads"),
        ({"range": {"start": 0, "stop": 1, "step": 1e-300}}, "need 1 to 100000 values"),
        ({"log_range": {"start": 0, "stop": 1, "n": 3}}, "need a number > 0"),
        ({"log_range": {"start": 1, "stop": 2, "step": 3}}, "need start, stop and n"),
    ],
)
def test_values_that_are_none(value: Any, message: str) -> None:
    """Every wrong way to write values says what is allowed."""
    (issue,) = SweepConfig.model_validate({"keys": {"a": value}}).issues((), SweepConfig)
    assert re.search(message, issue.message)


@pytest.mark.parametrize(
    "value",
    [
        {"uniform": [1]},
        {"uniform": [2, 1]},
        {"uniform": ["a", 2]},
        {"uniform": 3},
        {"integers": 3},
        {"integers": [1.5, 2]},
        {"log_uniform": [0, 1]},
        {"choice": []},
        {"normal": [0, 1]},
        {"uniform": [0, 1], "choice": [1]},
        [1, 2],
    ],
)
def test_draws_that_are_none(value: Any) -> None:
    """Every wrong way to write a draw says what is allowed."""
    section = SweepConfig.model_validate({"random": {"count": 1, "keys": {"a": value}}})
    (issue,) = section.issues((), SweepConfig)
    assert re.match(r"got .*, need ", issue.message)


MISTAKES = {
    "sweep: 3\n": "z.yaml:7:8: sweep: got 3, need a mapping",
    "sweep: {}\n": "z.yaml:7:1: sweep: sweeps nothing",
    "sweep:\n  kyes: {}\n": "z.yaml:8:3: sweep.kyes: unknown key. Did you mean keys?",
    "sweep:\n  mode: prodcut\n  keys: {name: [a, b]}\n": "z.yaml:8:9: sweep.mode: .* Did you mean product?",
    "sweep:\n  random: {count: 0, keys: {name: {choice: [a]}}}\n": "z.yaml:8:19: sweep.random.count: got 0",
    "sweep:\n  random: {count: 2, keys: {}}\n": "z.yaml:8:22: sweep.random.keys: draws nothing",
    "sweep:\n  keys:\n    render.spp: 3\n": "z.yaml:9:17: sweep.keys.render.spp: got 3, need a list",
    "sweep:\n  mode: zip\n  keys: {render.seed: [1, 2], render.spp: [1, 2, 3]}\n": (
        "z.yaml:8:9: .* render.seed: 2, render.spp: 3"
    ),
    "sweep:\n  keys: {render.seed: [1]}\n  random: {count: 1, keys: {render.seed: {choice: [1]}}}\n": (
        "z.yaml:9:29: .*stands in keys too"
    ),
    "sweep:\n  keys:\n    rendr.spp: [1]\n": "z.yaml:9:5: rendr: unknown key. Did you mean render?",
    "sweep:\n  keys:\n    render.seeds: [1]\n": "z.yaml:9:5: render.seeds: unknown key. Did you mean seed?",
    "sweep:\n  keys:\n    render.seed: [1, -2]\n": (
        "z.yaml:9:22: render.seed: got -2, .*The capture with render.seed = -2"
    ),
    "sweep:\n  keys:\n    scene.hidden_geometry.1.width: [1]\n": "z.yaml:9:37: .*got 1 in a list of 1",
    "sweep:\n  keys:\n    name.x: [1]\n": "z.yaml:9:14: name: cannot set x",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_mistakes_have_a_place(text: str) -> None:
    """A mistake in the sweep is told with line and column, as any other."""
    assert any(_matches(MISTAKES[text], problem) for problem in problems_of(text)), problems_of(text)


def _matches(pattern: str, problem: str) -> bool:
    parts = pattern.replace("?", "").split(".*")
    return problem.replace("?", "").startswith(parts[0]) and all(part in problem for part in parts[1:])


def test_a_misspelt_key_is_the_only_mistake() -> None:
    """Where a key is unknown, what it may have been is not missed as well."""
    (problem,) = problems_of("sweep:\n  render.spp: [1, 2]\n")
    assert "sweep.render.spp: unknown key" in problem


def test_all_mistakes_at_once() -> None:
    """Mistakes of the base and of single captures come together, each once, with how many captures have it."""
    base = BASE.replace("ny: 3", "ny: 0")
    problems = problems_of(
        "sweep:\n  keys: {capture.laser_point: [[0, 0], [5, 5]], render.seed: [1, 2, 3]}\n", base=base
    )
    assert len(problems) == 2
    assert "capture.sensor_grid.ny: got 0" in problems[0]
    assert "captures" not in problems[0]
    assert "capture.laser_point: got [5, 5], off the relay wall" in problems[1]
    assert "(3 of 6 captures, the first one with capture.laser_point = [5, 5], render.seed = 1.)" in problems[1]


def test_too_many_captures() -> None:
    """Three ranges of a thousand values are refused before anything is made of them."""
    ranges = ", ".join(f"{key}: {{range: {{start: 1, stop: 2, n: 1000}}}}" for key in ("a", "b", "c"))
    assert f"got 1000000000, need at most {MAX_CAPTURES} captures" in problems_of(f"sweep: {{keys: {{{ranges}}}}}\n")[0]


def test_names_of_the_outputs() -> None:
    """The output's name has a place for the number of the capture, and may have the capture's name."""
    two = "sweep: {keys: {render.seed: [1, 2]}}\n"
    paths = sweep_of(two, "output.path='out/{name}-{index:03d}.h5'").paths
    assert [str(path) for path in paths] == ["out/plate-000.h5", "out/plate-001.h5"]
    assert str(sweep_of(two, "output.path='a/{index}.h5'").paths[1]) == "a/1.h5"
    named = sweep_of("sweep: {keys: {name: [a, b]}}\n", "output.path='{name}/x.h5'")
    assert [str(path) for path in named.paths] == ["a/x.h5", "b/x.h5"]
    assert named.output_folder == Path.cwd()
    assert "captures 0 and 1 are both out.h5; need {index} in it" in problems_of(two, "output.path=out.h5")[0]
    assert "only {index}, {index:05d} and {name}" in problems_of(two, "output.path='{seed}.h5'")[0]


def test_overrides() -> None:
    """--set holds for all captures, may change the sweep itself, and may not be lost to a swept key."""
    text = "sweep: {keys: {render.seed: [1, 2]}, random: {count: 2, keys: {capture.laser_energy: {uniform: [1, 2]}}}}\n"
    sweep = sweep_of(text, "capture.sensor_grid.nx=9", "sweep.random.count=5")
    assert len(sweep) == 10
    assert sweep.config(3).capture.sensor_grid.nx == 9
    for key in ("render.seed", "capture.laser_energy"):
        assert f"--set {key}=1: {key}: is swept" in problems_of(text, f"{key}=1")[0]
    assert sweep_load.sweep_of(parse_document(BASE + text, "z.yaml", Path("/tmp"), ["sweep=null"])) is None


def test_a_sweep_where_one_capture_is_needed() -> None:
    """Commands that take one capture say so, beside every other mistake."""
    with pytest.raises(ConfigError, match=r"z\.yaml:7:1: sweep: this makes many captures") as caught:
        parse_config(BASE.replace("ny: 3", "ny: 0") + "sweep: {keys: {render.seed: [1]}}\n", "z.yaml", Path("/tmp"))
    assert len(caught.value.issues) == 2


def test_captures_share_nothing() -> None:
    """A swept mapping with further swept keys inside is a new one in every capture."""
    text = (
        "sweep:\n  keys:\n    scene.hidden_geometry.0.bsdf: [{type: diffuse, reflectance: 0.1}]\n"
        "    scene.hidden_geometry.0.bsdf.reflectance: [0.2, 0.3]\n"
    )
    sweep = sweep_of(text)
    values = [sweep.config(i).scene.hidden_geometry[0].bsdf["reflectance"] for i in (1, 0, 1)]
    assert values == [0.3, 0.2, 0.3]
    assert sweep.values(0)["scene.hidden_geometry.0.bsdf"]["reflectance"] == 0.1


def test_the_schema_knows_sweeps() -> None:
    """Editors check a sweep by the JSON Schema."""
    schema = Config.model_json_schema()
    assert set(schema["$defs"]["SweepConfig"]["properties"]) == {"mode", "keys", "random"}
    assert set(schema["$defs"]["RandomSweep"]["properties"]) == {"count", "seed", "keys"}
