"""``nlosrender bench``: honest numbers from runs, and a command that says what is wrong."""

import json
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from nlosrender.bench import references, skips
from nlosrender.bench.curve import Curve, Point, power_law
from nlosrender.bench.factory import CELLS, crumpled_ball
from nlosrender.bench.peer import PeerContender, matched
from nlosrender.bench.race import race
from nlosrender.bench.rates import gather_rate
from nlosrender.bench.references import Reference
from nlosrender.bench.runs import Run, load
from nlosrender.bench.scaling import write_wavy_sheet
from nlosrender.bench.scenes import built_in_scenes, wavy_sheet
from nlosrender.cli.app import app

TRUTH = np.random.default_rng(1).uniform(0.5, 1.5, (1, 10, 12, 400))  # (laser, row, column, bin)
EXACT = Reference(TRUTH, 0.0, "given", 0.0)


class Noisy:
    """A contender whose error is known: noise that halves with each level and a bias, both relative L2."""

    def __init__(self, name, noise, bias=0.0):
        self.name, self.noise, self.bias, self.is_random = name, noise, bias, True
        self.seeds = []

    def run(self, level, seed):
        self.seeds.append((level, seed))
        noise = np.random.default_rng([level, seed]).standard_normal(TRUTH.shape)
        shift = np.where(np.arange(TRUTH.shape[-1]) % 2, 1.0, -1.0)
        norm = np.sqrt((TRUTH**2).mean())
        values = TRUTH + norm * (self.noise / 2**level * noise + self.bias * shift)
        return Run(values, 0.1 * 4**level, 0.2 * 4**level, samples=64 * 4**level, engine="noise")


def test_a_race_finds_error_slope_and_bias_of_a_contender_that_has_them():
    """Noise of s per run gives an error of s; what runs share shows in their product, independent noise does not."""
    clean, biased = race([Noisy("clean", 1.0), Noisy("biased", 1.0, bias=0.5)], EXACT, seconds=1e-3, target=0.9)
    assert len(clean.points) == len(biased.points) >= 1
    first = clean.points[0]
    assert first.repeats == 3
    # the norm of 48,000 normal numbers is within 5 / sqrt(96,000) of its mean
    assert first.error == pytest.approx(1.0, rel=0.016)
    assert clean.bias is None
    # the product of two noises of 1 over 48,000 bins has a deviation of 1 / sqrt(48,000) = 0.0046, their products with
    # the bias 0.5 * sqrt(2 / 48,000) = 0.0032: 5 of 0.0056 together
    assert biased.points[0].systematic ** 2 == pytest.approx(0.25, abs=0.028)


def test_noise_that_the_bins_of_a_sensor_point_share_is_no_bias():
    """Low-discrepancy numbers err alike in all bins of a point: two such runs only seem to have something in common."""

    class Shared(Noisy):
        def run(self, level, seed):
            noise = np.random.default_rng([level, seed, int(self.name)]).standard_normal((*TRUTH.shape[:-1], 1))
            return Run(TRUTH * (1 + noise), 0.1 * 4**level, 0.2 * 4**level, samples=64 * 4**level, engine="noise")

    curves = race([Shared(f"{k}", 1.0) for k in range(8)], EXACT, seconds=1e-3, target=0.9)
    assert [curve.bias for curve in curves] == [None] * 8


def test_contenders_take_turns():
    """A machine that is busy for a while slows all contenders alike."""
    order = []

    class Watched(Noisy):
        def run(self, level, seed):
            order.append(self.name)
            return super().run(level, seed)

    race([Watched("a", 1.0), Watched("b", 1.0)], EXACT, seconds=1e-9, target=0.9)
    assert order == ["a", "b"] * (len(order) // 2)
    assert len(order) == 8  # one that compiles and three that count, each


def curve(*points, is_random=True, bias=None):
    found = Curve("some", is_random)
    for seconds, error in points:
        found.points.append(Point(seconds, 2 * seconds, error, systematic=bias))
    return found


def test_time_to_an_error_is_read_off_or_extrapolated_or_unknown():
    """Between points by a power law; beyond them by 1 / sqrt for paths, unless a bias is in the way."""
    measured = curve((1.0, 0.2), (4.0, 0.1), (16.0, 0.05))
    assert measured.time_to(0.1) == (pytest.approx(4.0), "interpolated")
    assert measured.time_to(0.1 / math.sqrt(2))[0] == pytest.approx(8.0)
    assert measured.time_to(0.5) == (1.0, "measured")
    assert measured.time_to(0.01) == (pytest.approx(16.0 * 25), "extrapolated")
    assert measured.time_to(0.01, cpu=True) == (pytest.approx(32.0 * 25), "extrapolated")
    assert measured.slope() == pytest.approx(-0.5)
    assert curve((1.0, 0.2), is_random=False).time_to(0.1) == (math.inf, "not reached")
    assert curve((1.0, 0.2), bias=0.15).time_to(0.1) == (math.inf, "not reached")
    refined = curve((1.0, 0.2), bias=0.15)
    refined.engine = "virtual_lights"  # what its runs share is the error of a resolution, not a bias
    assert refined.time_to(0.1) == (pytest.approx(4.0), "extrapolated")
    assert curve((1.0, 0.2), bias=0.05).time_to(0.1) == (pytest.approx(4.0), "extrapolated")


def test_power_law_needs_two_sizes():
    """The exponent of exact powers is found; one size tells nothing."""
    assert power_law([1, 2, 8], [3, 12, 192]) == pytest.approx(2.0)
    assert power_law([4], [1.0]) is None


@pytest.mark.parametrize("scan", ["single", "confocal"])
def test_noise_of_a_peer_is_not_scaled_away(scan):
    """A peer's unit, per laser point, does not matter, and its noise of 300 % stays an error of 300 %."""
    unit = 7.0 if scan == "single" else np.random.default_rng(2).uniform(5, 9, (1, 10, 12, 1))
    noise = np.random.default_rng(3).standard_normal(TRUTH.shape) * np.sqrt((TRUTH**2).mean())
    run = Run(unit * (TRUTH + 3.0 * noise), 0.0, 0.0, samples=64)
    contender = PeerContender("peer", SimpleNamespace(), {"scan": scan}, {}, agreement={"samples": 0})
    values = matched(contender, run, EXACT)
    error = np.linalg.norm(values - TRUTH) / np.linalg.norm(TRUTH)
    # a scale is off by 3 / sqrt(bins behind it): 1.4 % for all 48,000, 15 % for the 400 of one laser point
    assert error == pytest.approx(3.0, rel=0.15 if scan == "confocal" else 0.08)


def test_quadrature_of_the_plate_agrees_with_counting_small_cells():
    """The trapezoid shares of 4 mm cells are the light of 1 million points binned by their delay."""
    laser, sensor, n = np.zeros(3), np.array([0.1, 0.7, 0.0]), 1500
    side = ((np.arange(n) + 0.5) / n - 0.5) * references.PLATE_SIZE
    x, y = np.meshgrid(side, side)
    r1, r2 = np.sqrt(x**2 + y**2 + 1), np.sqrt((x - sensor[0]) ** 2 + (y - sensor[1]) ** 2 + 1)
    light = references.PLATE_REFLECTANCE / np.pi**3 * (references.PLATE_SIZE / n) ** 2 / (r1 * r2) ** 4
    counted, _ = np.histogram(r1 + r2, bins=90, range=(2.0, 2.9), weights=light)
    middles = ((np.arange(200) + 0.5) / 200 - 0.5) * references.PLATE_SIZE
    cells = np.stack([*(part.ravel() for part in np.meshgrid(middles, middles)), np.ones(200**2)])
    row = references._plate_row(cells, laser, sensor, 2.0, 0.01, 90)
    # points per bin 2e6 / 60, those at its two edges 2 * 1500, at random on either side: sqrt(3000) / 3e4 = 0.2 %
    assert np.linalg.norm(row - counted) / np.linalg.norm(counted) < 4e-3


def test_the_gather_and_the_rays_it_leaves_out_are_counted_alike(tmp_path):
    """Rays are fewer than pairs, fewer still where nothing can stop them, and what is left out changes nothing."""
    write_wavy_sheet(tmp_path / "sheet.ply", 2000)
    loaded = load(wavy_sheet(tmp_path / "sheet.ply", 16))
    rate = gather_rate(loaded)
    assert rate["traces_rays"]
    assert rate["lit_patches"] <= rate["patches"]
    assert rate["pairs"] == 256 * rate["patches"]
    assert 0 < rate["asked_rays"] < rate["rays"] <= 256 * rate["lit_patches"]
    assert rate["rays_left_out"] == 1 - rate["asked_rays"] / rate["pairs"]
    (saving,) = skips.of_gather(loaded)
    assert saving.what == "rays that nothing can stop"
    assert saving.difference < 1e-6
    box, mixture = skips.of_paths(loaded)
    assert "pass the hidden geometry by" in box.what
    assert box.difference == 0
    assert mixture.difference > 0


def test_every_scene_has_a_valid_configuration(tmp_path):
    """Also those that need a mesh; another one stands in for the furniture, which takes seconds to write."""
    write_wavy_sheet(tmp_path / "sheet.ply", 200)
    write_wavy_sheet(tmp_path / "bench-furniture.ply", 200)
    scenes = built_in_scenes(tmp_path / "sheet.ply", tmp_path)
    assert len(scenes) == 14
    for scene in scenes.values():
        scene.config()


def test_unknown_names_are_refused_with_what_is_known():
    """A usage error, exit code 2, that names the nearest scene and says what the bunny needs."""
    refused = CliRunner().invoke(app, ["bench", "--scene", "plat"])
    assert refused.exit_code == 2
    assert "Did you mean plate?" in refused.output
    assert "--mesh" in CliRunner().invoke(app, ["bench", "--scene", "bunny"]).output


@pytest.mark.slow
def test_a_short_benchmark_leaves_its_files(tmp_path):
    """One scene for a second: a table, a JSON file that holds the same, and a plot."""
    command = [sys.executable, "-m", "nlosrender", "bench", "--scene", "plate", "--part", "curves", "--seconds", "1"]
    done = subprocess.run([*command, "-o", tmp_path / "b", "--json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report == json.loads((tmp_path / "b.json").read_text())
    assert (tmp_path / "b.png").stat().st_size > 10_000
    curves = {found["name"]: found for found in report["scenes"][0]["curves"]}
    assert set(curves) == {"auto", "path", "path, BSDF sampling"}
    # unbiased within a wide margin: 64 paths for each of 4096 sensor points
    assert all(abs(found["energy_bias"]) < 0.05 for found in curves.values())


def test_balls_of_a_data_set_are_new_and_closed():
    """Each mesh is another one, its outside is its front, and its longest triangles do not tear it."""
    volumes = []
    for number in range(3):
        vertices, faces = crumpled_ball(number)
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        volumes.append(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
        assert len(faces) == 2 * CELLS**2
        assert np.isfinite(vertices).all()
    assert min(volumes) > 1
    assert len(set(volumes)) == 3
