"""One of n paths goes on beyond the third bounce, with the light of all n: less work, the same light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.rendering import Rendering, configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

REPLICAS = 32
GREY = {"type": "diffuse", "reflectance": 0.8}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.15, -0.1, 0.6], "normal": [0.2, -0.1, -1.0]}
SIDE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [-0.6, 0.0, 0.55], "normal": [1.0, 0.1, -0.2]}
HIDDEN = ({**PLATE, "bsdf": GREY}, {**SIDE, "bsdf": GREY})
TINY_LAUNCHES = 1e-9  # seconds: one path per lane and launch after the first


def scene(*hidden: dict, **changes: object) -> dict:
    """Two plates that light each other and the wall; coarse bins."""
    settings: dict = {"sensors": (3, 2), "bins": (0.3, 0.2, 20), "max_bounces": 5, "spp": 65536}
    return flat_wall(*(hidden or HIDDEN), **(settings | changes))


def path_engine(config: dict, **options: object):
    """Return the path engine of a configuration with fields of its options, and its plan."""
    validated = configured(config)
    backend = start_backend("llvm", colored=False)
    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    return stages.prepare(validated, backend, built, capture, time_axis, changes=options)


def assert_same_light(one: Rendering, other: Rendering) -> None:
    """The bounces agree within their noise."""
    for bounce, share in ((3, 0.05), (4, 0.1), (5, 0.1)):
        assert one.bounce(bounce).sum() > 0
        assert_agrees(
            one.bounce(bounce),
            one.bounce_variance(bounce),
            other.bounce(bounce),
            reference_variance=other.bounce_variance(bounce),
            replicas=REPLICAS,
            share=share,
        )


@pytest.mark.parametrize(
    ("scan", "p_hidden_sampling"),
    [
        pytest.param(scan, (0.0, 0.5, 1.0)[j], marks=[] if i == j else pytest.mark.slow)
        for i, scan in enumerate(("exhaustive", "single", "confocal"))
        for j in range(3)
    ],
)
def test_few_paths_carry_the_light_of_all(scan: str, p_hidden_sampling: float) -> None:
    """Bounce by bounce, H has the same expectation whether one path of seven goes on or every one.

    Forgetting their weight, or to take turns, would change the further bounces sevenfold.
    """
    few, all_ = (
        render(
            scene(scan=scan, lasers=(1, 2), seed=every),
            replicas=REPLICAS,
            p_hidden_sampling=p_hidden_sampling,
            continuation_period=every,
        )
        for every in (7, 1)
    )
    assert_same_light(few, all_)


def test_a_number_of_samples_that_is_no_multiple_is_not_biased() -> None:
    """Of 3 paths a lane traces, one of 5 goes on: in some lanes one, in others none, and on average 3 / 5."""
    config = scene(sensors=(24, 20), bins=(0.3, 4.0, 1))
    sums = {}
    for every, seeds in ((5, range(1, 9)), (1, range(101, 109))):
        plan, engine = path_engine(config, replicas=REPLICAS, p_hidden_sampling=1.0, continuation_period=every)
        from nlosrender.engine.interface import Budget

        sums[every] = []
        for seed in seeds:
            engine.options = replace(engine.options, seed=seed)
            histogram = engine.render(plan.batches[0], Budget(spp=3 * REPLICAS))
            sums[every].append(histogram.mean[0, engine.options.bounces.slot(4) :].sum())
    difference = np.mean(sums[5]) - np.mean(sums[1])
    noise = np.sqrt(sum(np.var(rows, ddof=1) / len(rows) for rows in sums.values()))
    assert abs(difference) < 5 * noise  # t of 14 degrees of freedom: false alarm 2e-4
    # always or never the first, or rounding 3 / 5 to whole paths, would be off by two thirds or all of it
    assert noise < 0.05 * np.mean(sums[1])


@pytest.mark.parametrize("max_bounces", [5, None])
def test_paths_that_begin_directly_agree_with_traced_ones(
    max_bounces: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both loops trace the same paths: all bounces of a mesh that hides parts of itself."""
    from nlosrender.engine.path import engine as path_engines

    box = {"type": "box", "center": [0.1, 0.1, 0.5], "size": [0.3, 0.2, 0.2], "rotate_deg": [10, 20, 30], "bsdf": GREY}
    config = scene(*HIDDEN, box, max_bounces=max_bounces, split_bounces=False)
    direct = render(config, replicas=REPLICAS, p_hidden_sampling=1.0, continuation_period=3)
    monkeypatch.setattr(path_engines, "is_third_bounce_loop", lambda settings, sampler: False)
    traced = render(config, ["render.seed=1"], replicas=REPLICAS, p_hidden_sampling=1.0, continuation_period=1)
    assert_agrees(
        direct.total, direct.total_variance, traced.total, replicas=REPLICAS, reference_variance=traced.total_variance
    )


@pytest.mark.parametrize("p_hidden_sampling", [0.0, 1.0])
def test_launches_and_batches_do_not_show(p_hidden_sampling: float) -> None:
    """The same bits in a few launches and in many, in one batch and in several."""
    config = scene(sensors=(5, 7), spp=200)
    options: dict = {"p_hidden_sampling": p_hidden_sampling, "continuation_period": 3}
    whole = render(config, **options)
    parts = render(config, batch_bytes=40_000, **options)
    assert len(parts.plan.batches) > 1
    from nlosrender.engine.launch.schedule import ScheduleTuning

    pieces = render(config, schedule=ScheduleTuning(pass_seconds=TINY_LAUNCHES), **options)
    assert whole.bounce(4).sum() > 0
    for other in (parts, pieces):
        np.testing.assert_array_equal(other.mean, whole.mean)
        np.testing.assert_array_equal(other.variance, whole.variance)


def test_all_turns_are_equally_likely_and_taken_together() -> None:
    """Points of a tile go on at the same time, in every replica at its own; over tiles all turns are as likely."""
    start_backend("llvm", colored=False)
    import mitsuba as mi
    from scipy import stats

    from nlosrender.engine.path.continuation_period import PHASE_TILE, first_phases

    nx, ny, replicas, every = 50, 42, 3, 5
    points = np.arange(nx * ny, dtype=np.uint32)
    turns = np.array(first_phases(7, points, nx, replicas * nx * ny, mi.UInt32(every))).reshape(replicas, ny, nx)
    first = turns[:, ::PHASE_TILE, ::PHASE_TILE]
    spread = first.repeat(PHASE_TILE, axis=1).repeat(PHASE_TILE, axis=2)[:, :ny, :nx]
    np.testing.assert_array_equal(turns, spread)
    assert stats.chisquare(np.bincount(first.ravel(), minlength=every)).pvalue > 1e-3
    assert (first[0] != first[1]).mean() > 0.5
    again = np.array(first_phases(7, points[nx : 3 * nx], nx, 2 * nx, mi.UInt32(every))).reshape(2, nx)
    np.testing.assert_array_equal(again, turns[0, 1:3])  # whatever batch the points are in
    other = np.array(first_phases(8, points, nx, nx * ny, mi.UInt32(every))).reshape(ny, nx)
    assert (other != turns[0]).mean() > 0.5


@pytest.mark.parametrize(
    ("third", "further", "expected"),
    [(1.0, 1.0, 1), (8.0, 1.0, 4), (18.0, 1.0, 6), (1000.0, 1.0, 8), (1.0, 100.0, 1), (1.0, 0.0, 8), (0.0, 0.0, 1)],
)
def test_time_and_variance_are_balanced(third: float, further: float, expected: int) -> None:
    """The share has the least product of variance A + n B and time 1 + 2 / n: n = sqrt(2 A / B), from 1 to 8."""
    from nlosrender.engine.path.continuation_period import LoopCost, best_continuation_period

    cost = LoopCost(2.0, 8, 3)
    assert best_continuation_period(lambda n: third + n * further, cost, split=False) == expected
    assert best_continuation_period(lambda n: third + n * further, cost, split=True) == min(expected, 3)
    candidates = [(third + n * further) * (1 + 2.0 / n) for n in range(1, 9)]
    if further > 0:
        assert candidates[expected - 1] <= min(candidates) * (1 + 1e-12)


@pytest.mark.parametrize("max_bounces", [3, None])
def test_what_cannot_matter_is_not_thinned(max_bounces: int | None) -> None:
    """Every path goes on without roulette, where few are traced, and where bounces kept apart are found by BSDF."""
    from nlosrender.engine.interface import Budget

    many, few = Budget(spp=2**22), Budget(spp=64)
    _, engine = path_engine(scene(max_bounces=max_bounces, split_bounces=False))
    assert (engine.continuation_period(many) > 1) == (max_bounces is None)
    assert engine.continuation_period(few) == 1
    _, without = path_engine(scene(max_bounces=max_bounces, russian_roulette=False, split_bounces=False))
    assert without.continuation_period(many) == 1
    _, split = path_engine(scene(max_bounces=max_bounces, hidden_geometry_sampling=False, split_bounces=True))
    assert split.continuation_period(many) == 1


@pytest.mark.parametrize("p_hidden_sampling", [0.0, 1.0])
def test_any_frame_serves_where_only_normals_matter(p_hidden_sampling: float) -> None:
    """Grey diffuse surfaces look the same from frames of their textures and from any others around the normal."""
    from nlosrender.engine.interface import Budget

    plan, engine = path_engine(scene(), replicas=REPLICAS, p_hidden_sampling=p_hidden_sampling)
    assert engine.settings.is_plain_diffuse
    quick = engine.render(plan.batches[0], Budget(spp=65536))
    engine.settings = replace(engine.settings, is_plain_diffuse=False)
    full = engine.render(plan.batches[0], Budget(spp=65536))
    mean, variance = (getattr(quick, name)[0].sum(axis=0) for name in ("mean", "variance"))
    reference, noise = (getattr(full, name)[0].sum(axis=0) for name in ("mean", "variance"))
    assert_agrees(mean, variance, reference, replicas=REPLICAS, reference_variance=noise)


@pytest.mark.parametrize(
    ("bsdf", "plain"),
    [
        (GREY, True),
        ({"type": "twosided", "nested": GREY}, False),
        ({"type": "diffuse", "reflectance": {"type": "checkerboard"}}, False),
        ({"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4}, False),
    ],
)
def test_textures_and_grooves_need_their_frames(bsdf: dict, plain: bool) -> None:
    """Only diffuse surfaces of one reflectance go without; nor does the wall make an exception."""
    item = {**PLATE, "bsdf": bsdf}
    for config in (scene(item), scene({**PLATE, "bsdf": GREY}, wall={"bsdf": bsdf})):
        assert path_engine(config)[1].settings.is_plain_diffuse == plain


def test_smooth_meshes_need_the_normals_of_their_vertices(tmp_path) -> None:
    """A mesh with shading normals is not plain; the same mesh with face normals is."""
    vertices = "v -0.3 -0.3 0.8\nv 0.3 -0.3 0.8\nv 0 0.3 0.9\n"
    (tmp_path / "one.obj").write_text(vertices + "vn 0 0.1 -1\nvn 0.1 0 -1\nvn 0 0 -1\nf 1//1 2//2 3//3\n")
    for face_normals in (True, False):
        item = {"type": "mesh", "filename": str(tmp_path / "one.obj"), "face_normals": face_normals, "bsdf": GREY}
        assert path_engine(scene(item))[1].settings.is_plain_diffuse == face_normals
