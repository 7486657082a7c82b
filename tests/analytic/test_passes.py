"""A work item that is stopped between passes, and resumed by another process, has the bits of an undisturbed one."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.rendering import configured, flat_wall
from support.views import view_config

from nlosrender.capture.plan import Batch, WorkItem
from nlosrender.capture.tile import Tile
from nlosrender.engine.backend.start import start_backend
from nlosrender.engine.launch.passes import Passes, SavedStages, Snapshot
from nlosrender.files.partial.work_item_state import ItemState
from nlosrender.rendering import stages
from nlosrender.rendering.work_items import render_item

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 1.0], "normal": [0, 0, -1]}
BEFORE = PLATE | {"width": 0.3, "height": 0.4, "center": [0.3, 0.1, 0.6], "normal": [0.2, 0.1, -1]}
GLOSSY = BEFORE | {"bsdf": {"type": "roughconductor", "alpha": 0.3}}
LIGHTS = {"engine": "virtual_lights", "spp": None, "target_error": 0.05}
GRID = {"nx": 5, "ny": 3, "width": 1.5, "height": 1.2}
SAME = {"laser_grid": GRID, "sensor_grid": GRID}
SEEN = {"type": "rectangle", "width": 1, "height": 1, "center": [0, 0, 0], "normal": [0, 0, 1]}
SLOW = (
    "confocal paths in any direction",
    "paths to an error",
    "confocal third bounce",
    "confocal walks",
    "lights and paths",
    "half of the pairs",
)
STOPS = 2
LAMP = {"type": "point", "position": [0, 1, 3], "intensity": 1}
SCENES: dict[str, Any] = {
    "paths": flat_wall(PLATE, BEFORE, max_bounces=5, spp=500),
    "confocal paths in any direction": flat_wall(PLATE, scan="confocal", max_bounces=4, hidden_geometry_sampling=False),
    "paths to an error": flat_wall(PLATE, max_bounces=4, spp=None, target_error=0.05),
    "third bounce": flat_wall(PLATE, BEFORE, **LIGHTS),
    "confocal third bounce": flat_wall(PLATE, BEFORE, scan="confocal", **LIGHTS),
    "walks": flat_wall(PLATE, BEFORE, scan="exhaustive", **LIGHTS | {"max_bounces": 5, "target_error": 0.3}),
    "confocal walks": flat_wall(PLATE, BEFORE, scan="confocal", **LIGHTS | {"max_bounces": 5}),
    "lights and paths": flat_wall(PLATE, GLOSSY, **LIGHTS | {"max_bounces": 4, "target_error": 0.5}),
    "half of the pairs": flat_wall(
        PLATE, scan="exhaustive", capture={"laser_grid": GRID, "sensor_grid": GRID}, **LIGHTS
    ),
    "two batches": flat_wall(PLATE, max_bounces=4, spp=200),
    "line of sight": view_config(SEEN, emitters=[LAMP]),
}


class StoppedError(Exception):
    """The render was ended between two passes."""


def stopping(path: Path, tag: str) -> Callable[[Callable[[], SavedStages]], None]:
    """Return what keeps the state and ends the render after the next pass."""

    def look(take: Callable[[], SavedStages]) -> None:
        ItemState(path, tag).write(take())
        raise StoppedError

    return look


def prepared(scene: dict[str, Any]) -> Callable[[Passes], Any]:
    """Return what renders all of a capture as one work item, every time as a process that has just been started."""
    config = configured(scene)
    backend = start_backend("llvm", colored=config.is_colored)
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.launch.schedule import ScheduleTuning

    # passes of a few paths, patches and VPLs
    short = ScheduleTuning(math.inf, max_first_pairs=2**9, first_gather_pairs=2**6, first_vpl_pairs=2**17)

    def render(passes: Passes) -> Any:
        plan, engine, _ = stages.set_up_engine(config, backend, changes={"schedule": short})
        budget = stages.calibrated_budget(config, engine)
        assert isinstance(budget, Budget)
        (item,) = plan.work_items
        if scene is SCENES["two batches"]:
            upper, lower = Tile(0, 1, 0, 5), Tile(1, 3, 0, 5)
            item = WorkItem(item.sensors, item.lasers, (Batch(upper, item.lasers), Batch(lower, item.lasers)))
        return render_item(engine, item, budget, passes)

    return render


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in SCENES]
)
def test_going_on_from_any_pass_changes_no_bit(name: str, tmp_path: Path) -> None:
    """The state that is kept is all that a render has: the sums, the random numbers, and what has been found out."""
    render, path = prepared(SCENES[name]), tmp_path / "state"
    whole = render(Passes())
    for _ in range(STOPS):
        with pytest.raises(StoppedError):
            render(Passes(look=stopping(path, name), saved=ItemState(path, name).read()))
    result = render(Passes(saved=ItemState(path, name).read()))
    assert whole.samples == result.samples
    for values in ("mean", "variance", "outside"):
        np.testing.assert_array_equal(getattr(result, values), getattr(whole, values))
    assert whole.mean.any()


def test_what_is_damaged_or_of_another_render_means_nothing(tmp_path: Path) -> None:
    """A flipped bit anywhere, a cut at any byte, a link, another tag: there is no state."""
    path, kept = tmp_path / "state", {"a": Snapshot({"sums": np.arange(5.0)}, {"done": 3})}
    ItemState(path, "tag").write(kept)
    content = path.read_bytes()
    whole = ItemState(path, "tag").read()
    assert whole is not None
    assert whole["a"].numbers == {"done": 3}
    np.testing.assert_array_equal(whole["a"].arrays["sums"], np.arange(5.0))
    assert ItemState(path, "other").read() is None
    for place in range(len(content)):
        path.write_bytes(content[:place])
        assert ItemState(path, "tag").read() is None, place
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        assert ItemState(path, "tag").read() is None, place
    path.write_bytes(content)
    (tmp_path / "link").symlink_to(path)
    assert ItemState(tmp_path / "link", "tag").read() is None


def test_a_state_is_not_written_through_a_link(tmp_path: Path) -> None:
    """What a link of that name points to is left as it is."""
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "state.new").symlink_to(tmp_path / "precious")
    ItemState(tmp_path / "state", "tag").write({"a": Snapshot()})
    assert (tmp_path / "precious").read_text() == "precious"
    assert ItemState(tmp_path / "state", "tag").read() is not None
