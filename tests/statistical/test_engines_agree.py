"""The virtual lights agree with the path engine, bounce by bounce, in scenes made to break them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.engine_sums import assert_alike, energies, finer, group_sums
from support.rendering import flat_wall, render
from support.varied_scenes import SIDE, SLANTED, TRAPS, Item, Stage, ball

from nlosrender.engine.backend.start import start_backend

SEEDS = range(1, 17)
OTHER_SEEDS = range(101, 117)  # the path engine's: it also traces some further bounces of the virtual lights
QUICK_SEEDS, OTHER_QUICK_SEEDS = range(1, 9), range(101, 109)


def compare(
    name: str, folder: Path, *, seeds: Any, other_seeds: Any, rounds: int, spp: int, target: float = 0.01
) -> None:
    """Render a scene with both engines and compare."""
    start_backend("llvm")
    from nlosrender.engine.interface import Budget

    stage: Stage = TRAPS[name].stage(folder)
    assert stage.engine.name == "virtual_lights"
    budget = finer(stage.engine, target)
    budget = replace(budget, rounds=rounds if budget.rounds else None, spp=spp if budget.spp else None)
    lights = stage.repeated(budget, seeds)
    reference = TRAPS[name].stage(folder, "path", spp=spp, target_error=None)
    paths = reference.repeated(Budget(spp=spp), other_seeds)
    assert not lights.means[:, :, stage.bounces.slot(2)].any() or not stage.bounces.split
    for slot in range(1 if stage.bounces.split else 0, stage.bounces.n_slots):
        is_third = slot == stage.bounces.slot(3)
        if lights.means[:, :, slot].any() or paths.means[:, :, slot].any():
            assert_alike(group_sums(lights, paths, slot, is_third), f"{name}, bounce index {slot}")
    assert_alike(energies(lights, paths), f"{name}, energies")


@pytest.mark.parametrize("name", [name for name, trap in TRAPS.items() if trap.is_quick])
def test_engines_agree_in_a_few_seconds(name: str, tmp_path: Path) -> None:
    """Bin groups, rows and energies of every bounce agree, with little work."""
    compare(name, tmp_path, seeds=QUICK_SEEDS, other_seeds=OTHER_QUICK_SEEDS, rounds=2, spp=4096, target=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAPS)
def test_engines_agree(name: str, tmp_path: Path) -> None:
    """Bin groups, rows and energies of every bounce agree; energies to 0.3 % where the paths' noise is less."""
    compare(name, tmp_path, seeds=SEEDS, other_seeds=OTHER_SEEDS, rounds=8, spp=100_000)


def cut_scene(scan: str, max_bounces: int) -> Item:
    """Return a small capture with shadows and interreflections; calibrated by a pilot to a coarse target."""
    return flat_wall(
        SLANTED,
        SIDE,
        ball((0.1, 0.2, 0.35), 0.1),
        scan=scan,
        sensors=(3, 2),
        bins=(0.2, 0.1, 40),
        engine="virtual_lights",
        max_bounces=max_bounces,
        spp=None,
        target_error=0.3,
    )


@pytest.mark.parametrize(
    ("scan", "max_bounces"),
    [
        pytest.param("single", 5, marks=pytest.mark.slow),
        ("confocal", 5),
        ("exhaustive", 5),
        pytest.param("single", 3, marks=pytest.mark.slow),
        pytest.param("confocal", 3, marks=pytest.mark.slow),
        pytest.param("exhaustive", 3, marks=pytest.mark.slow),
    ],
)
def test_how_a_capture_is_cut_changes_no_bit(scan: str, max_bounces: int) -> None:
    """One batch, or many: patches, VPLs and rays are those of the capture, not of the batch."""
    whole = render(cut_scene(scan, max_bounces), batch_bytes=10**9)
    pieces = render(cut_scene(scan, max_bounces), batch_bytes=whole.plan.bytes_per_batch // 2)
    assert len(whole.plan.batches) == 1 < len(pieces.plan.batches)
    assert whole.mean.any()
    for name in ("mean", "outside"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)


@pytest.mark.parametrize("max_bounces", [pytest.param(3, marks=pytest.mark.slow), 5])
def test_a_part_of_the_lasers_and_sensors_has_the_bits_of_the_whole(max_bounces: int) -> None:
    """A shard of an exhaustive capture: columns 1 to 2 of the sensors, rows 1 to 2 and column 1 of the lasers."""
    stage = Stage.of(cut_scene("exhaustive", max_bounces))
    from nlosrender.engine.interface import Budget

    engine, batch = stage.engine, stage.batch
    part = replace(batch, sensors=replace(batch.sensors, x0=1), lasers=replace(batch.lasers, y0=1, x0=1))
    budget = engine.calibrate(Budget(target_error=0.3))
    whole, small = (stage.seeded(0).render(tile, budget) for tile in (batch, part))
    lasers, sensors = part.lasers.flat_indices(2), part.sensors.flat_indices(3)
    assert (len(lasers), len(sensors)) == (2, 4)
    np.testing.assert_array_equal(small.mean, whole.mean[:, :, lasers][:, :, :, sensors])
    np.testing.assert_array_equal(small.outside, whole.outside[:, :, lasers][:, :, :, sensors])
    assert small.mean.any()
