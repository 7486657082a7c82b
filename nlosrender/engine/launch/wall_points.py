"""Laser and sensor points of the relay wall as device arrays.

Positions and grids are data, never constants of a kernel: one compiled kernel serves a whole sweep.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import columns, on_device
from nlosrender.scene.build import BuiltScene, SceneWithoutWall
from nlosrender.scene.loading.mitsuba_shapes import WALL_ID
from nlosrender.scene.pixel_points import FirstHits
from nlosrender.scene.pose import Float64
from nlosrender.scene.walls.mesh_wall import MIN_SAME_COSINE, too_fine

MESH_LIFT = 1e-4  # engine units: less than any fold of a mesh wall, far more than the rounding of its points
MESH_NUDGE = 1e-6  # engine units: off the edges of its triangles, where rays may slip through


@dataclass(frozen=True, eq=False)
class WallPoints:
    """Points of the relay wall on the device, in engine units, seen from a device (laser or sensor).

    ``delay_bins`` and ``delay_fraction`` are the constant part of the point's delay in bins, split in float64:
    a leg of kilometres must not eat the float32 precision of the path between the two legs.
    """

    interaction: mi.SurfaceInteraction3f  # on the wall; wi points to the device
    delay_bins: mi.Int32
    delay_fraction: mi.Float  # in [0, 1)
    share: mi.Float | None = None  # of the pulse's energy that a laser point gets; None: all of it

    def gather(self, index: mi.UInt32) -> WallPoints:
        """Return the points at ``index``, one per lane."""
        return WallPoints(
            dr.gather(mi.SurfaceInteraction3f, self.interaction, index),
            dr.gather(mi.Int32, self.delay_bins, index),
            dr.gather(mi.Float, self.delay_fraction, index),
            None if self.share is None else dr.gather(mi.Float, self.share, index),
        )

    def shared(self, light: mi.Spectrum) -> mi.Spectrum:
        """Return the light of a whole pulse as that of the laser points' shares of it."""
        return light if self.share is None else light * self.share


class MovedPoints:
    """Moves laser or sensor points, with the leg from each place to its device.

    Parameters
    ----------
    built, capture, time_axis
        The scene, what is measured of it, and its bins.
    device
        (3,) where the laser or the sensor stands [m, local frame].
    """

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, device: Float64):
        unit, counts_legs = built.metres_per_engine_unit, capture.account_first_and_last_bounces
        self.device = mi.Point3f(*(dr.opaque(mi.Float, float(value / unit)) for value in device))
        self._bins_per_unit = dr.opaque(mi.Float, float(unit / time_axis.bin_width_opl if counts_legs else 0.0))

    def seen_at(self, points: WallPoints, si: mi.SurfaceInteraction3f, along: mi.Vector3f) -> WallPoints:
        """Return the points at ``si``, moved ``along``, with the direction to the device and the leg there."""
        to_device = self.device - points.interaction.p
        leg = dr.norm(to_device)
        from_place = to_device - along
        new_leg = dr.norm(from_place)
        si.wi = si.to_local(from_place / dr.maximum(new_leg, 1e-30))
        # difference of the legs by their squares: legs of kilometres would cancel in float32
        longer = dr.dot(along, along - 2 * to_device) / dr.maximum(leg + new_leg, 1e-30)
        return replace(points, interaction=si, delay_fraction=points.delay_fraction + longer * self._bins_per_unit)


class RectanglePoints(MovedPoints):
    """Moves points along a rectangle wall: normal, shading frame and BSDF stay the same."""

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, device: Float64):
        super().__init__(built, capture, time_axis, device)
        lengths = built.metres_per_engine_unit / np.array([built.wall.width, built.wall.height])
        self._uv_per_unit = mi.Vector2f(*(dr.opaque(mi.Float, float(length)) for length in lengths))

    def moved(self, points: WallPoints, shift: mi.Vector2f) -> WallPoints:
        """Return the points moved by ``shift`` [engine units]."""
        along = mi.Vector3f(shift.x, shift.y, 0)
        si = mi.SurfaceInteraction3f(points.interaction)
        si.p = si.p + along
        si.uv = si.uv + mi.Vector2f(shift.x * self._uv_per_unit.x, shift.y * self._uv_per_unit.y)
        return self.seen_at(points, si, along)


def sensor_points(built: BuiltScene, capture: Capture, time_axis: TimeAxis, index: NDArray[np.integer]) -> WallPoints:
    """Return the sensor points with flat indices ``index``, legs and the window's start as their delay."""
    delay = (capture.sensor_legs.reshape(-1)[index] - time_axis.start_opl) / time_axis.bin_width_opl
    grid, hits = capture.sensor_grid, None if built.pixels is None else built.pixels.sensors
    return _wall_points(built, grid, hits, index, capture.sensor_position, delay)


def laser_points(built: BuiltScene, capture: Capture, time_axis: TimeAxis, index: NDArray[np.integer]) -> WallPoints:
    """Return the laser points with flat indices ``index``, their legs as delay."""
    delay = capture.laser_legs.reshape(-1)[index] / time_axis.bin_width_opl
    grid, hits = capture.laser_grid, None if built.pixels is None else built.pixels.lasers
    points = _wall_points(built, grid, hits, index, capture.laser_position, delay)
    weights = capture.laser_weights
    return points if weights is None else replace(points, share=on_device(mi.Float, weights[index]))


def _wall_points(
    built: BuiltScene,
    grid: PointGrid,
    hits: FirstHits | None,
    index: NDArray[np.integer],
    device: Float64,
    delay: Float64,
) -> WallPoints:
    positions, normals = grid.positions.reshape(-1, 3)[index], grid.normals.reshape(-1, 3)[index]
    point = mi.Point3f(*columns(positions / built.metres_per_engine_unit))
    normal = mi.Vector3f(*columns(normals))
    # The wall's own intersection gives shading frame and texture coordinates for every wall type and BSDF.
    if isinstance(built, SceneWithoutWall) and hits is not None:
        interaction = dr.gather(mi.SurfaceInteraction3f, hits.interactions, on_device(mi.UInt32, index))
    elif built.wall_shape.class_name() == "Mesh":
        interaction = _on_mesh(built, point, normal)
    else:
        interaction = built.wall_shape.ray_intersect(mi.Ray3f(point + 1e-2 * normal, -normal))
    interaction.p = point  # the exact grid point, not where a float32 ray met the wall
    to_device = device - positions
    to_device /= np.maximum(np.linalg.norm(to_device, axis=-1, keepdims=True), 1e-300)
    interaction.wi = interaction.to_local(mi.Vector3f(*columns(to_device)))
    if hits is not None and not hits.is_reached.all():  # seen along the surface, where every BSDF is black
        is_dark = on_device(mi.UInt32, ~hits.is_reached.ravel()[index]) > 0
        interaction.wi = dr.select(is_dark, mi.Vector3f(1, 0, 0), interaction.wi)
    whole = np.floor(delay)
    points = WallPoints(
        interaction,
        on_device(mi.Int32, np.clip(whole, -(2**30), 2**30)),
        on_device(mi.Float, delay - whole),
    )
    dr.eval(points.interaction, points.delay_bins, points.delay_fraction)
    return points


def _on_mesh(built: BuiltScene, point: mi.Point3f, normal: mi.Vector3f) -> mi.SurfaceInteraction3f:
    """Return where points of a mesh wall lie on the faces with these normals.

    Only a scene can intersect a mesh: one of the wall alone. Points on an edge are looked for beside it, too.
    """
    alone = mi.load_dict({"type": "scene", WALL_ID: built.wall_shape})
    frame = mi.Frame3f(normal)
    interaction, found = dr.zeros(mi.SurfaceInteraction3f, dr.width(point)), mi.Bool(False)
    for along, across in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        beside = point + MESH_NUDGE * (along * frame.s + across * frame.t)
        hit = alone.ray_intersect(mi.Ray3f(beside + MESH_LIFT * normal, -normal))
        is_own = hit.is_valid() & (dr.dot(hit.n, normal) > MIN_SAME_COSINE)
        interaction = dr.select(is_own & ~found, hit, interaction)
        found = found | is_own
    if not dr.all(found):
        missing = np.array(point).T[~np.array(found)][0] * built.metres_per_engine_unit
        place = ", ".join(f"{coordinate:.6g}" for coordinate in missing)
        raise too_fine(f"({place}) m of its frame: float32 does not find the point on it")
    return interaction
