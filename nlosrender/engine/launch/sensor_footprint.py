"""Places in the footprints of sensor points, on the device: where a path starts, and what the gather looks from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.footprint import Footprint
from nlosrender.engine.launch.wall_points import RectanglePoints, WallPoints
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

    def at_random(self, sensors: WallPoints, key: mi.UInt32) -> WallPoints:
        """Return the sensor points moved to independent places, the same for the same ``key``."""
        across, up = (mi.Float(bits >> 8) * 2**-24 for bits in mi.sample_tea_32(key, mi.UInt32(KEY), 8))
        return self.moved(sensors, mi.Point2f(across, up))

    def moved(self, sensors: WallPoints, place: mi.Point2f) -> WallPoints:
        """Return the sensor points moved to a place (point of the unit square) in their footprints."""
        along = 0.5 * mi.warp.square_to_uniform_disk_concentric(place) if self.is_disc else mi.Point2f(place - 0.5)
        return self._wall.moved(sensors, mi.Vector2f(along.x * self._size.x, along.y * self._size.y))
