"""Surfaces close to laser and sensor points: height of the nearest, and light there that paths sample rarely."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.capture.arrivals import sampled_indices
from nlosrender.engine.launch.device_arrays import rays_on_device
from nlosrender.engine.launch.ray_offsets import WALL_OFFSET, ray_offset
from nlosrender.scene.build import BuiltScene, SceneWithoutWall, wall_box
from nlosrender.scene.loading.round_surfaces import curvature

if TYPE_CHECKING:
    from nlosrender.capture.grids import PointGrid
    from nlosrender.engine.launch.device_capture import DeviceCapture
    from nlosrender.scene.pose import Float64

OFFSETS_LOST = 2.0  # ray offsets from a curved wall within which light is lost: one at either end of a shadow ray
MIN_P_HIDDEN = 1e-3  # of hidden geometry sampling where there is none: BSDF sampling finds even less
RARE_SHARE = 1e-4  # of paths: of the 1e5 to 1e6 per point of a render, 10 to 100 find such light


def points_above_wall(built: BuiltScene, grid: PointGrid) -> Float64:
    """Return a sample of a grid's points, just above the wall (n, 3) [engine units]."""
    index = sampled_indices(grid)
    positions, normals = grid.positions.reshape(-1, 3)[index], grid.normals.reshape(-1, 3)[index]
    return positions / built.metres_per_engine_unit + wall_offset(built) * normals


def wall_offset(built: BuiltScene) -> float:
    """Return the largest ray offset from the wall [engine units], see ``ray_offset_at``."""
    if built.wall.is_planar:
        return WALL_OFFSET
    farthest = float(np.abs(wall_box(built.wall)).max()) / built.metres_per_engine_unit
    walls = built.scene.shapes() if isinstance(built, SceneWithoutWall) else [built.wall_shape]
    return ray_offset(built) * (1 + farthest) * max(1.0, *map(curvature, walls))


def nearest_above(built: BuiltScene, grid: PointGrid) -> tuple[float, Float64]:
    """Return the least height [engine units] of anything straight above a sample of points, and the point (3,) [m]."""
    starts, normals = points_above_wall(built, grid), grid.normals.reshape(-1, 3)[sampled_indices(grid)]
    heights = _first_hits(built, starts, normals, math.inf)
    if not built.wall.is_planar:  # surfaces below the ray offset are met by rays back to the wall
        offset = wall_offset(built)
        top = OFFSETS_LOST * offset
        down = _first_hits(built, starts + (top - offset) * normals, -normals, top - offset / 16)
        heights = np.where(np.isfinite(down), top - down, heights)
    nearest = int(np.argmin(heights))
    return float(heights[nearest]), np.round(starts[nearest] * built.metres_per_engine_unit, 9)


def _first_hits(built: BuiltScene, starts: Float64, directions: Float64, farthest: float) -> Float64:
    """Return the distance (n,) to what a ray meets first, inf where that is nothing [engine units]."""
    ray = rays_on_device(starts, directions, farthest)
    return np.array(built.scene.ray_intersect_preliminary(ray).t, dtype=np.float64)


def rare_light_warnings(device: DeviceCapture, p_hidden_sampling: Callable[[], float]) -> Iterator[str]:
    """Yield a warning where paths rarely sample the light between a laser point and a surface close to it.

    It comes from an area of about pi h^2 with h the height, and paths get there by sampling all of the hidden area.
    ``p_hidden_sampling`` is asked for where there is anything to sample.
    """
    built, capture, area = device.built, device.capture, device.sampler.area
    if capture.scan_type == "confocal" or device.sampler.is_empty:
        return
    height, (x, y, z) = nearest_above(built, capture.laser_grid)
    height_m = height * built.metres_per_engine_unit
    share = max(p_hidden_sampling(), MIN_P_HIDDEN) * math.pi * max(height, WALL_OFFSET) ** 2 / area
    if share < RARE_SHARE:
        yield (
            f"a hidden surface lies {height_m:.2g} m before the laser point ({x:.4g}, {y:.4g}, {z:.4g}) m: "
            f"only one path in {1 / share:.0e} finds the light between the two, up to half of H, and the stated error "
            "misses it as well. Use render.engine: virtual_lights, or scan_type: confocal."
        )
