"""Patches are lit once for all batches that send them the same light, and for no others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.rendering import flat_wall
from support.varied_scenes import Stage

from nlosrender.capture.plan import Batch, Tile
from nlosrender.engine.backend.start import start_backend

DIFFUSE = {"type": "diffuse", "reflectance": 0.6}
PLATE = {
    "type": "rectangle",
    "width": 0.8,
    "height": 0.6,
    "center": [-0.3, 0, 1],
    "normal": [0, 0, -1],
    "bsdf": DIFFUSE,
}
BACK = PLATE | {"center": [-0.3, 0, 1]}
SCREEN = PLATE | {"width": 0.2, "height": 0.2, "center": [0.1, 0, 0.5]}
GRIDS = {"sensors": (6, 4), "lasers": (3, 2)}
LEFT, RIGHT = Tile(0, 4, 0, 3), Tile(0, 4, 3, 6)
ONE = Tile(0, 1, 0, 1)
# of each scan: batches of a capture
BATCHES = {
    "single": (Batch(LEFT, ONE), Batch(RIGHT, ONE)),
    "confocal": (Batch(LEFT, LEFT), Batch(RIGHT, RIGHT)),
    "exhaustive": (Batch(LEFT, Tile(0, 2, 0, 1)), Batch(LEFT, Tile(0, 2, 1, 3)), Batch(RIGHT, Tile(0, 2, 0, 3))),
}


def gather_of(scan: str, **tuning: Any) -> Any:
    """Return the gather of a new engine before a plate and a screen that hides a part of it."""
    stage = Stage.of(flat_wall(BACK, SCREEN, scan=scan, engine="virtual_lights", spp=None, **GRIDS))
    return stage.tuned(**tuning).engine.third


@pytest.fixture
def lighting(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the list that the number of patches is added to whenever some are lit."""
    start_backend("llvm")
    from nlosrender.engine.virtual_lights import third_bounce

    lit: list[int] = []
    light_patches: Callable[..., Any] = third_bounce.light_patches

    def counted(*arguments: Any) -> Any:
        lit_patches = light_patches(*arguments)
        lit.append(len(np.array(lit_patches.is_lit)))
        return lit_patches

    monkeypatch.setattr(third_bounce, "light_patches", counted)
    return lit


@pytest.mark.parametrize("scan", BATCHES)
def test_a_batch_after_others_says_what_it_says_alone(scan: str) -> None:
    """Bit for bit, whatever an engine has gathered before: shards of a capture are engines of their own."""
    one = gather_of(scan)
    for batch in BATCHES[scan]:
        for patch_scale in (0.8, 0.5):
            values = one.gather(batch, patch_scale).values
            np.testing.assert_array_equal(values, gather_of(scan).gather(batch, patch_scale).values)
            assert values.any()


@pytest.mark.parametrize("scan", ["single", "confocal"])
def test_one_laser_lights_each_resolution_once(scan: str, lighting: list[int]) -> None:
    """Two resolutions are gathered of every batch, the pilot has gathered some before."""
    from nlosrender.engine.launch.pilot_points import pilot_of

    third = gather_of(scan)
    for batch in (pilot_of(third.device.capture), *BATCHES[scan]):
        for patch_scale in (0.8, 0.5):
            third.gather(batch, patch_scale)
    assert len(lighting) == len(set(lighting)) == 2


def test_other_lasers_light_patches_anew(lighting: list[int]) -> None:
    """What patches send on is the light of the batch's own lasers."""
    third = gather_of("exhaustive")
    for batch in BATCHES["exhaustive"]:
        third.gather(batch, 0.5)
    assert len(lighting) == len(BATCHES["exhaustive"])


def test_many_patches_are_not_kept(lighting: list[int]) -> None:
    """They would take more memory than the plan counts."""
    third = gather_of("single", max_kept_patches=10)
    for batch in BATCHES["single"]:
        third.gather(batch, 0.5)
    assert len(lighting) == 2
    assert min(lighting) > 10


def test_what_was_lit_for_a_few_points_is_cleared_for_many() -> None:
    """A pilot traces all rays; the capture after it leaves out those that it would leave out by itself."""
    start_backend("llvm")
    from nlosrender.engine.launch.pilot_points import pilot_of

    third, batch = gather_of("single", min_mask_sensors=20), BATCHES["single"][0]
    pilot = pilot_of(third.device.capture, 3)
    third.gather(pilot, 0.5)
    assert not third.shadow_ray_targets(pilot, 0.5).mask.any()
    known = third.shadow_ray_targets(batch, 0.5).mask
    np.testing.assert_array_equal(known, gather_of("single", min_mask_sensors=20).shadow_ray_targets(batch, 0.5).mask)
    assert known.any()
