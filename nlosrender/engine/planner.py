"""Which engine renders a scene, and why: the cheapest one that is right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mitsuba as mi

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture
from nlosrender.config.render import RenderConfig
from nlosrender.engine.virtual_lights.engine import is_lambertian
from nlosrender.engine.virtual_lights.tessellator import Tessellator, can_tessellate
from nlosrender.scene.build import BuiltScene

EngineName = Literal["path", "virtual_lights"]
# Engine units: a surface this near to a laser or sensor point is seen under a large angle however finely it is cut.
TOUCHING = 2e-3
MAX_TRIANGLES = 5_000_000  # of all meshes: merging them takes about 1 kB each on the way


@dataclass(frozen=True)
class EngineChoice:
    """The engine that renders, and the reason in plain words."""

    name: EngineName
    reason: str


def choose_engine(render: RenderConfig, capture: Capture, built: BuiltScene) -> EngineChoice:
    """Choose the engine for a scene (backend started).

    ``auto`` takes the virtual lights where they are known to be right; asked for by name, they also take rough
    non-Lambertian surfaces. What they cannot do goes to the path engine.
    """
    if render.engine == "path":
        return EngineChoice("path", "asked for")
    obstacle = _obstacle(render, capture, built)
    if obstacle is not None:
        return EngineChoice("path", obstacle)
    if render.engine == "virtual_lights":
        return EngineChoice("virtual_lights", "asked for")
    if not all(is_lambertian(shape.bsdf()) for shape in built.hidden_shapes):
        return EngineChoice("path", "some hidden surfaces are not Lambertian")
    if Tessellator(built, capture, 1.0).nearest < TOUCHING:
        return EngineChoice("path", "hidden geometry touches a laser or sensor point")
    return EngineChoice("virtual_lights", "Lambertian surfaces before a planar wall")


def _obstacle(render: RenderConfig, capture: Capture, built: BuiltScene) -> str | None:
    """Return why the virtual lights cannot render a scene; None when they can."""
    if render.spp is not None:
        return "spp counts paths"
    if render.max_bounces is not None and render.max_bounces < THIRD_BOUNCE:
        return "there is no third bounce to compute"
    if not (render.laser_sampling and render.hidden_geometry_sampling):
        return "a technique of the path engine is switched off"
    if capture.laser_spot_radius > 0:
        return "the laser has a spot"
    if built.hidden_bounds is None:
        return "there is no hidden geometry"
    if not can_tessellate(built):
        return "the wall is curved, or a hidden shape is neither a mesh nor a sphere or cylinder"
    if bool(built.wall_bsdf.flags() & mi.BSDFFlags.Delta):
        return "the relay wall has a mirror lobe"
    hard = mi.BSDFFlags.Delta | mi.BSDFFlags.Transmission | mi.BSDFFlags.Null
    if any(bool(shape.bsdf().flags() & hard) for shape in built.hidden_shapes):
        return "some hidden surfaces are mirrors or let light through"
    if built.n_triangles > MAX_TRIANGLES:
        return f"{built.n_triangles} triangles are more than the gather takes"
    return None
