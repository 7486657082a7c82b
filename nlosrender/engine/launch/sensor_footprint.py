"""Places in the footprints of sensor points, on the device: where a path starts, and what the gather looks from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.footprint import Footprint
from nlosrender.engine.launch.device_arrays import columns
from nlosrender.engine.launch.wall_points import MovedPoints, RectanglePoints, WallPoints
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

# Roberts 2018, R2: powers of the inverse of the plastic number, the real root of x^3 = x + 1
PLASTIC = 1.32471795724474602596
KEY = 0x5EED  # of the hash that takes paths to places: another stream than those of directions


class SensorFootprint:
    """The footprint of every sensor point of a capture.

    Parameters
    ----------
    footprint
        Its shape and size.
    wall
        Moves the sensor points.
    metres_per_engine_unit
        Of the scene.
    seed
        Of the render, which moves all places.
    """

    def __init__(self, footprint: Footprint, wall: RectanglePoints, metres_per_engine_unit: float, seed: int):
        self.is_disc, self._wall = footprint.is_disc, wall
        self._shift = np.random.default_rng([seed, KEY]).random(2)
        sizes = (footprint.width, footprint.height)
        self._size = mi.Vector2f(*(dr.opaque(mi.Float, float(size / metres_per_engine_unit)) for size in sizes))

    def places(self, numbers: range | np.ndarray) -> Float64:
        """Return points (n, 2) of the unit square from a low-discrepancy sequence, by their numbers."""
        steps = np.array([1 / PLASTIC, 1 / PLASTIC**2])
        return np.asarray((np.asarray(numbers)[:, None] * steps + self._shift) % 1.0)

    def turned_places(self, numbers: range) -> Float64:
        """Return four points of the unit square for each number: one of ``places`` in four quarter turns.

        Their mean is the middle, and their second moments are alike in all directions: what is linear in the place, or
        falls off the same way around it, leaves no error, or little.
        """
        x, y = self.places(numbers).T - 0.5
        turned = np.stack([(x, y), (-y, x), (-x, -y), (y, -x)])  # (turn, axis, number)
        return np.asarray(turned.transpose(2, 0, 1).reshape(-1, 2) + 0.5)

    def at_random(self, sensors: WallPoints, key: mi.UInt32, active: mi.Bool) -> WallPoints:
        """Return the sensor points moved to independent places, the same for the same ``key``."""
        return self.moved(sensors, _random_place(key))

    def moved(self, sensors: WallPoints, place: mi.Point2f) -> WallPoints:
        """Return the sensor points moved to a place (point of the unit square) in their footprints."""
        along = 0.5 * mi.warp.square_to_uniform_disk_concentric(place) if self.is_disc else mi.Point2f(place - 0.5)
        return self._wall.moved(sensors, mi.Vector2f(along.x * self._size.x, along.y * self._size.y))


class PixelPlaces:
    """What the pixels of a camera see, on the device: places of the sensor points of a ``PixelFootprint``.

    Parameters
    ----------
    built
        A scene that has the pixels' areas.
    points
        Tells the leg from each place to the camera.
    index
        (n,) flat indices of sensor points.
    lanes
        Which of them each lane has.
    """

    def __init__(self, built: BuiltScene, points: MovedPoints, index: NDArray[np.integer], lanes: mi.UInt32):
        areas = None if built.pixels is None else built.pixels.areas
        assert areas is not None  # a capture with such a footprint has them
        self._built, self._points = built, points
        corners = areas.corners.reshape(-1, 3)[index] / built.metres_per_engine_unit
        self._corners = dr.gather(mi.Vector3f, mi.Vector3f(*columns(corners)), lanes)
        edges = areas.edges / built.metres_per_engine_unit
        self._right, self._up = (mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in edge)) for edge in edges)
        dr.eval(self._corners)

    def at_random(self, sensors: WallPoints, key: mi.UInt32, active: mi.Bool) -> WallPoints:
        """Return the sensor points where random rays of their pixels meet a surface; dark where they meet none."""
        place = _random_place(key)
        direction = dr.normalize(self._corners + place.x * self._right + place.y * self._up)
        point = sensors.interaction
        si = self._built.scene.ray_intersect(
            mi.Ray3f(self._points.device, direction), mi.RayFlags.All, coherent=False, active=active
        )
        is_met = si.is_valid() & (point.shape != None)  # noqa: E711
        si = dr.select(is_met, si, point)
        placed = self._points.seen_at(sensors, si, si.p - point.p)
        si.wi = dr.select(is_met, si.wi, mi.Vector3f(1, 0, 0))  # along the surface, where every BSDF is black
        return placed


def _random_place(key: mi.UInt32) -> mi.Point2f:
    """Return points of the unit square, the same for the same ``key``."""
    return mi.Point2f(*(mi.Float(bits >> 8) * 2**-24 for bits in mi.sample_tea_32(key, mi.UInt32(KEY), 8)))
