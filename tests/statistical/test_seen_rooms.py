"""Virtual lights where a camera sees several surfaces: they agree with paths bounce by bounce, and with walls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.agreement import relative_l2
from support.engine_sums import assert_alike, energies, group_sums
from support.rendering import flat_wall, render
from support.varied_scenes import Stage

FLOOR = {"type": "rectangle", "width": 4.0, "height": 2.0, "center": [-1, 0, 0], "normal": [0, 0, 1]}
SIDE = {"type": "rectangle", "width": 2.0, "height": 4.0, "center": [1, 0, 2], "normal": [-1, 0, 0], "up": [0, 0, 1]}
BACK = {"type": "rectangle", "width": 4.0, "height": 3.0, "center": [-1, 1, 1.5], "normal": [0, -1, 0], "up": [0, 0, 1]}
HIDDEN = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [-0.8, 0.1, 1.6], "normal": [0.3, 0, -1]}
BALL = {"type": "sphere", "center": [0.2, 0.3, 0.35], "radius": 0.3}
# It looks at the floor, which lies in z = 0 of the engine's frame then, as a planar wall does.
CAMERA = {"position": [-2, -0.6, 2], "look_at": [0.2, 0.2, 0], "up": [0, 0, 1], "fov_deg": 45, "width": 4, "height": 3}
AIMS = {
    "single": {"laser_target": [0, -0.2, 0]},
    "confocal": {},
    "exhaustive": {"laser_targets": [[0, -0.2, 0], [1, 0.3, 0.8]]},
}
SEEDS, OTHER_SEEDS, ROUNDS, SPP = range(1, 9), range(101, 109), 4, 30_000


def seen(*items: tuple[dict[str, Any], float], scan: str = "single", two_sided: bool = False, **changes: Any) -> Any:
    """Return the capture of what ``CAMERA`` sees of items with reflectances; legs counted, bins of 0.1 m."""
    matt = [{"type": "diffuse", "reflectance": reflectance} for _, reflectance in items]
    bsdfs = [{"type": "twosided", "bsdf": bsdf} if two_sided else bsdf for bsdf in matt]
    hidden = [{**item, "bsdf": bsdf} for (item, _), bsdf in zip(items, bsdfs, strict=True)]
    keys = {"engine": "virtual_lights", "max_bounces": 4, "spp": None, "target_error": 0.05, **changes}
    config = flat_wall(*hidden, scan=scan, bins=(0.0, 0.1, 160), **keys)
    del config["scene"]["relay_wall"]
    for key in ("sensor_grid", "laser_grid", "laser_point"):
        config["capture"].pop(key, None)
    config["capture"] |= {"camera": CAMERA, "laser_position": [-2, 0.1, 2.1], **AIMS[scan]}
    return config | {"capture": config["capture"] | {"account_first_and_last_bounces": True}}


CORNER = ((FLOOR, 0.7), (SIDE, 0.5))
ROOM = (*CORNER, (BACK, 0.6), (HIDDEN, 0.8))


@pytest.mark.parametrize(
    ("items", "changes"),
    [
        (CORNER, {}),
        ((*CORNER, (BALL, 0.6)), {}),  # some points lie on a curved surface
        pytest.param(ROOM, {"two_sided": True}, marks=pytest.mark.slow),
        pytest.param(ROOM, {}, marks=pytest.mark.slow),
        pytest.param((*ROOM, (BALL, 0.6)), {"scan": "exhaustive"}, marks=pytest.mark.slow),
        pytest.param((*ROOM, (BALL, 0.6)), {"scan": "confocal"}, marks=pytest.mark.slow),
    ],
)
def test_virtual_lights_agree_with_paths(items: Any, changes: dict[str, Any]) -> None:
    """Bin groups, rows and energies of every bounce: points of an edge see the other surface close by."""
    lights, paths = Stage.of(seen(*items, **changes)), Stage.of(seen(*items, **{**changes, "engine": "path"}))
    assert lights.engine.name == "virtual_lights"
    from nlosrender.engine.interface import Budget

    found = lights.repeated(Budget(patch_scale=0.35, rounds=ROUNDS), SEEDS)
    expected = paths.repeated(Budget(spp=SPP), OTHER_SEEDS)
    np.testing.assert_array_equal(found.means[:, :, 0], expected.means[:, :, 0])  # exact, and not gathered again
    for slot in range(1, lights.bounces.n_slots):
        assert expected.means[:, :, slot].any()
        assert_alike(group_sums(found, expected, slot, is_third=slot == 1), f"bounce index {slot}")
    assert_alike(energies(found, expected), "energies")


def test_a_surface_without_wall_is_gathered_as_a_wall_is() -> None:
    """H of points that all lie on one plane is the same with and without relay wall, within the stated errors."""
    behind = {"type": "sphere", "center": [0, 0, -0.5], "radius": 0.1}
    camera = {"camera": {**CAMERA, "look_at": [-0.6, 0, 0], "fov_deg": 30}}
    with_wall, without = (
        seen((FLOOR, 0.7), (HIDDEN, 0.8), *more, max_bounces=5, target_error=0.01) for more in ((), ((behind, 0.5),))
    )
    results = []
    for config, before in ((with_wall, "before a planar wall"), (without, "that a camera sees")):
        config["capture"] |= camera
        assert before in Stage.of(config | {"render": config["render"] | {"engine": "auto"}}).engine.reason
        results.append(render(config))
    errors = [result.error_estimate for result in results]
    assert relative_l2(results[1].total - results[0].total, results[0].total) < 2 * np.hypot(*errors)
    assert not results[1].bounce(2).any()  # nor does the plane see itself


def test_light_between_an_edge_and_a_laser_spot_beside_it_is_told() -> None:
    """Half of the light of a spot goes to the surface beside it: the third bounce is right, what is missed is said."""
    config = seen(*CORNER)
    config["capture"] |= {"laser_target": [0.999, 0, 0.0005]}
    engine = Stage.of(config).engine
    assert any("goes to and fro" in text for text in engine.warnings())
    assert not any("goes to and fro" in text for text in Stage.of(seen(*CORNER)).engine.warnings())


def test_auto_takes_virtual_lights_and_leaves_mirrors_to_paths() -> None:
    """Each says why."""
    config = seen(*CORNER, engine="auto")
    assert Stage.of(config).engine.reason == "Lambertian surfaces that a camera sees"
    config["scene"]["hidden_geometry"][1]["bsdf"] = {"type": "conductor"}
    assert "a surface has a mirror lobe" in Stage.of(config).engine.reason
