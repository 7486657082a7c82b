"""VPLs that share their subpaths (docs/virtual-lights.md, 7.7): the laws of captures with a single laser point."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.engine_sums import assert_alike, energies, group_sums
from support.rendering import flat_wall
from support.varied_scenes import GREY_WALL, Item, Stage, ball, room

from nlosrender.engine.backend.start import start_backend

SEEDS, OTHER_SEEDS = range(1, 9), range(101, 109)


def closed_room(*items: Item, max_bounces: int | None = 6, engine: str = "virtual_lights") -> Stage:
    """Return a room that closes with the wall, before 8 x 8 points: VPLs need as many to share subpaths."""
    config = flat_wall(
        room((2.0, 1.6, 1.3), 0.6),
        *items,
        sensors=(8, 8),
        bins=(0.0, 0.1, 60),
        wall=GREY_WALL,
        engine=engine,
        max_bounces=max_bounces,
        **({"spp": 2048} if engine == "path" else {"spp": None, "target_error": 0.1}),
    )
    return Stage.of(config)


@pytest.fixture(scope="module", params=["a ball inside", pytest.param("empty", marks=pytest.mark.slow)])
def renders(request: pytest.FixtureRequest) -> tuple[Stage, Any, Any]:
    """Both engines' renders of a room, whose VPLs see all of each other or not."""
    items = [] if request.param == "empty" else [ball((-0.3, -0.2, 0.6), 0.35, 0.9)]
    stage, reference = closed_room(*items), closed_room(*items, engine="path")
    from nlosrender.engine.interface import Budget

    assert stage.engine.further.shares_subpaths
    assert (stage.engine.further.masks is None) == (not items)
    lights = stage.repeated(Budget(patch_scale=0.5, rounds=2), SEEDS)
    return stage, lights, reference.repeated(Budget(spp=2048), OTHER_SEEDS)


def test_bounces_agree_with_paths(renders: tuple[Stage, Any, Any]) -> None:
    """Bin groups, rows and energies of every bounce above the third."""
    stage, lights, paths = renders
    for bounce in range(4, 7):
        slot = stage.bounces.slot(bounce)
        assert_alike(group_sums(lights, paths, slot, is_third=False), f"bounce {bounce}")
    assert_alike(energies(lights, paths), "energies")


def test_stated_errors_are_those_of_the_seeds(renders: tuple[Stage, Any, Any]) -> None:
    """The variance stated for the sums of squares over the capture is the one between seeds, within 15 %."""
    stage, lights, _ = renders
    for bounce in (4, 5):
        values, stated = (part[:, :, stage.bounces.slot(bounce)] for part in (lights.means, lights.variances))
        assert stated.sum(axis=tuple(range(1, stated.ndim))).mean() == pytest.approx(
            values.var(axis=0, ddof=1).sum(), rel=0.15
        )


def small_render(stage: Stage, batch: Any) -> Any:
    """Render a batch in one small round."""
    from nlosrender.engine.interface import Budget

    return stage.seeded(7).render(batch, Budget(patch_scale=1.0, rounds=1))


def test_a_capture_cut_into_batches_is_the_same() -> None:
    """Each batch has the same VPLs and subpaths, and adds them in the same order: not a bit differs."""
    stage = closed_room(ball((-0.3, -0.2, 0.6), 0.35, 0.9))
    whole = small_render(stage, stage.batch).mean
    sensors = stage.batch.sensors
    halves = [replace(sensors, y1=3), replace(sensors, y0=3)]
    parts = [small_render(stage, replace(stage.batch, sensors=half)).mean for half in halves]
    further = stage.bounces.slot(4)
    np.testing.assert_array_equal(np.concatenate(parts, axis=3)[:, further:], whole[:, further:])


def test_a_round_goes_on_where_it_stopped() -> None:
    """A round that is ended between two chunks of VPLs, and resumed with the sums it had, gets the same bits."""
    stage = closed_room().tuned(groups_at_once=1)
    further = stage.engine.further
    further.tuning = stage.engine.tessellator.tuning
    whole, resumed = (further.histogram(stage.batch, 2) for _ in range(2))

    def save(done: int) -> None:
        if done == 64:
            resumed.sums = type(whole.sums)(whole.sums)

    further.accumulate(stage.batch, whole, 0, save, units=1)
    further.accumulate(stage.batch, resumed, 0, skipped=64, units=1)
    np.testing.assert_array_equal(resumed.sums.numpy(), whole.sums.numpy())
    assert whole.sums.numpy().any()


@pytest.mark.parametrize("bins_per_step", [2, 5, 8])
def test_longer_time_steps_keep_all_light(bins_per_step: int) -> None:
    """The same VPLs send the same light in steps of one and of several bins: but for what float32 sums round.

    Of every sensor point and bounce: the window (60 bins, no multiple of 8) and what lies outside. Of all together:
    twelfths of the window, into and out of which roundings to half a step move a fourth of a step of light at most.
    """
    stage = closed_room(ball((-0.3, -0.2, 0.6), 0.35, 0.9))
    further, found = stage.engine.further, []
    for bins in (1, bins_per_step):
        histogram = further.histogram(stage.batch, 2)
        further.accumulate(stage.batch, histogram, 0, bins_per_step=bins)
        shape = histogram.shape
        lanes = histogram.sums.numpy().reshape(shape.lanes, -1)[:, : shape.rows_per_lane * shape.row]
        found.append(lanes.reshape(shape.lanes, -1, shape.row))
    one, several = found
    assert several.min() >= 0
    np.testing.assert_allclose(several.sum(axis=2), one.sum(axis=2), rtol=1e-5)
    parts = [rows[..., :-1].sum(axis=(0, 1)).reshape(12, 5).sum(axis=1) for rows in found]
    brightest = one[..., :-1].sum(axis=(0, 1)).max()
    assert (np.abs(parts[1] - parts[0]) <= bins_per_step / 4 * brightest).all()


def test_sharing_does_not_move_light() -> None:
    """With and without it VPLs bring the same light to every part of the window and behind it."""
    stage = closed_room(max_bounces=None)
    start_backend("llvm")
    from nlosrender.engine.virtual_lights.vpls.rounds import VplBounces

    engine, sums = stage.engine, []
    for may_share in (False, True):
        further = VplBounces(engine.device, engine.tessellator, engine.further.masks, True, may_share)
        histograms = [further.histogram(stage.batch, 2) for _ in range(8)]
        for number, histogram in enumerate(histograms):
            further.accumulate(stage.batch, histogram, number)
        shape = histograms[0].shape
        lanes = np.stack([one.sums.numpy().reshape(shape.lanes, -1) for one in histograms])
        rows = lanes[..., : shape.rows_per_lane * shape.row].reshape(16, shape.sensors, -1, shape.row)
        # of all sensor points and bounces: twelfths of the window, and what lies outside
        parts = rows[..., :-1].reshape(16, shape.sensors, -1, 12, 5).sum(axis=(1, 2, 4))
        sums.append(np.concatenate([parts, rows[..., -1].sum(axis=(1, 2))[:, None]], axis=1))
    (one, other), errors = (
        (values.mean(axis=0) for values in sums),
        [values.var(axis=0, ddof=1) / 16 for values in sums],
    )
    # 5 sigma; 1 / 4 of a bin of light may be in the next part, where light begins
    assert (np.abs(one - other) <= 5 * np.sqrt(sum(errors)) + 1e-3 * one.max()).all()
