"""What each kind of skipped work saves: CPU seconds with and without it, the results compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from nlosrender.bench.runs import Float64, LoadedScene, Timer, load, prepared, virtual_lights_of
from nlosrender.bench.scenes import WALL_SIZE, BenchScene, closed_room, many_lasers
from nlosrender.engine.interface import Budget

if TYPE_CHECKING:
    from nlosrender.capture.plan import Plan
    from nlosrender.engine.interface import Engine
    from nlosrender.engine.path.engine import PathEngine
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

ROUNDS = 3
GATHER_TARGET = 0.01
PATHS = 1024  # per sensor point
SHORT_WINDOW_BINS = 100  # of 3 cm: less than two ways to the far side of the room and back
ROOM_TARGET = 0.03
ROOM_POINTS = 64  # sensor points along each side: enough for regions
LASERS = 12  # along each side, and as many sensor points
PATCH_SCALE = 0.3
NEVER = 10**12  # sensor points that a mask would have to serve
MIXTURE = 0.5  # of BSDF and hidden geometry sampling at the wall, where one of them suffices


@dataclass(frozen=True)
class Saving:
    """One skip on one scene. Both ways run in turns; the fastest of several rounds counts."""

    what: str
    scene: str
    seconds: float  # CPU seconds of all threads, with the skip
    seconds_without: float
    difference: float  # relative L2 between the two results; of noisy ones it is the noise of both

    def report(self) -> dict[str, Any]:
        """Return all as plain values."""
        return {**vars(self), "saved": 1 - self.seconds / self.seconds_without}


def measure_skips(scenes: Sequence[BenchScene]) -> list[Saving]:
    """Measure every skip on the scenes where it applies: third-bounce scenes, and a closed room.

    Raises
    ------
    ConfigError
        A scene's mesh cannot be read.
    RenderError
        A render failed.
    """
    savings: list[Saving] = []
    for scene in scenes:
        savings += of_gather(load(scene))
        savings += of_paths(load(scene))
    room = closed_room(16)
    savings += of_paths(load(room))
    short = {**room.sections["time_axis"], "n_bins": SHORT_WINDOW_BINS}
    savings += _of_late_light(load(replace(room, sections={**room.sections, "time_axis": short})))
    savings += _of_regions(load(closed_room(ROOM_POINTS)))
    savings += _of_reciprocity(load(many_lasers(LASERS, LASERS, WALL_SIZE)))
    return savings


def of_gather(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what visibility masks save, or leaving out all shadow rays where nothing can occlude."""
    from nlosrender.engine.virtual_lights.visibility.masks import VisibilityMasks

    plan, engine = virtual_lights_of(loaded)
    third, settings = engine.third, engine.settings
    patch_scale = engine.calibrate(Budget(target_error=GATHER_TARGET)).patch_scale or 1.0
    if not settings.needs_visibility:
        what, settings = "rays where nothing can lie between", replace(settings, needs_visibility=True)
    elif third.shadow_ray_targets(plan.batches[0], patch_scale).mask.any():
        what = "rays that nothing can stop"
    else:
        return
    tracing = _third_bounce(third, settings=settings)
    tracing.masks = VisibilityMasks(engine.built, replace(third.masks.tuning, min_mask_sensors=NEVER))

    def gather(one: ThirdBounce) -> Float64:
        one.forget()  # visibility is a part of lighting, too
        return np.concatenate([one.gather(batch, patch_scale).values for batch in plan.batches], axis=3)

    yield _saving(what, loaded, partial(gather, third), partial(gather, tracing))


def _of_regions(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what patches of their own close to the wall save the regions of the sensor grid."""
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator

    plan, engine = virtual_lights_of(loaded)
    bin_width = engine.tessellator.size_field.bin_width
    undivided = Tessellator(engine.built, engine.capture, bin_width, may_divide=False)
    thirds = engine.third, _third_bounce(engine.third, tessellator=undivided)
    ways = [lambda of=of: of.gather(plan.batches[0], PATCH_SCALE).values for of in thirds]
    yield _saving("patches of other regions of the wall", loaded, *ways)


def _of_reciprocity(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what taking half of an exhaustive capture from the other half saves."""
    plan, engine = virtual_lights_of(loaded)
    thirds = engine.third, _third_bounce(engine.third, is_reciprocal=False)
    ways = [lambda of=of: of.gather(plan.batches[0], PATCH_SCALE).values for of in thirds]
    yield _saving("pairs of points that reciprocity gives", loaded, *ways)


def _third_bounce(third: ThirdBounce, **changes: Any) -> ThirdBounce:
    """Return a gather of the third bounce that differs from ``third`` in some arguments."""
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

    names = ("device", "tessellator", "settings", "lanes", "is_reciprocal")
    return ThirdBounce(**{name: getattr(third, name) for name in names} | changes)


def of_paths(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what the path engine leaves out: rays nothing can stop, the technique that is not needed."""

    def engine_with(**changes: Any) -> tuple[Plan, PathEngine]:
        plan, engine = prepared(loaded, {"engine": "path", "spp": PATHS}, changes)
        return plan, cast("PathEngine", engine)

    def render(other: PathEngine) -> Float64:
        return np.concatenate([other.render(batch, Budget(spp=PATHS)).mean for batch in plan.batches], axis=3)

    plan, usual = engine_with()
    if not usual.settings.needs_visibility:
        _, tracing = engine_with()
        tracing.settings = replace(usual.settings, needs_visibility=True)
        what = "rays of paths where nothing can lie between"
        yield _saving(what, loaded, partial(render, usual), partial(render, tracing))
    _, by_bsdf = engine_with(hidden_geometry_sampling=False)
    if by_bsdf.hidden_aabb is not None:
        _, tracing = engine_with(hidden_geometry_sampling=False)
        tracing.hidden_aabb = None
        what = "rays of paths that pass the hidden geometry by (BSDF sampling)"
        yield _saving(what, loaded, partial(render, by_bsdf), partial(render, tracing))
    if usual.p_hidden_sampling in (0.0, 1.0):
        kept = "hidden geometry" if usual.p_hidden_sampling else "BSDF"
        _, mixed = engine_with(p_hidden_sampling=MIXTURE)
        what = f"MIS where {kept} sampling suffices"
        yield _saving(what, loaded, partial(render, usual), partial(render, mixed))


def _of_late_light(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what the time gate saves: of as many paths, and of VPL subpaths to the same error."""

    def render(one: Engine) -> Float64:
        return np.concatenate([one.render(batch, one.calibrate(budget)).mean for batch in plan.batches], axis=3)

    for name, what in (("path", "most paths"), ("virtual_lights", "most subpaths")):
        plan, gated = prepared(loaded, {"engine": name})
        _, patient = prepared(loaded, {"engine": name}, {"has_time_gate": False})
        budget = Budget(target_error=ROOM_TARGET) if gated.name == "virtual_lights" else Budget(spp=PATHS)
        yield _saving(f"{what} that end after the window", loaded, partial(render, gated), partial(render, patient))


def _saving(what: str, loaded: LoadedScene, skipping: Callable[[], Float64], doing: Callable[[], Float64]) -> Saving:
    results = [skipping(), doing()]  # compiles
    spent: list[list[float]] = [[], []]
    for _ in range(ROUNDS):
        for times, work in zip(spent, (skipping, doing), strict=True):
            timer = Timer()
            work()
            times.append(timer.read()[1])
    difference = float(np.linalg.norm(results[0] - results[1]) / np.linalg.norm(results[1]))
    return Saving(what, loaded.scene.name, min(spent[0]), min(spent[1]), difference)
