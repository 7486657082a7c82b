"""``nlosrender check-engines``: two techniques that disagree are found, and two that agree are left alone."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.commands import run

from nlosrender.analysis.engine_check import Trial, compare_trials
from nlosrender.capture.bounces import BounceAxis
from nlosrender.engine.launch.pilot_points import Pilot, Selection
from nlosrender.errors import EXIT_BAD_INPUT, EXIT_COMPARISON_EXCEEDED, EXIT_OK, EXIT_USAGE

PILOT = Pilot(Selection((3, 8, 21)), Selection((0,)))
BOUNCES = BounceAxis(4, split=True)
PLATE = """
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {name: plate, type: rectangle, width: 0.7, height: 0.5, center: [0.1, 0, 0.8], normal: [0.1, 0, -1]HIDDEN}
capture:
  scan_type: single
  sensor_grid: {nx: 9, ny: 7}
  laser_point: [0.2, 0.1]
  account_first_and_last_bounces: false
time_axis: {start_opl: 1.0, bin_width_opl: 0.1, n_bins: 20}
render: {max_bounces: 3}
"""


def trial(name, seed, deposits, scale=1.0, obstacle=None):
    """Histograms (1, 3 bounces, 1 laser, 3 sensors, 40) of ``deposits`` equal paths per sensor point in 16 replicas."""
    rng, replicas = np.random.default_rng(seed), 16
    shape = np.exp(-(np.linspace(-2, 2, 40) ** 2))
    light = np.array([0.0, 1.0, 0.2])[:, None, None, None] * np.ones((1, 3, 1)) * shape / shape.sum()
    counts = scale * rng.poisson(np.broadcast_to(light * deposits / replicas, (replicas, *light.shape))) / deposits
    mean, variance = counts.mean(0) * replicas, counts.var(0, ddof=1) * replicas
    attributes = {"replicas": replicas, "max_bounces": 4, "render_engine": "path"}
    return Trial(name, obstacle, 1.0, mean[None], variance[None], attributes)


def test_techniques_that_agree_raise_one_alarm_in_a_hundred():
    """Of 60 comparisons of equal light with a significance of 1 % hardly any is an alarm."""
    alarms = [
        not compare_trials([trial("a", seed, 4000), trial("b", 1000 + seed, 4000)], BOUNCES, PILOT, 0.01)[0].agrees
        for seed in range(60)
    ]
    assert sum(alarms) <= 4  # P(more than 4 of 60 at 1 % each) = 3e-4


def test_a_difference_above_what_is_said_to_be_visible_is_seen():
    """The energy difference that a check says it would see, it sees; and a smaller one it may miss."""
    same = compare_trials([trial("a", 1, 4000), trial("b", 2, 4000)], BOUNCES, PILOT, 0.01)[0]
    third = same.bounces[1]
    assert 0 < third.visible_energy < 0.2
    # twice what is visible: the deviation has a spread of 1 sigma around twice 4 sigma or more
    apart = compare_trials(
        [trial("a", 3, 4000, 1 + 2 * third.visible_energy), trial("b", 4, 4000)], BOUNCES, PILOT, 0.01
    )
    assert not apart[0].agrees
    assert apart[0].bounces[1].energy == pytest.approx(2 * third.visible_energy, abs=third.visible_energy)
    assert "bounce" in apart[0].worst


def test_techniques_that_could_not_render_are_in_no_pair():
    """An obstacle is told, not compared."""
    trials = [trial("a", 1, 100), trial("b", 2, 100), trial("c", 3, 100, obstacle="mirrors")]
    assert [pair.techniques for pair in compare_trials(trials, BOUNCES, PILOT, 0.01)] == [("a", "b")]


def test_three_techniques_agree_on_a_plate(tmp_path):
    """Paths with and without hidden geometry sampling and virtual lights see the same plate; nothing is written."""
    (tmp_path / "plate.yaml").write_text(PLATE.replace("HIDDEN", ""))
    done = run(tmp_path, "check-engines", "plate.yaml", "--points", 2, "--target-error", 0.03, "--json")
    assert done.returncode == EXIT_OK, done.stderr
    check = json.loads(done.stdout)
    assert check["agrees"]
    assert check["sensor_points"] == 4
    assert [t["obstacle"] for t in check["techniques"]] == [None] * 3
    assert len(check["pairs"]) == 3
    assert all(pair["n_statements"] > 0 for pair in check["pairs"])
    assert [path.name for path in tmp_path.iterdir()] == ["plate.yaml"]


def test_what_no_technique_samples_is_said(tmp_path):
    """Two techniques that both miss the light of a mirror with holes agree, and the command says what that is worth."""
    (tmp_path / "mirror.yaml").write_text(
        PLATE.replace("HIDDEN", ", bsdf: {type: mask, opacity: 0.9, bsdf: {type: conductor}}")
    )
    done = run(tmp_path, "check-engines", "mirror.yaml", "--points", 2, "--seconds", 0.5)
    assert done.returncode == EXIT_OK
    assert "virtual lights: not rendered, some hidden surfaces let light through" in done.stdout
    assert "no difference would have been seen" in done.stdout
    assert "agreement says nothing about this light" in done.stderr


def test_a_difference_ends_with_exit_code_4(tmp_path, monkeypatch):
    """A technique that is a fifth too bright is named, with bounce and points."""
    from nlosrender.analysis import engine_check

    really = engine_check.try_technique
    seen = []

    def tampered(technique, engine, pilot, budget):
        seen.append(technique)
        result = really(technique, engine, pilot, budget)
        if len(seen) == 2:
            result.mean[...] *= 1.2
        return result

    monkeypatch.setattr(engine_check, "try_technique", tampered)
    (tmp_path / "plate.yaml").write_text(PLATE.replace("HIDDEN", ""))
    done = run(tmp_path, "check-engines", "plate.yaml", "--points", 2, "--target-error", 0.03)
    assert done.returncode == EXIT_COMPARISON_EXCEEDED
    assert "path and path without hidden geometry sampling differ: bounce 3" in done.stderr
    assert "DIFFER" in done.stdout


@pytest.mark.parametrize(
    ("text", "code"), [(PLATE.replace("HIDDEN", ", bsdf: {type: difuse}"), EXIT_BAD_INPUT), (None, EXIT_BAD_INPUT)]
)
def test_what_cannot_be_read_ends_as_for_render(tmp_path, text, code):
    """Mistakes in the file, or no file."""
    if text:
        (tmp_path / "plate.yaml").write_text(text)
    assert run(tmp_path, "check-engines", "plate.yaml").returncode == code


def test_a_view_has_nothing_to_compare_with(tmp_path):
    """One technique renders line-of-sight captures."""
    (tmp_path / "view.yaml").write_text("""
scene:
  hidden_geometry: [{type: rectangle, width: 0.5, height: 0.4, center: [0, 0, 0.9], normal: [0, 0, -1]}]
  emitters: [{type: point, position: [0, 0.3, 0], intensity: 1.0}]
capture: {scan_type: line_of_sight, camera: {position: [0, 0, -1], look_at: [0, 0, 1], width: 5, height: 3}}
time_axis: {bin_width_opl: 0.05, n_bins: 200}
render: {max_bounces: 3}
""")
    assert run(tmp_path, "check-engines", "view.yaml").returncode == EXIT_USAGE
