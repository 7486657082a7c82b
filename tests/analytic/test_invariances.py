"""What must not change a result: seeds, batches, splits of bounces, of bins, of the window, units, and poses.

The same seed traces the same samples, so most of these hold exactly, up to the order of float64 sums: 1e4 deposits of
one sign, each sum off by at most 1e4 * 1.1e-16 = 1e-12.
"""

from __future__ import annotations

import copy

import numpy as np
import pytest
from support.quadrature import Array, Frame
from support.rendering import Rendering, flat_wall, render

from nlosrender.capture.plan import BYTES_OF_STATISTICS, BYTES_PER_SUM

ROUNDING = 1e-12

PLATE = {
    "type": "rectangle",
    "width": 0.75,
    "height": 0.5,
    "center": [0.25, -0.125, 0.625],
    "normal": [0.2, -0.1, -1.0],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
# A side wall that the plate sees and that hides the plate's edge from some lasers.
SIDE = {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [-0.5, 0.0, 0.5], "normal": [1.0, 0.2, -0.1]}
BINS = (0.5, 0.03125, 160)


def interreflections(**changes: object) -> dict:
    """Plate and side wall with up to five bounces."""
    settings: dict = {"bins": BINS, "max_bounces": 5, "spp": 640} | changes
    return flat_wall(PLATE, SIDE, **settings)


def assert_same(a: Rendering, b: Rendering) -> None:
    """Equal bit for bit."""
    np.testing.assert_array_equal(a.mean, b.mean)
    np.testing.assert_array_equal(a.variance, b.variance)
    np.testing.assert_array_equal(a.outside, b.outside)


def test_a_seed_repeats_bit_for_bit_and_another_seed_does_not() -> None:
    """Equal seeds give equal files; different seeds give different noise everywhere."""
    first, again, other = (render(interreflections(seed=seed)) for seed in (3, 3, 4))
    assert_same(first, again)
    lit = first.mean > 0
    assert (first.mean != other.mean)[lit].mean() > 0.99


@pytest.mark.parametrize(
    ("scan", "spot"),
    [("single", 0.05), ("confocal", 0.0), ("exhaustive", 0.05)]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in (("single", 0.0), ("confocal", 0.05), ("exhaustive", 0.0))
    ],
)
def test_cutting_a_capture_into_batches_changes_no_bit(scan: str, spot: float) -> None:
    """What a lane computes depends on its sensor point alone: not on the batch, not on the number of lasers in it."""
    config = interreflections(scan=scan, capture={"laser_spot_radius": spot})
    whole = render(config)
    # one (sensor, laser) pair: 4 bounce slots of 161 sums
    pair = 4 * (BINS[2] + 1) * (BYTES_PER_SUM * whole.plan.replicas + BYTES_OF_STATISTICS)
    for pairs in {"exhaustive": (3, 13) if spot else (1, 13)}.get(scan, (2, 7)):
        cut = render(config, batch_bytes=pairs * pair)
        assert len(cut.plan.batches) > 2
        assert_same(whole, cut)


@pytest.mark.parametrize(
    ("max_bounces", "p_hidden_sampling", "spot"),
    [(3, 1.0, 0.0), (4, 0.0, 0.0), (4, 0.5, 0.05)]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in ((3, 1.0, 0.05), (4, 0.0, 0.05), (4, 0.5, 0.0), (4, 1.0, 0.0), (4, 1.0, 0.05))
    ],
)
def test_cutting_a_render_into_launches_changes_no_bit(max_bounces: int, p_hidden_sampling: float, spot: float) -> None:
    """The random state is carried on: how fast a machine is, and so how long its launches are, does not matter."""
    config = interreflections(max_bounces=max_bounces, capture={"laser_spot_radius": spot})
    usual = render(config, p_hidden_sampling=p_hidden_sampling)
    from nlosrender.engine.launch.schedule import ScheduleTuning  # the backend has been started

    one_by_one = ScheduleTuning(pass_seconds=1e-9, first_samples=3)  # one sample per lane and launch
    assert_same(usual, render(config, p_hidden_sampling=p_hidden_sampling, schedule=one_by_one))


def test_bounces_sum_to_the_unsplit_total() -> None:
    """Splitting by bounce only sorts the same deposits."""
    split, unsplit = (render(interreflections(split_bounces=flag)) for flag in (True, False))
    assert (split.mean.sum(axis=(0, 2, 3, 4, 5, 6))[1:] > 0).all()  # bounces 3, 4 and 5 are there
    np.testing.assert_allclose(split.mean.sum(axis=1), unsplit.mean[:, 0], rtol=ROUNDING)
    np.testing.assert_allclose(split.outside.sum(axis=1), unsplit.outside[:, 0], rtol=ROUNDING)


def test_max_bounces_leaves_the_lower_bounces_alone() -> None:
    """The third bounce of a render up to 5 agrees with that of a render up to 3: within their noise, 5 sigma."""
    third, fifth = (render(interreflections(max_bounces=k, spp=32768), replicas=16) for k in (3, 5))
    energies = [r.bounce(3).sum() for r in (third, fifth)]
    sigma = np.sqrt(sum(r.bounce_variance(3).sum() for r in (third, fifth)))
    assert abs(energies[0] - energies[1]) < 5 * sigma < 0.03 * energies[0]


def test_pairs_of_bins_sum_to_bins_of_twice_the_width() -> None:
    """Halving the bins sorts the same samples: a factor of two rounds nothing."""
    start, width, n_bins = BINS
    coarse = render(interreflections(bins=(0.0, width, n_bins)))
    fine = render(interreflections(bins=(0.0, width / 2, 2 * n_bins)))
    pairs = fine.mean.reshape(*fine.mean.shape[:-1], n_bins, 2).sum(axis=-1)
    np.testing.assert_allclose(pairs, coarse.mean, rtol=ROUNDING)
    assert start > 0  # the other tests have a window that starts late


def test_what_a_window_cuts_off_is_counted_outside() -> None:
    """In-window plus outside is the same total, and the bins inside are those of the wide window.

    To the bit with all paths; with the few that go on after the window on average (``test_late_light``).
    """
    wide = render(interreflections(bins=(0.0, 0.03125, 320)))
    assert wide.outside.sum() == 0
    narrow = render(interreflections(bins=(40 * 0.03125, 0.03125, 25)), has_time_gate=False)
    assert 0.1 < narrow.outside.sum() / wide.mean.sum() < 0.9
    np.testing.assert_allclose(narrow.mean.sum(axis=-1) + narrow.outside, wide.mean.sum(axis=-1), rtol=ROUNDING)
    np.testing.assert_allclose(narrow.mean, wide.mean[..., 40:65], rtol=ROUNDING)


def scaled(config: dict, factor: float) -> dict:
    """The configuration with every length multiplied."""
    config = copy.deepcopy(config)
    config["scene"]["relay_wall"] |= {"width": 2.0 * factor, "height": 1.6 * factor}
    for item in config["scene"]["hidden_geometry"]:
        item |= {key: item[key] * factor for key in ("width", "height")}
        item["center"] = [x * factor for x in item["center"]]
    capture = config["capture"]
    for key in ("laser_point", "laser_position", "sensor_position"):
        capture[key] = [x * factor for x in capture[key]]
    for key in ("start_opl", "bin_width_opl"):
        config["time_axis"][key] *= factor
    return config


WITH_LEGS = {"account_first_and_last_bounces": True, "laser_position": [0.5, 0, 1], "sensor_position": [-0.5, 0.25, 1]}


@pytest.mark.parametrize("exponent", [-10, 10])
def test_a_scene_scaled_by_a_power_of_two_is_the_same_to_the_bit(exponent: int) -> None:
    """H falls with the square of the scene's size: millimetres or kilometres are the same computation."""
    config = interreflections(capture=WITH_LEGS)
    same, other = render(config), render(scaled(config, 2.0**exponent))
    np.testing.assert_array_equal(other.mean * 4.0**exponent, same.mean)
    np.testing.assert_array_equal(other.outside * 4.0**exponent, same.outside)


def assert_nearly_same_samples(a: Array, b: Array) -> None:
    """Equal but for float32 rounding of positions, 1e-7 of the scene.

    Energies: a deposit changes by about 10 * 1e-7. Bins: a bin is 1/64 of the scene, so 64 * 2e-7 of the deposits
    change sides, and as many are newly hidden or seen at an edge: 3e-5 of the energy, in few large pieces: one deposit
    is 1/640 of the energy of one of 15 sensor points, 1e-4 of the total, so two of them may move.
    """
    np.testing.assert_allclose(a.sum(), b.sum(), rtol=1e-4)
    assert np.abs(a - b).sum() < 4e-4 * b.sum()
    assert np.isclose(a, b, rtol=1e-4, atol=1e-9 * b.max()).mean() > 0.999


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_scene_in_other_units_is_the_same_scene(factor: float) -> None:
    """Lengths times 1e-3 and 1e3: H times 1e6 and 1e-6, the same samples up to rounding."""
    config = interreflections(capture=WITH_LEGS)
    assert_nearly_same_samples(render(scaled(config, factor)).mean * factor**2, render(config).mean)


def test_a_scene_far_away_and_rotated_is_the_same_scene() -> None:
    """Everything moved by 1e4 m and turned: geometry comes to the wall's frame in float64, 1e4 m * 1e-16 = 1e-12 m."""
    config = interreflections(capture=WITH_LEGS)
    moved = copy.deepcopy(config)
    origin = np.array([1e4, -2e4, 0.5e4])
    frame = Frame.of([0.4, -0.3, 0.8], [0.1, 1.0, 0.2])
    turn = np.stack([frame.x, frame.y, frame.normal], axis=-1)
    wall = moved["scene"]["relay_wall"]
    wall |= {"center": origin.tolist(), "normal": turn[:, 2].tolist(), "up": turn[:, 1].tolist()}
    for item in moved["scene"]["hidden_geometry"]:
        item["center"] = (origin + turn @ item["center"]).tolist()
        item["normal"], item["up"] = (turn @ item["normal"]).tolist(), turn[:, 1].tolist()
    for key in ("laser_position", "sensor_position"):
        moved["capture"][key] = (origin + turn @ moved["capture"][key]).tolist()
    assert_nearly_same_samples(render(moved).mean, render(config).mean)
