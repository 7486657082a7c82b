"""What each kind of skipped work saves: CPU seconds with and without it, the results compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from nlosrender.bench.runs import Float64, LoadedScene, Timer, load, virtual_lights_of
from nlosrender.bench.scenes import WALL_SIZE, BenchScene, closed_room, many_lasers

if TYPE_CHECKING:
    from nlosrender.capture.plan import Batch
    from nlosrender.engine.interface import Budget, Engine
    from nlosrender.engine.path.engine import PathEngine
    from nlosrender.engine.virtual_lights.engine import VirtualLightEngine

ROUNDS = 3
GATHER_TARGET = 0.01
PATHS = 1024  # per sensor point
SHORT_WINDOW_BINS = 100  # of 3 cm: less than two ways to the far side of the room and back
ROOM_TARGET = 0.03
ROOM_POINTS = 64  # sensor points along each side: enough for regions
LASERS = 12  # along each side, and as many sensor points
FINENESS = 0.3
NEVER = 10**12  # points
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
    """Yield what the gather leaves out: rays nothing can stop, the dark patches, colour."""
    from nlosrender.engine.interface import Budget

    plan, engine = virtual_lights_of(loaded)
    patch_scale = engine.calibrate(Budget(target_error=GATHER_TARGET)).patch_scale or 1.0

    def gather() -> Float64:
        engine.third.forget()  # visibility is a part of lighting, too
        return np.concatenate([engine.third.gather(batch, patch_scale).values for batch in plan.batches], axis=3)

    if not engine.settings.needs_visibility:
        yield _saving("rays where nothing can lie between", loaded, gather, _tracing_all(engine, gather))
    elif engine.third.shadow_ray_targets(plan.batches[0], patch_scale).mask.any():
        yield _saving("rays that nothing can stop", loaded, gather, _without_masks(engine, gather))


def _tracing_all(engine: VirtualLightEngine, gather: Callable[[], Float64]) -> Callable[[], Float64]:
    """Return ``gather`` with visibility rays that the scene does not need."""

    def traced() -> Float64:
        third = engine.third
        known, third.settings = third.settings, replace(third.settings, needs_visibility=True)
        try:
            return _without_masks(engine, gather)()
        finally:
            third.settings = known

    return traced


def _without_masks(engine: VirtualLightEngine, gather: Callable[[], Float64]) -> Callable[[], Float64]:
    """Return ``gather`` with rays to every patch that faces a sensor point, without visibility masks."""
    from nlosrender.engine.virtual_lights.visibility.masks import VisibilityMasks

    def traced() -> Float64:
        third = engine.third
        known = third.masks
        third.masks = VisibilityMasks(engine.built, replace(known.tuning, min_mask_sensors=NEVER))
        try:
            return gather()
        finally:
            third.masks = known

    return traced


def _of_regions(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what patches of their own close to the wall save the parts of the sensor grid."""
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

    plan, engine = virtual_lights_of(loaded)
    third, bin_width = engine.third, engine.tessellator.size_field.bin_width
    undivided = Tessellator(engine.built, engine.capture, bin_width, may_divide=False)
    one = ThirdBounce(third.device, undivided, third.settings, third.lanes)
    ways = [lambda of=of: of.gather(plan.batches[0], FINENESS).values for of in (third, one)]
    yield _saving("patches of other regions of the wall", loaded, *ways)


def _of_reciprocity(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what taking half of an exhaustive capture from the other half saves."""
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

    plan, engine = virtual_lights_of(loaded)
    third = engine.third
    every = ThirdBounce(third.device, third.tessellator, third.settings, third.lanes, is_reciprocal=False)
    ways = [lambda of=of: of.gather(plan.batches[0], FINENESS).values for of in (third, every)]
    yield _saving("pairs of points that reciprocity gives", loaded, *ways)


def of_paths(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what the path engine leaves out: rays nothing can stop, the technique that is not needed."""
    from nlosrender.rendering import stages

    config = loaded.scene.config(engine="path", split_bounces=False, spp=PATHS)
    plan, engine = stages.prepare(config, loaded.backend, loaded.built, loaded.capture, loaded.time_axis)
    if engine.name != "path":
        return

    def render(other: PathEngine) -> Callable[[], Float64]:
        from nlosrender.engine.interface import Budget

        return lambda: np.concatenate([other.render(b, Budget(spp=PATHS)).mean for b in plan.batches], axis=3)

    def engine_with(**options: Any) -> PathEngine:
        parts = loaded.backend, loaded.built, loaded.capture, loaded.time_axis
        return cast("PathEngine", stages.prepare(config, *parts, changes=options)[1])

    usual = engine_with()
    if not usual.settings.needs_visibility:
        tracing = engine_with()
        tracing.settings = replace(usual.settings, needs_visibility=True)
        yield _saving("rays of paths where nothing can lie between", loaded, render(usual), render(tracing))
    by_bsdf = engine_with(hidden_geometry_sampling=False)
    if by_bsdf.hidden_aabb is not None:
        tracing = engine_with(hidden_geometry_sampling=False)
        tracing.hidden_aabb = None
        what = "rays of paths that pass the hidden geometry by (BSDF sampling)"
        yield _saving(what, loaded, render(by_bsdf), render(tracing))
    if usual.p_hidden_sampling in (0.0, 1.0):
        kept = "hidden geometry" if usual.p_hidden_sampling else "BSDF"
        mixed = engine_with(p_hidden_sampling=MIXTURE)
        yield _saving(f"MIS where {kept} sampling suffices", loaded, render(usual), render(mixed))


def _of_late_light(loaded: LoadedScene) -> Iterator[Saving]:
    """Yield what is left out that comes after the window: of as many paths, and of walks to the same error."""
    from nlosrender.engine.interface import Budget
    from nlosrender.rendering import stages

    built, capture, time_axis = loaded.built, loaded.capture, loaded.time_axis
    for name in ("path", "virtual_lights"):
        config = loaded.scene.config(engine=name, split_bounces=False)
        plan, engine = stages.prepare(config, loaded.backend, built, capture, time_axis)
        changes = {"has_time_gate": False}
        _, patient = stages.prepare(config, loaded.backend, built, capture, time_axis, changes=changes)
        budget = Budget(target_error=ROOM_TARGET) if engine.name == "virtual_lights" else Budget(spp=PATHS)

        def render(one: Engine, budget: Budget = budget, batches: Sequence[Batch] = plan.batches) -> Float64:
            return np.concatenate([one.render(batch, one.calibrate(budget)).mean for batch in batches], axis=3)

        what = {"path": "most paths", "virtual_lights": "most walks"}[name] + " that end after the window"
        yield _saving(what, loaded, partial(render, engine), partial(render, patient))


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
