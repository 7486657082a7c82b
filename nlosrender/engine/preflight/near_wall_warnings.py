"""What goes wrong close to the wall: heights that float32 does not know, light that no path finds, edges of meshes."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from nlosrender.capture.arrivals import sampled_indices
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.engines import Engine
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.path.laser_connections import WALL_OFFSET, ray_offset
from nlosrender.engine.virtual_lights.engine import RARE, VirtualLightEngine
from nlosrender.scene.build import BuiltScene, wall_box
from nlosrender.scene.loading.round_surfaces import curvature
from nlosrender.scene.pose import Float64
from nlosrender.scene.walls.mesh_wall import MeshWall

NEAREST_KNOWN = 1e-6  # engine units; nearer surfaces that are tilted or round lie some per cent nearer or farther
NEAREST_TOLD = 2.0  # ray offsets from a curved wall within which light is lost
LEAST_FRACTION = 1e-3  # of hidden geometry sampling where there is none: BSDF sampling finds even less


def near_wall_warnings(engine: Engine, built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield one sentence for each thing close to the wall that a render does not get right.

    Parameters
    ----------
    engine, built, capture
        As set up for the capture; a scene with a wall.
    """
    yield from _near_warnings(built, capture)
    yield from _rare_light_warnings(engine, built, capture)
    yield from _virtual_light_warnings(engine)
    yield from _edge_warnings(built, capture)


def points_above_wall(built: BuiltScene, grid: PointGrid) -> Float64:
    """Return a sample of a grid's points, just above the wall (n, 3) [engine units]."""
    index = sampled_indices(grid)
    positions, normals = grid.positions.reshape(-1, 3)[index], grid.normals.reshape(-1, 3)[index]
    return positions / built.unit + wall_offset(built) * normals


def wall_offset(built: BuiltScene) -> float:
    """Return the largest ray offset from the wall [engine units], see ``ray_offset_at``."""
    if built.wall.is_planar:
        return WALL_OFFSET
    farthest = float(np.abs(wall_box(built.wall)).max()) / built.unit
    return ray_offset(built) * (1 + farthest) * max(1.0, curvature(built.wall_shape))


def _near_warnings(built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield which surface is so near to a laser or sensor point that float32 does not know how near."""
    grids = {id(grid): grid for grid in (capture.laser_grid, capture.sensor_grid)}.values()
    height, (x, y, z) = min((_nearest_above(built, grid) for grid in grids), key=lambda found: found[0])
    if not built.wall.is_planar:
        if height < NEAREST_TOLD * wall_offset(built):
            yield (
                f"a hidden surface lies {height * built.unit:.1g} m before the relay wall at ({x:.4g}, {y:.4g}, "
                f"{z:.4g}) m of its frame: on a curved wall, light within "
                f"{NEAREST_TOLD * wall_offset(built) * built.unit:.0g} m of it is not found."
            )
    elif height < NEAREST_KNOWN:
        yield (
            f"a hidden surface lies {height * built.unit:.1g} m before the wall at ({x:.4g}, {y:.4g}, "
            f"{z:.4g}) m of its frame, where float32 knows heights to about {NEAREST_KNOWN / 10 * built.unit:.0g} m: "
            "H there is not exact unless the surface is parallel to the wall."
        )


def _rare_light_warnings(engine: Engine, built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield that paths hardly find the light between a laser point and a surface close to it.

    It comes from an area of about pi h^2 with h the height, and paths get there by sampling all of the hidden area.
    """
    if not isinstance(engine, PathEngine) or capture.scan_type == "confocal" or engine.sampler.is_empty:
        return
    height, (x, y, z) = _nearest_above(built, capture.laser_grid)
    share = (
        max(engine.p_hidden_sampling, LEAST_FRACTION) * math.pi * max(height, WALL_OFFSET) ** 2 / engine.sampler.area
    )
    if share < RARE:
        yield (
            f"a hidden surface lies {height * built.unit:.2g} m before the laser point ({x:.4g}, {y:.4g}, {z:.4g}) m: "
            f"only one path in {1 / share:.0e} finds the light between the two, up to half of H, and the stated error "
            "misses it as well. Use render.engine: virtual_lights, or scan_type: confocal."
        )


def _virtual_light_warnings(engine: Engine) -> Iterator[str]:
    """Yield what the virtual lights do not get right close to the wall."""
    if isinstance(engine, VirtualLightEngine) and engine.misses_light:
        distance = engine.tessellator.nearest_to_laser * engine.built.unit
        yield (
            f"a hidden surface lies {distance:.1g} m from a laser point: the third bounce is right, "
            "but most of the light that goes to and fro between the two is not found, and the stated "
            "error takes all further bounces for unknown. Use render.max_bounces: 3 where they do not matter."
        )


def _nearest_above(built: BuiltScene, grid: PointGrid) -> tuple[float, Float64]:
    """Return the least height [engine units] of anything straight above a sample of points, and the point (3,) [m]."""
    starts, normals = points_above_wall(built, grid), grid.normals.reshape(-1, 3)[sampled_indices(grid)]
    heights = _first_hits(built, starts, normals, math.inf)
    if not built.wall.is_planar:  # what lies below the ray offset is met by a ray that comes back to the wall
        offset = wall_offset(built)
        top = NEAREST_TOLD * offset
        down = _first_hits(built, starts + (top - offset) * normals, -normals, top - offset / 16)
        heights = np.where(np.isfinite(down), top - down, heights)
    nearest = int(np.argmin(heights))
    return float(heights[nearest]), np.round(starts[nearest] * built.unit, 9)


def _first_hits(built: BuiltScene, starts: Float64, directions: Float64, farthest: float) -> Float64:
    """Return the distance (n,) to what a ray meets first, inf where that is nothing [engine units]."""
    start, direction = (mi.Point3f(values.T.astype(np.float32)) for values in (starts, directions))
    ray = mi.Ray3f(start, mi.Vector3f(direction), mi.Float(farthest), mi.Float(0), [])
    return np.array(built.scene.ray_intersect_preliminary(ray).t, dtype=np.float64)


def _edge_warnings(built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield how many points lie on edges of a mesh wall that is not flat."""
    wall = built.wall
    if not isinstance(wall, MeshWall) or wall.is_planar:
        return
    for key, grid in {"sensor": capture.sensor_grid, "laser": capture.laser_grid}.items():
        on_edges = wall.on_edges(grid.wall_coordinates)
        if on_edges.any() and not (key == "laser" and capture.scan_type == "confocal"):
            yield (
                f"{int(on_edges.sum())} of {on_edges.size} {key} points lie on edges of the relay wall's triangles, "
                "where light between two triangles that face each other has no bound. Shift the grid, change its "
                "size, or use another number of points."
            )
