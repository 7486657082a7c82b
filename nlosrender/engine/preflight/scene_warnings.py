"""Warnings about a scene: hidden surfaces that no light reaches or leaves, and bins finer than float32 resolves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.arrivals import window_warnings
from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.interface import Engine
from nlosrender.engine.launch.device_arrays import rays_on_device
from nlosrender.engine.launch.facing_triangles import facing_triangles
from nlosrender.engine.launch.near_surfaces import points_above_wall
from nlosrender.engine.launch.surface_sampler import SAMPLEABLE_PLUGINS
from nlosrender.engine.preflight.near_wall_warnings import near_wall_warnings
from nlosrender.scene.build import BuiltScene, SceneWithoutWall, wall_box
from nlosrender.scene.pose import Float64
from nlosrender.scene.surfaces import Surface
from nlosrender.scene.triangle_point import triangle_weights
from nlosrender.scene.view import BuiltView

POINTS_PER_SURFACE = 64  # a visible share of a surface below about 1/64 may be missed
MAX_RAYS = 1_000_000  # of all surfaces together: a fraction of a second, less than a small render takes
RAY_MARGIN = 2e-5  # share of a ray's length left out at its end; chosen, not measured
GRAZING = 1e-2  # cosine below which a ray may slip past the limb of a round shape within its margin
TWO_SIDED = mi.BSDFFlags.BackSide | mi.BSDFFlags.Transmission
MIN_BIN = 2e-6  # engine units; float32 path lengths of a scene of size 1 are good to about 5e-7


@dataclass(frozen=True, eq=False)
class _SurfacePoints:
    """Points on the reflecting side of one hidden surface [engine units]."""

    points: Float64  # (n, 3)
    normals: Float64  # (n, 3), any length, those that reflection goes by; zero where both sides reflect


def scene_warnings(engine: Engine) -> tuple[str, ...]:
    """Return the warnings about a scene, its time axis and its engine, a sentence each.

    Parameters
    ----------
    engine
        As set up for the capture.
    """
    built, capture, time_axis = engine.built, engine.capture, engine.time_axis
    max_bounces = engine.options.bounces.max_bounces
    window = window_warnings(capture, built.wall, built.hidden_bounds, time_axis, max_bounces)
    if isinstance(built, BuiltView):
        own = _view_warnings(built)
        return (*built.warnings, *own, *window, *_bin_warnings(built, time_axis), *engine.warnings())
    has_wall = not isinstance(built, SceneWithoutWall)
    return (
        *built.warnings,
        *_pixel_warnings(built),
        *(dark_surface_warnings(built, capture, max_bounces) if has_wall else ()),
        *window,
        *(near_wall_warnings(built, capture) if has_wall else ()),
        *_bin_warnings(built, time_axis),
        *engine.warnings(),
    )


def _view_warnings(built: BuiltView) -> Iterator[str]:
    if not built.scene.emitters():
        yield "nothing in the scene shines: the picture is black. Add scene.emitters."


def _pixel_warnings(built: BuiltScene) -> Iterator[str]:
    """Yield how many pixels of a camera see nothing, and how many of their points the laser does not light."""
    if built.pixels is None:
        return
    sensors, lasers = built.pixels.sensors, built.pixels.lasers
    is_empty = sensors.is_empty
    shapes = built.scene.shapes() if isinstance(built, SceneWithoutWall) else []
    one_sided = [not shape.bsdf().flags() & TWO_SIDED for shape in shapes] or [False]
    from_behind = int((np.array(one_sided)[sensors.shapes if shapes else 0] & ~is_empty & ~sensors.is_front).sum())
    if from_behind:
        yield f"{from_behind} of {is_empty.size} pixels see a surface from behind, where its BSDF is black."
    if is_empty.any():
        yield f"{int(is_empty.sum())} of {is_empty.size} pixels see no surface: they stay empty, H is zero there."
    if unlit := lasers.n_hidden:
        n_lasers = lasers.shapes.size
        yield f"{unlit} of {n_lasers} laser points are hidden from the laser: H is zero there. Move laser_position."


def dark_surface_warnings(built: BuiltScene, capture: Capture, max_bounces: int | None) -> Iterator[str]:
    """Yield one sentence for each hidden surface that returns no light, or none of the bounces asked for.

    Parameters
    ----------
    built, capture
        A scene with a wall, and what is measured of it.
    max_bounces
        Highest bounce that is rendered; None for no limit.
    """
    facing: list[tuple[Surface, _SurfacePoints]] = []
    n_unsampled = 0  # shapes of kinds that cannot be sampled: assumed visible
    wall_corners = wall_box(built.wall) / built.metres_per_engine_unit
    for surface, shape in zip(built.surfaces, built.hidden_shapes, strict=True):
        name = f"{surface.key} ({surface.name})"
        if built.wall.is_planar and float(np.ravel(shape.bbox().max)[2]) <= 0:
            yield f"{name} lies behind the relay wall, where no light gets to."
            continue
        if not (shape.is_mesh() or shape.class_name() in SAMPLEABLE_PLUGINS):
            n_unsampled += 1
            continue
        points = _surface_points(built, shape)
        if not _turned_to(points, wall_corners).any():
            yield (
                f"{name} turns its back to the relay wall, and its BSDF is black there. "
                "Turn its normals round, or wrap its BSDF in {type: twosided}."
            )
            continue
        facing.append((surface, points))
    if not facing:
        if built.hidden_shapes and not n_unsampled:
            yield "no hidden surface faces the relay wall: nothing comes back from the hidden scene."
        return
    if capture.laser_flash is not None:  # what it lights is not what the laser point sees
        return
    surfaces = [points for _, points in facing]
    lit = _any_visible(built, surfaces, capture.laser_grid)
    seen = lit if capture.scan_type == "confocal" else _any_visible(built, surfaces, capture.sensor_grid)
    yield from _occlusion_warnings([surface for surface, _ in facing], lit, seen, max_bounces)
    if not lit.any() and not n_unsampled and built.wall.is_planar:
        yield "no laser point sees any of the hidden geometry: H is zero."


def _occlusion_warnings(
    surfaces: list[Surface], lit: NDArray[np.bool_], seen: NDArray[np.bool_], max_bounces: int | None
) -> Iterator[str]:
    only_third = max_bounces is not None and max_bounces <= THIRD_BOUNCE
    for surface, is_lit, is_seen in zip(surfaces, lit, seen, strict=True):
        name = f"{surface.key} ({surface.name})"
        if not (is_lit or is_seen):
            yield f"{name} is hidden from the relay wall by what lies between; no third bounce comes from it."
        elif only_third and not (is_lit and is_seen):
            whose = "laser" if not is_lit else "sensor"
            yield f"{name} is seen from no {whose} point; no third bounce comes from it, and no other is asked for."


def _surface_points(built: BuiltScene, shape: mi.Shape) -> _SurfacePoints:
    count = POINTS_PER_SURFACE
    k = np.arange(count)
    u, v = (k + 0.5) / count, k * 0.618033988749895 % 1  # golden ratio: even in both dimensions
    if shape.is_mesh():
        triangles, numbers = facing_triangles(built, shape)
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        areas = np.linalg.norm(normals, axis=-1)
        if not len(areas):
            return _SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)))
        cumulative = np.cumsum(areas) / areas.sum()
        chosen = np.minimum(np.searchsorted(cumulative, u), len(areas) - 1)
        a, b, c = (triangles[chosen, corner] for corner in range(3))
        weights = np.stack(triangle_weights(v, k * 0.754877666 % 1), axis=1)
        points = a + (b - a) * weights[:, 1:2] + (c - a) * weights[:, 2:]
        normals = normals[chosen]
        if shape.has_vertex_normals():
            parameters = mi.traverse(shape)
            corners = np.asarray(parameters["faces"]).reshape(-1, 3)[numbers[chosen]]
            at_vertices = np.asarray(parameters["vertex_normals"], dtype=np.float64).reshape(-1, 3)
            normals = np.einsum("pc,pcx->px", weights, at_vertices[corners])
    else:
        at = mi.Point2f(u.astype(np.float32), v.astype(np.float32))
        sample = shape.sample_position(mi.Float(0), at)
        points = np.array(sample.p, dtype=np.float64).T
        normals = np.array(sample.n, dtype=np.float64).T
    if bool(shape.bsdf().flags() & mi.BSDFFlags.BackSide):
        normals = np.zeros_like(points)
    return _SurfacePoints(points, normals)


def _turned_to(surface: _SurfacePoints, wall_points: Float64, least_cosine: float = 0.0) -> NDArray[np.bool_]:
    """Return (wall points, surface points) whether they see each other's reflecting side, were nothing between."""
    towards = wall_points[:, None] - surface.points[None]
    two_sided = ~surface.normals.any(axis=-1)
    lengths = np.linalg.norm(towards, axis=-1) * np.linalg.norm(surface.normals, axis=-1)
    return two_sided | (np.einsum("wpk,pk->wp", towards, surface.normals) > least_cosine * lengths)


def _any_visible(built: BuiltScene, surfaces: list[_SurfacePoints], grid: PointGrid) -> NDArray[np.bool_]:
    """Return for each surface whether any of its points is seen from any of a sample of the grid's points."""
    wall_points = points_above_wall(built, grid)
    step = max(1, len(surfaces) * len(wall_points) * POINTS_PER_SURFACE // MAX_RAYS)
    origins, targets, surface_of_ray = [], [], []
    seen = np.zeros(len(surfaces), dtype=bool)
    for index, surface in enumerate(surfaces):
        wall, point = np.nonzero(_turned_to(surface, wall_points, GRAZING))
        if not len(wall):  # all rays graze, as to a plate almost on the wall: orientation alone decides
            seen[index] = _turned_to(surface, wall_points).any()
        wall, point = wall[::step], point[::step]
        origins.append(wall_points[wall])
        targets.append(surface.points[point])
        surface_of_ray.append(np.full(len(wall), index))
    start, end = np.concatenate(origins), np.concatenate(targets)
    if len(start):
        free = ~np.array(built.scene.ray_test(rays_on_device(start, end - start, 1 - RAY_MARGIN)), dtype=bool)
        seen[np.concatenate(surface_of_ray)[free]] = True
    return seen


def _bin_warnings(built: BuiltScene | BuiltView, time_axis: TimeAxis) -> Iterator[str]:
    finest = MIN_BIN * built.metres_per_engine_unit
    if time_axis.bin_width_opl < finest:
        yield (
            f"time_axis.bin_width_opl: bins of {time_axis.bin_width_opl:.3g} m are finer than path "
            f"lengths are resolved in a scene of this size (float32, about {finest / 4:.1g} m): light is spread over "
            "several bins. Use wider bins."
        )
