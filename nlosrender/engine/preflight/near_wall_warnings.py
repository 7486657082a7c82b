"""Warnings about surfaces close to the wall (float32 heights, light that no path finds) and edges of mesh walls."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.capture.grids import Capture
from nlosrender.engine.launch.near_surfaces import OFFSETS_LOST, nearest_above, wall_offset
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.walls.mesh_wall import MeshWall

MIN_HEIGHT = 1e-6  # engine units: ten float32 roundings (1e-7); below, the height of a tilted surface is off by 10 %


def near_wall_warnings(built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield the warnings about what a render does not get right close to the wall.

    Parameters
    ----------
    built, capture
        A scene with a wall, and what is measured of it.
    """
    yield from _near_warnings(built, capture)
    yield from _edge_warnings(built, capture)


def _near_warnings(built: BuiltScene, capture: Capture) -> Iterator[str]:
    """Yield a warning about a surface whose height above a laser or sensor point float32 does not resolve."""
    grids = {id(grid): grid for grid in (capture.laser_grid, capture.sensor_grid)}.values()
    height, (x, y, z) = min((nearest_above(built, grid) for grid in grids), key=lambda found: found[0])
    to_m = built.metres_per_engine_unit
    if not built.wall.is_planar:
        if height < OFFSETS_LOST * wall_offset(built):
            yield (
                f"a hidden surface lies {height * to_m:.1g} m before the relay wall at ({x:.4g}, {y:.4g}, "
                f"{z:.4g}) m of its frame: on a curved wall, light within "
                f"{OFFSETS_LOST * wall_offset(built) * to_m:.0g} m of it is not found."
            )
    elif height < MIN_HEIGHT:
        yield (
            f"a hidden surface lies {height * to_m:.1g} m before the wall at ({x:.4g}, {y:.4g}, "
            f"{z:.4g}) m of its frame, where float32 knows heights to about {MIN_HEIGHT / 10 * to_m:.0g} m: "
            "H there is not exact unless the surface is parallel to the wall."
        )


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
