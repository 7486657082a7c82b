"""Reasons why a capture is zero everywhere, found after its render and kept in the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.arrivals import sampled_indices
from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.engine.interface import Engine
from nlosrender.engine.launch.ray_offsets import offset_origin
from nlosrender.engine.launch.wall_points import laser_points, sensor_points
from nlosrender.engine.preflight.scene_warnings import dark_surface_warnings
from nlosrender.engine.preflight.unsampled_paths import UnsampledPaths
from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.view import BuiltView

DIRECTIONS = 256  # tried at each of a sample of laser or sensor points: about 1 % of the hemisphere may be missed


def zero_reasons(engine: Engine, unsampled: Sequence[UnsampledPaths], outside: float) -> tuple[str, ...]:
    """Return the reasons found why H is zero, or a sentence that none was found.

    Parameters
    ----------
    engine
        As set up for the capture.
    unsampled
        Paths that its techniques do not sample.
    outside
        H outside the time window, summed [J m^-2 sr^-1].
    """
    found = [
        *_late_or_early(engine, outside),
        *_dark(engine),
        *(f"{paths.what} is not sampled" for paths in unsampled),
    ]
    return tuple(found) or ("no path found any light, and the reason is not known: more paths might find some",)


def _late_or_early(engine: Engine, outside: float) -> Iterator[str]:
    if outside > 0:
        axis = engine.time_axis
        yield (
            f"all light that was found ({outside:.3g} J m^-2 sr^-1) arrives outside the time window from "
            f"{axis.start_opl:.6g} to {axis.end_opl:.6g} m"
        )


def _dark(engine: Engine) -> Iterator[str]:
    built, highest = engine.built, engine.options.bounces.max_bounces
    if isinstance(built, BuiltView):
        if not built.scene.emitters():
            yield "nothing in the scene shines"
        if not built.hidden_shapes:
            yield "there is nothing to be seen"
        return
    if not built.hidden_shapes:
        yield "there is no hidden geometry"
    if built.wall.is_planar and highest is not None and highest < THIRD_BOUNCE:
        yield "render.max_bounces is 2, and no light goes straight from a point of a flat wall to another"
    if not isinstance(built, SceneWithoutWall):
        yield from (text.rstrip(".") for text in dark_surface_warnings(built, engine.capture, highest))
    yield from _black_surfaces(engine, built)


def _black_surfaces(engine: Engine, built: BuiltScene) -> Iterator[str]:
    """Yield which BSDFs are black where rays from laser or sensor points meet them."""
    capture, time_axis = engine.capture, engine.time_axis
    context = mi.BSDFContext()
    for name, points, grid in (
        ("laser", laser_points, capture.laser_grid),
        ("sensor", sensor_points, capture.sensor_grid),
    ):
        index = np.repeat(sampled_indices(grid), DIRECTIONS).astype(np.uint32)
        start = points(built, capture, time_axis, index).interaction
        draw = np.random.default_rng(0).random((6, len(index))).astype(np.float32)
        direction = start.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(draw[0], draw[1])))
        if not dr.any(_is_bright(built.bsdf_at(start).eval(context, start, start.to_local(direction)))):
            where = "what the camera sees" if isinstance(built, SceneWithoutWall) else "the relay wall"
            yield f"{where} reflects nothing at the {name} points"
        si = built.scene.ray_intersect(mi.Ray3f(offset_origin(built, start, direction), direction))
        on_hidden = si.is_valid() & ~built.is_wall(si.shape)
        _, weight = si.bsdf().sample(context, si, mi.Float(draw[2]), mi.Point2f(draw[3], draw[4]), on_hidden)
        if dr.any(on_hidden) and not dr.any(on_hidden & _is_bright(weight)):
            yield f"all hidden surfaces that {name} points see are black there"


def _is_bright(value: mi.Spectrum) -> mi.Bool:
    return dr.any(mi.unpolarized_spectrum(value) > 0)
