"""Planner: chooses the engine of a scene, with the reason. The one place that knows which engines there are."""

from __future__ import annotations

import mitsuba as mi

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.footprint import PixelFootprint
from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.config.render import RenderConfig
from nlosrender.engine.interface import Engine
from nlosrender.engine.launch.device_capture import DeviceCapture, RenderOptions
from nlosrender.engine.line_of_sight.engine import LineOfSightEngine
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.virtual_lights.elements.tessellator import can_tessellate, wall_sees_itself
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
from nlosrender.errors import ConfigError
from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.view import BuiltView

TOUCHING = 2e-3  # engine units: a surface this near to laser or sensor points takes patches of its own for each of them
MAX_NEAR_PATCHES = 100_000  # patches of such surfaces at the coarsest, where paths find the same light
MAX_TRIANGLES = 5_000_000  # of all meshes: merging them takes about 1 kB each on the way


def choose_engine(
    render: RenderConfig,
    built: BuiltScene | BuiltView,
    capture: Capture,
    time_axis: TimeAxis,
    options: RenderOptions,
    lanes: int,
) -> Engine:
    """Return the engine for a scene, with its reason in plain words (backend started).

    ``auto`` chooses virtual lights for scenes that they support, those without transmission (``_obstacle``). The path
    engine renders all others.

    Parameters
    ----------
    render
        What the user asks for.
    built, capture, time_axis, options, lanes
        As for the engines.
    """
    if isinstance(built, BuiltView):
        return LineOfSightEngine(built, capture, time_axis, options)
    reason = "asked for" if render.engine == "path" else _obstacle(render, capture, built)
    if reason is None and render.engine == "auto" and wall_sees_itself(built) and built.wall_shape.is_mesh():
        reason = "the relay wall is a mesh that sees itself: the edges between its triangles take very many patches"
    device = DeviceCapture(built, capture, time_axis, options)
    area = "laser_flash" if capture.laser_flash is not None else "footprint" if capture.footprint is not None else None
    if area is not None and device.mirrors:
        message = "the scene has mirrors or smooth coats, whose light is computed from points, not from areas. "
        message += "Remove it, or make them rough, such as {type: roughconductor, alpha: 0.02}."
        raise ConfigError.at(f"capture.{area}", message)
    if reason is not None:
        return PathEngine(device, reason=reason)
    further = PathEngine(device, first_bounce=THIRD_BOUNCE + 1)
    engine = VirtualLightEngine(device, further, lanes)
    if engine.tessellator.nearest_round < TOUCHING:
        reason = "a round surface, which is cut into patches of one size, touches a laser or sensor point"
        return PathEngine(device, reason=reason)
    if engine.tessellator.n_round_elements > engine.tessellator.tuning.max_patches:
        reason = "a round surface is so narrow that it would be cut into millions of patches"
        return PathEngine(device, reason=reason)
    reach = capture.footprint.reach / built.metres_per_engine_unit if capture.footprint is not None else None
    if reach is not None and engine.tessellator.nearest < reach + TOUCHING:
        return PathEngine(device, reason="hidden geometry touches the footprint of a sensor point")
    if render.engine == "virtual_lights":
        engine.reason = "asked for"
    elif (reason := _obstacle_close_by(engine, capture)) is not None:
        return PathEngine(device, reason=reason)
    return engine


def _obstacle_close_by(engine: VirtualLightEngine, capture: Capture) -> str | None:
    """Return why paths are better for surfaces almost on the wall; None where they are not.

    Paths from the sensor points find what is close to these, but not what is close to a laser point elsewhere.
    """
    tessellator = engine.tessellator
    if tessellator.nearest >= TOUCHING:
        return None
    if capture.scan_type == "confocal":
        return "hidden geometry touches a laser or sensor point"
    max_patches = tessellator.tuning.max_patches if tessellator.nearest_to_laser < TOUCHING else MAX_NEAR_PATCHES
    if tessellator.count(tessellator.tuning.coarsest_scale) > max_patches:
        return "hidden geometry touches so many points that paths cost less"
    return None


def _obstacle(render: RenderConfig, capture: Capture, built: BuiltScene) -> str | None:
    """Return why the virtual lights cannot render a scene; None when they can."""
    if isinstance(capture.footprint, PixelFootprint):
        return "virtual lights look from points, and sensor points stand for all that their pixels see"
    if isinstance(built, SceneWithoutWall) and any(
        bool(shape.bsdf().flags() & mi.BSDFFlags.Delta) for shape in built.scene.shapes()
    ):
        return f"a surface has a mirror lobe, and virtual lights need a relay wall before it: {built.reason}"
    if render.polarized:
        return "only paths carry polarised light"
    if render.spp is not None:
        return "spp counts paths"
    if render.temporal_kernel_opl > 0:
        return "a temporal kernel smooths the noise of paths"
    if render.max_bounces is not None and render.max_bounces < THIRD_BOUNCE:
        return "there is no third bounce to compute"
    if not (render.laser_sampling and render.hidden_geometry_sampling):
        return "a technique of the path engine is switched off"
    if capture.laser_flash is not None:
        return "the laser flashes an area"
    if capture.laser_spot_radius > 0:
        return "the laser has a spot"
    if capture.footprint is not None and capture.scan_type == "confocal":
        return "the sensor points of a confocal scan have footprints, and its laser points have none"
    if built.hidden_bounds is None and not wall_sees_itself(built):
        return "there is no hidden geometry"
    if not can_tessellate(built):
        return "a hidden shape is neither a mesh nor a sphere or cylinder"
    if built.wall_shape is not None and bool(built.wall_bsdf.flags() & mi.BSDFFlags.Delta):
        return "the relay wall has a mirror lobe"
    hard = mi.BSDFFlags.Transmission | mi.BSDFFlags.Null
    if any(bool(shape.bsdf().flags() & hard) for shape in built.hidden_shapes):
        return "some hidden surfaces let light through"
    if built.n_triangles > MAX_TRIANGLES:
        return f"{built.n_triangles} triangles are more than the gather takes"
    return None
