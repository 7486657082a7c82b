"""What can only arrive after the time window is thinned out: less work, and the same light in it and after it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import grouped
from support.engine_sums import SHARE, Sums, assert_alike
from support.engines import with_options
from support.rendering import configured, flat_wall, render
from support.varied_scenes import GREY_WALL, LEGS, SIDE, SLANTED, Item, Stage, room

from nlosrender.engine.backend.start import start_backend

Array = NDArray[np.float64]
SEEDS, OTHER_SEEDS = range(1, 11), range(101, 111)
SHORT, LONG = 30, 150  # bins of 0.1 m
ROOM = room([2.0, 1.6, 1.2], 0.7)
OPEN = (SLANTED, SIDE)  # lets light go to and fro between wall and plates: the detour over the hidden geometry counts
BUDGETS: dict[str, Item] = {"path": {"spp": 1024}, "virtual_lights": {"rounds": 1, "patch_scale": 1.0}}


def scene(*hidden: Item, scan: str = "single", n_bins: int = SHORT, width: float = 0.1, **keys: Any) -> Item:
    """Return a capture of all bounces before a grey wall."""
    settings: Item = {"wall": GREY_WALL, "max_bounces": None, "sensors": (3, 2), "engine": "path", "spp": None} | keys
    return flat_wall(*hidden, scan=scan, bins=(0.0, width, n_bins), **settings)


def with_outside(stage: Stage, engine: str, seeds: range) -> Array:
    """Render once per seed; return (seed, row, bin), the light outside the window as one more bin."""
    from nlosrender.engine.interface import Budget

    results = stage.repeated(Budget(**BUDGETS[engine]), seeds)
    rows = np.concatenate([results.means, results.outsides[..., None]], axis=-1)
    return rows.reshape(len(rows), -1, rows.shape[-1])


def grouped_sums(short: Array, long: Array) -> Sums:
    """Sums over groups of bins of every row of the short window, over all of it, and over what is outside.

    All of one seed's rows together, too: the roulette's noise must not add up to a bias.
    """
    late = long[..., SHORT:].sum(axis=-1, keepdims=True)
    long = np.concatenate([long[..., :SHORT], late], axis=-1)
    short, long = (np.concatenate([rows, rows.sum(axis=1, keepdims=True)], axis=1) for rows in (short, long))
    columns = []
    for row in range(long.shape[1]):
        labels = grouped(long[:, row, :SHORT].mean(axis=0), SHARE)
        groups = [np.flatnonzero(labels == label) for label in range(labels.max() + 1)]
        for chosen in (*groups, np.arange(SHORT), [SHORT]):
            columns.append((short[:, row, chosen].sum(axis=1), long[:, row, chosen].sum(axis=1)))
    ours, theirs = (np.array(column).T for column in zip(*columns, strict=True))
    # the third bounce of the virtual lights has no noise, but is summed up in float32
    return Sums(ours, theirs, 1e-6 * theirs.mean(axis=0))


CASES = [
    ("path", "single", (ROOM,), {}),
    pytest.param("path", "confocal", (ROOM,), {"capture": LEGS}, marks=pytest.mark.slow),
    ("path", "exhaustive", OPEN, {"lasers": (2, 3), "capture": LEGS}),
    ("path", "single", (ROOM,), {"laser_sampling": False, "capture": {"laser_spot_radius": 0.2}}),
    ("virtual_lights", "single", (ROOM,), {}),
    pytest.param("virtual_lights", "confocal", OPEN, {"capture": LEGS}, marks=pytest.mark.slow),
    pytest.param("virtual_lights", "exhaustive", (ROOM,), {"lasers": (2, 3), "capture": LEGS}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("engine", "scan", "hidden", "keys"), CASES)
def test_a_short_window_sees_what_a_long_one_sees_there(engine: str, scan: str, hidden: Any, keys: Item) -> None:
    """Bins have the same expectation whether the window ends soon or late, and no light outside is lost or gained."""
    keys = {**keys, "engine": engine}
    short, long = (Stage.of(scene(*hidden, scan=scan, n_bins=n_bins, **keys)) for n_bins in (SHORT, LONG))
    assert short.engine.name == engine
    rows = with_outside(short, engine, SEEDS), with_outside(long, engine, OTHER_SEEDS)
    assert rows[0][..., SHORT].mean() > 0.01 * rows[0].sum(axis=-1).mean()
    assert_alike(grouped_sums(*rows), f"{engine}, {scan}")


@pytest.mark.parametrize(
    ("engine", "scan", "max_bounces", "width"),
    [
        ("path", "single", 5, 0.1),
        ("path", "exhaustive", None, 2.0),
        ("virtual_lights", "confocal", 5, 0.1),
        ("virtual_lights", "single", None, 2.0),
    ],
)
def test_a_window_that_holds_everything_keeps_every_bit(
    engine: str, scan: str, max_bounces: int | None, width: float
) -> None:
    """Nothing is late: not a random number is drawn for it. Where bounces end, nothing is even compared."""
    from nlosrender.engine.interface import Budget

    config = scene(*OPEN, scan=scan, n_bins=LONG, width=width, max_bounces=max_bounces, engine=engine)
    stage = Stage.of(config)
    patient = Stage(with_options(stage.engine, has_time_gate=False), stage.batch, stage.bounces)
    horizon = stage.engine.device.capture_gate
    assert (horizon is None) == (max_bounces is not None)
    ours, theirs = (one.repeated(Budget(**BUDGETS[engine]), range(1)) for one in (stage, patient))
    assert ours.means.any()
    assert not ours.outsides.any()
    np.testing.assert_array_equal(ours.means, theirs.means)


@pytest.mark.parametrize(
    ("engine", "scan"),
    [("path", "confocal"), ("virtual_lights", "exhaustive")]
    + [
        pytest.param(*more, marks=pytest.mark.slow) for more in (("path", "exhaustive"), ("virtual_lights", "confocal"))
    ],
)
def test_how_a_capture_is_cut_changes_no_bit_of_late_light(engine: str, scan: str) -> None:
    """What is late is so for the capture, not for the batch."""
    budget = {"spp": 64} if engine == "path" else {"spp": None, "target_error": 0.5}
    config = scene(ROOM, scan=scan, engine=engine, capture=LEGS, **budget)
    whole = render(config, batch_bytes=10**9)
    pieces = render(config, batch_bytes=whole.plan.bytes_per_batch // 2)
    assert len(whole.plan.batches) == 1 < len(pieces.plan.batches)
    assert whole.outside.any()
    for name in ("mean", "outside"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)


def test_kernels_do_not_know_where_the_window_ends() -> None:
    """A window that ends elsewhere is data: paths and subpaths are compiled once."""
    stage = Stage.of(scene(ROOM, engine="virtual_lights"))
    import drjit as dr

    from nlosrender.engine.interface import Budget
    from nlosrender.engine.launch.device_capture import DeviceCapture

    engine, lights = stage.engine.paths, stage.engine
    hashes = []
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        for start in (0.0, -1.0, 0.5):
            axis = replace(engine.time_axis, start_opl=start)
            device = DeviceCapture(engine.built, engine.capture, axis, engine.options)
            paths = type(engine)(device)
            further = type(lights.further)(device, lights.tessellator, lights.further.masks, lights.settings.is_diffuse)
            dr.kernel_history_clear()
            paths.render(stage.batch, Budget(spp=16))
            further.accumulate(stage.batch, further.histogram(stage.batch, 2), 0)
            hashes.append({kernel["hash"] for kernel in dr.kernel_history((dr.KernelType.JIT,))})
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    assert hashes[0]
    assert hashes[0] == hashes[1] == hashes[2]


def test_a_path_is_late_when_the_straight_way_to_the_laser_ends_after_the_window() -> None:
    """By hand: 0.8 m from the laser point, or by way of geometry 0.3 m before the wall from a point 0.8 m beside it."""
    stage = Stage.of(scene({**SLANTED, "center": [0, 0, 0.3], "normal": [0, 0, -1]}))
    import drjit as dr
    import mitsuba as mi

    engine = stage.engine
    unit = engine.built.metres_per_engine_unit
    deadline = engine.device.launch_params(stage.batch, engine.device.shape(stage.batch, 1)).time_gate
    # the laser is at (0.3, -0.2, 0); 3 m end in the window
    away = mi.Point3f(0.3, -0.2, 0.8) / unit
    beside = mi.Point3f(-0.5, -0.2, 0.0) / unit
    for point, on_wall, way in ((away, False, 0.8), (beside, False, 0.8), (beside, True, 1.0)):
        for opl, late in ((3 - way - 1e-4, False), (3 - way + 1e-4, True)):
            assert dr.all(deadline.is_past(mi.Float(opl / unit), point, mi.Bool(on_wall)) == mi.Bool(late))


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
@pytest.mark.parametrize("scan", ["single", "confocal"])
def test_without_survivors_no_light_comes_after_the_window(engine: str, scan: str) -> None:
    """Every path and subpath is stopped before the first connection that ends after the window, legs included.

    One sensor point and one laser point: the bound is exact. The third bounce of the virtual lights is no subpath's.
    """
    stage = Stage.of(scene(ROOM, engine=engine, scan=scan, sensors=(1, 1), capture=LEGS, width=0.2))
    from nlosrender.engine.interface import Budget

    def outside_and_inside(stage: Stage) -> tuple[float, float]:
        result = stage.seeded(3).render(stage.batch, Budget(**BUDGETS[engine]))
        further = slice(stage.bounces.slot(4), None)
        return float(result.outside[:, further].sum()), float(result.mean[:, further].sum())

    usual = outside_and_inside(stage)
    closed = with_options(stage.engine, gate_survival=0.0)
    outside, inside = outside_and_inside(Stage(closed, stage.batch, stage.bounces))
    assert usual[0] > 0.1 * usual[1] > 0
    # 1e-4: paths that end within rounding of the window's end
    assert outside < 1e-4 * usual[0]
    assert inside > 0.5 * usual[1]


@pytest.mark.parametrize("scan", ["confocal", "exhaustive"])
def test_a_deadline_counts_the_legs(scan: str) -> None:
    """From the window's end go the sensor point's own leg and the least of a laser's, or its own."""
    stage = Stage.of(scene(ROOM, scan=scan, lasers=(2, 3), capture=LEGS))
    engine = stage.engine
    capture, unit, shape = engine.capture, engine.built.metres_per_engine_unit, engine.device.shape(stage.batch, 1)
    deadline = engine.device.launch_params(stage.batch, shape).time_gate
    own = scan == "confocal"
    legs = capture.sensor_legs.ravel() + (capture.laser_legs.ravel() if own else capture.laser_legs.min())
    expected = np.tile(engine.time_axis.end_opl - legs, shape.replicas)
    np.testing.assert_allclose(np.array(deadline.latest) * unit, expected, rtol=1e-6)
    points = capture.laser_grid.positions.reshape(-1, 3)
    for corner, bound in ((deadline.low, points.min(axis=0)), (deadline.high, points.max(axis=0))):
        where = np.tile(points, (shape.replicas, 1)) if own else bound[None]
        np.testing.assert_allclose(np.array(corner).T * unit, where, atol=1e-6)


def test_one_late_path_in_eight_carries_the_light_of_all() -> None:
    """It survives once; who is not late draws no number and carries what it did."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.time_gate import TimeGate, time_gate_roulette

    n = 2**16
    lane = dr.arange(mi.UInt32, n)
    point = mi.Point3f(0, 0, dr.select(lane % 2 == 0, mi.Float(2.0), 0.5))
    deadline = TimeGate(dr.full(mi.Float, 1.0, n), mi.Point3f(0), mi.Point3f(0), 1 / 8, mi.Float(0))
    generator = mi.PCG32(size=n)
    before = np.array(generator.state)
    alive, thinned, carried = time_gate_roulette(
        deadline, generator, mi.Bool(True), mi.Bool(False), mi.Float(0), point, mi.Bool(False), mi.Spectrum(3.0)
    )
    even = np.arange(n) % 2 == 0
    alive, thinned, value = np.array(alive), np.array(thinned), np.array(carried).reshape(-1)
    np.testing.assert_array_equal(thinned, even)
    np.testing.assert_array_equal(np.array(generator.state) != before, even)
    assert alive[~even].all()
    np.testing.assert_array_equal(value, np.where(even, 24, 3))
    # 5 sigma of 32768 draws of 1/8
    assert abs(alive[even].mean() - 1 / 8) < 5 * np.sqrt(7 / 64 / (n / 2))
    again, _, carried = time_gate_roulette(
        deadline, generator, mi.Bool(alive), mi.Bool(thinned), mi.Float(0), point, mi.Bool(False), carried
    )
    np.testing.assert_array_equal(np.array(again), alive)
    np.testing.assert_array_equal(np.array(carried).reshape(-1), value)


def share_in_time(has_time_gate: bool) -> float:
    """Return the share of a round's contributions that could reach some sensor point within the window."""
    stage = Stage.of(scene(ROOM, engine="virtual_lights"))
    from nlosrender.engine.virtual_lights.vpls import rounds as further_bounces

    engine = with_options(stage.engine, has_time_gate=has_time_gate)
    engine.further.shares_subpaths = False  # else all are kept, and not of the same light
    shares, vpl_contributions = [], further_bounces.vpl_contributions

    def recorded(plan: Any, params: Any, vpls: Any, *rest: Any) -> Any:
        contributions = vpl_contributions(plan, params, vpls, *rest)
        heights = (
            vpls.positions[contributions.vpls][:, 2] * engine.built.metres_per_engine_unit
        )  # over the wall, with its sensor points
        shares.append((np.array(contributions.delays) + heights / 0.1 < SHORT).mean())
        return contributions

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(further_bounces, "vpl_contributions", recorded)
        engine.further.accumulate(stage.batch, engine.further.histogram(stage.batch, 2), 0)
    return float(shares[0])


def test_walks_are_spent_on_light_in_the_window() -> None:
    """Late contributions are an eighth of what they would be beside the others: most of a round come in time."""
    # a share s becomes s / (s + (1 - s) / 8): 0.72 of 0.24
    assert share_in_time(True) > 0.65 > 2 * share_in_time(False)


def test_sites_that_only_late_light_reaches_are_few() -> None:
    """Of the far side of a deep room there are eight times fewer beside the others, and they stand for its area."""
    stage = Stage.of(scene(room([2.0, 1.6, 2.0]), engine="virtual_lights"))
    unit, ratios, areas = stage.engine.built.metres_per_engine_unit, [], []
    for has_time_gate in (False, True):
        sampler = with_options(stage.engine, has_time_gate=has_time_gate).further.sampler
        vpls = sampler.sample(2**15, np.random.default_rng(5))
        heights = vpls.positions[:, 2] * unit
        far = heights > 1.999
        assert stage.engine.device.capture_gate.is_past(vpls.positions[far]).all()
        ratios.append(far.mean() / (heights < 0.5).mean())
        areas.append(vpls.areas[far].sum() * unit**2)
    # 5 sigma of the fewest VPLs; they are stratified, which makes it less
    fewest = ratios[1] * 2**14
    assert ratios[1] == pytest.approx(ratios[0] / 8, rel=5 / fewest**0.5)
    np.testing.assert_allclose(areas, 2.0 * 1.6, rtol=5 / fewest**0.5)


def test_what_is_thinned_out_is_said() -> None:
    """The plan names it where paths or subpaths may end after the window, and only there."""
    from nlosrender.engine.preflight.omitted_work import omitted_work

    what = "most paths on which light can only arrive after the time window"
    for keys, expected in (
        ({}, True),
        ({"engine": "virtual_lights"}, True),
        ({"russian_roulette": False}, False),
        ({"max_bounces": 3}, False),  # a path ends at the first vertex that a laser sees
        ({"max_bounces": 4, "n_bins": LONG}, False),
    ):
        config = scene(*OPEN, **keys)
        engine = Stage.of(config).engine
        named = {item.what for item in omitted_work(engine, scene_is_colored=configured(config).scene.is_colored)}
        assert (what in named) == expected, keys
