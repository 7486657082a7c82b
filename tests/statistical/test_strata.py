"""Paths in the order of their first coordinates, complete whatever the launches; the third bounce traced directly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.rendering import configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend

pytestmark = pytest.mark.usefixtures("backend")

PLATE = {
    "type": "rectangle",
    "width": 0.8,
    "height": 0.6,
    "center": [0.1, -0.05, 0.9],
    "normal": [0.2, -0.1, -1],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
BEHIND = {**PLATE, "center": [0.0, 0.1, 1.1], "normal": [0, 0, -1], "width": 1.2}
TINY_LAUNCHES = 1e-9  # seconds: one path per lane and launch after the first


def path_engine(config: dict):
    """Return the path engine of a configuration, and its plan."""
    from nlosrender.rendering import stages

    validated = configured(config)
    backend = start_backend("llvm", colored=False)
    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    return stages.prepare(validated, backend, built, capture, time_axis)


@pytest.mark.parametrize(("first", "n"), [(0, 1), (0, 7), (32, 4096), (5, 100_003)])
def test_every_stratum_is_visited_once(first: int, n: int) -> None:
    """Path i of a block of n takes its first coordinate from the i-th of n equal parts, at one place in all parts."""
    import mitsuba as mi

    from nlosrender.engine.launch.sequences import SystematicSequence, first_coordinate

    starts = np.array([0, 1, 2**31, 2**32 - 1], dtype=np.uint32)
    strata = SystematicSequence.of_paths(range(first, first + n), mi.UInt32(starts))
    stride = int(np.array(strata.stride)[0])
    position = np.array(strata.position)
    for lane in range(len(starts)):
        exact = [int(position[lane]) + i * stride for i in range(n)]
        # the upper 32 bits are what is used: parts are 2^32 / n wide
        parts = [(value >> 32) * n // 2**32 for value in exact]
        off = np.array(parts) - np.arange(n)
        assert set(off) <= {0, -1}  # -1: the place is the part's left edge, rounded down to 32 bits
    np.testing.assert_array_equal(np.array(first_coordinate(strata.position)), position >> np.uint64(32))


@pytest.mark.parametrize("seed", range(3))
def test_the_place_within_the_parts_is_uniform(seed: int) -> None:
    """Over lanes, a path's first coordinate is uniform in its part: systematic sampling is unbiased."""
    import mitsuba as mi
    from scipy import stats

    from nlosrender.engine.launch.lane_random_state import LaneRandomness
    from nlosrender.engine.launch.sequences import SystematicSequence, first_coordinate

    n = 5
    lanes = mi.UInt32(np.arange(4096, dtype=np.uint32))
    strata = SystematicSequence.of_paths(range(64, 64 + n), LaneRandomness.seeded(seed, lanes).sequence[0])
    within = np.array(first_coordinate(strata.position)) / 2.0**32 * n
    assert within.max() < 1 + 1e-6
    assert stats.kstest(within, "uniform").pvalue > 1e-4  # false alarm in one of 1e4


@pytest.mark.parametrize("max_bounces", [3, 5])
def test_launches_do_not_show(max_bounces: int) -> None:
    """The same samples give the same bits in three launches and in many."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.launch.schedule import ScheduleTuning

    plan, engine = path_engine(flat_wall(PLATE, BEHIND, max_bounces=max_bounces))
    budget = Budget(spp=165 * engine.options.replicas)  # the first two launches take 32 and 128
    whole = engine.render(plan.batches[0], budget)
    engine.options = replace(engine.options, schedule=ScheduleTuning(pass_seconds=TINY_LAUNCHES))
    pieces = engine.render(plan.batches[0], budget)
    assert whole.mean.sum() > 0
    for name in ("mean", "variance", "outside"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("hidden", [(PLATE,), (PLATE, BEHIND)], ids=["alone", "occluded"])
def test_direct_paths_agree_with_traced_ones(scan: str, hidden: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asking whether a sampled point is seen gives what tracing a ray to it and looking what it meets gives."""
    from nlosrender.engine.path import engine as path_engines

    config = flat_wall(*hidden, scan=scan, spp=8192, bins=(1.0, 0.05, 60))
    direct = render(config, replicas=16)
    monkeypatch.setattr(path_engines, "is_third_bounce_loop", lambda settings, sampler: False)
    traced = render(config, ["render.seed=1"], replicas=16)
    assert direct.mean.sum() > 0
    assert_agrees(
        direct.total, direct.total_variance, traced.total, replicas=16, reference_variance=traced.total_variance
    )


@pytest.mark.parametrize("max_bounces", [3, 4])
@pytest.mark.parametrize(
    "hidden",
    [PLATE, {"type": "room", "size": [2.4, 2.0, 1.5], "bsdf": {"type": "diffuse", "reflectance": 0.5}}],
    ids=["plate", "room"],
)
def test_rays_that_nothing_can_stop_are_left_out(max_bounces: int, hidden: dict) -> None:
    """One convex object alone, or a convex room: the same numbers with and without shadow rays."""
    from nlosrender.engine.interface import Budget

    plan, engine = path_engine(flat_wall(hidden, max_bounces=max_bounces, spp=512))
    assert not engine.settings.needs_visibility
    without = engine.render(plan.batches[0], Budget(spp=512))
    engine.settings = replace(engine.settings, needs_visibility=True)
    with_rays = engine.render(plan.batches[0], Budget(spp=512))
    # a ray that grazes the edge of the wall or of the room may be taken for stopped
    np.testing.assert_allclose(without.mean.sum(), with_rays.mean.sum(), rtol=1e-3)
    different = np.abs(without.mean - with_rays.mean) > 1e-6 * with_rays.mean.max()
    assert different.mean() < 1e-3


@pytest.mark.parametrize(
    "hidden",
    [
        (PLATE, BEHIND),
        ({**PLATE, "bsdf": {"type": "twosided", "nested": {"type": "diffuse"}}},),
        ({"type": "letters", "text": "L", "height": 0.6, "center": [0, 0, 1], "normal": [0, 0, -1], "thickness": 0.1},),
    ],
    ids=["two", "two-sided", "not convex"],
)
def test_rays_are_kept_where_something_may_stop_them(hidden: tuple) -> None:
    """Two objects, an object lit from behind, one that is not convex: every connection takes its ray."""
    _, engine = path_engine(flat_wall(*hidden))
    assert engine.settings.needs_visibility
