"""What a render leaves out because the scene does not need it, and why (backend started)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.engine.engines import Engine
from nlosrender.engine.launch.time_gate import GATE_SURVIVAL
from nlosrender.engine.line_of_sight.engine import LineOfSightEngine
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine


@dataclass(frozen=True)
class OmittedWork:
    """One kind of work that is not done."""

    what: str
    why: str


def omitted_work(engine: Engine, *, scene_is_colored: bool) -> tuple[OmittedWork, ...]:
    """Return what ``engine`` skips.

    Parameters
    ----------
    engine
        As set up for the capture.
    scene_is_colored
        Whether something in the scene has a colour.
    """
    if isinstance(engine, LineOfSightEngine):
        return tuple(_of_view(engine, scene_is_colored))
    paths = engine.paths if isinstance(engine, VirtualLightEngine) else engine
    built, options = engine.built, engine.options
    skipped = []
    if built.wall.is_planar:
        skipped.append(OmittedWork("second bounce", "no light goes straight from a point of a planar wall to another"))
    if options.bounces.max_bounces is not None:
        highest = options.bounces.max_bounces
        skipped.append(OmittedWork(f"bounces above {highest}", f"render.max_bounces is {highest}"))
    if not engine.settings.needs_visibility:
        skipped.append(
            OmittedWork("visibility rays", "one convex object stands alone before a planar wall: nothing lies between")
        )
    elif isinstance(engine, VirtualLightEngine) and engine.third.masks.pay_off(engine.capture.n_sensors):
        why = "where nothing can lie between a patch and a part of the wall"
        skipped.append(OmittedWork("visibility rays that nothing can stop", why))
    if isinstance(engine, VirtualLightEngine) or paths.p_hidden_sampling > 0:
        dark = built.n_triangles - paths.sampler.n_triangles
        if dark:
            why = "they face away from the whole wall or lie behind it: no ray is sent to them"
            skipped.append(OmittedWork(f"{dark} of {built.n_triangles} triangles", why))
    if isinstance(engine, VirtualLightEngine) and engine.third.is_reciprocal:
        why = "laser and sensor points are the same and everything is Lambertian: H(l, s) = H(s, l)"
        skipped.append(OmittedWork("half of the pairs of laser and sensor points", why))
    if _thins_out(engine, paths):
        many = round(1 / GATE_SURVIVAL)
        why = f"one in {many} goes on, with {many} times the weight: the light outside the window is not biased"
        skipped.append(OmittedWork("most paths on which light can only arrive after the time window", why))
    if traces_paths(engine) and paths.hidden_aabb is not None:
        why = "such a path ends where it began"
        skipped.append(OmittedWork("rays from the wall that miss the box around all hidden geometry", why))
    skipped += _colour(options.channels, scene_is_colored)
    return (*skipped, *(_techniques(paths) if traces_paths(engine) else ()))


def _of_view(engine: LineOfSightEngine, scene_is_colored: bool) -> Iterator[OmittedWork]:
    highest = engine.options.bounces.max_bounces
    if highest is not None:
        yield OmittedWork(f"paths of more than {highest} surface interactions", f"render.max_bounces is {highest}")
    if not engine.settings.polarized:
        yield OmittedWork("polarisation", "render.polarized is false")
    elif scene_is_colored:
        yield OmittedWork("colour", "polarised light is rendered in grey")
    yield from _colour(engine.options.channels, scene_is_colored)


def _colour(channels: int, scene_is_colored: bool) -> Iterator[OmittedWork]:
    if channels == 1:
        yield OmittedWork("colour", "render.color is grey" if scene_is_colored else "everything in the scene is grey")


def _thins_out(engine: VirtualLightEngine | PathEngine, paths: PathEngine) -> bool:
    """Return whether paths or walks go on after light can arrive in the window, as far as the bounces tell."""
    if paths.capture_gate is None:
        return False
    return traces_vpls(engine) or (traces_paths(engine) and paths.settings.has_time_gate)


def _techniques(paths: PathEngine) -> Iterator[OmittedWork]:
    """Yield the sampling technique that is left out where one covers everything."""
    if paths.p_hidden_sampling == 1:
        yield OmittedWork("BSDF sampling at the wall (MIS)", "hidden geometry sampling alone finds all light there")
    elif paths.p_hidden_sampling == 0:
        if not paths.options.hidden_geometry_sampling:
            why = "render.hidden_geometry_sampling is false"
        elif paths.built.hidden_bounds is None or paths.sampler.is_empty:
            why = "there is no hidden surface to sample"
        else:
            why = "hidden geometry surrounds the wall: BSDF sampling alone does better"
        yield OmittedWork("hidden geometry sampling (MIS)", why)


def shared_samples(engine: Engine) -> str:
    """Return which samples of a capture have errors in common, in words for its file; empty where none have."""
    if isinstance(engine, VirtualLightEngine):
        what = "all sensor points share the same patches" + (" and walks" if traces_vpls(engine) else "")
    elif engine.capture.scan_type == "exhaustive":
        what = "all laser points share the paths of a sensor point"
    else:
        return ""
    return f"{what}: their errors are correlated. The error of sums is in the file's energy_error_per_bounce"


def traces_vpls(engine: Engine) -> bool:
    """Return whether walks give the further bounces."""
    return isinstance(engine, VirtualLightEngine) and engine.further is not None


def traces_paths(engine: Engine) -> bool:
    """Return whether the path engine has anything to do: not when patches and walks give all bounces asked for."""
    if isinstance(engine, VirtualLightEngine):
        return engine.has_further_bounces and engine.further is None
    if isinstance(engine, LineOfSightEngine):
        return True
    highest = engine.options.bounces.max_bounces
    return highest is None or highest >= THIRD_BOUNCE
