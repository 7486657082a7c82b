"""Places in the footprints of sensor points, on the device: where a path starts, and what the gather looks from.

A footprint lies on a rectangle wall. Its sensor point moves along the wall: normal, shading frame and BSDF stay, and
texture coordinates, the direction to the sensor and the leg to it change.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.wall_points import WallPoints
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

# Roberts 2018, R2: powers of the inverse of the plastic number, the real root of x^3 = x + 1
PLASTIC = 1.32471795724474602596
KEY = 0x5EED  # of the hash that takes paths to places: another stream than those of directions


class SensorFootprint:
    """The footprint of every sensor point of a capture; ``seed``: of the render, which moves all places.

    Parameters
    ----------
    built, capture, time_axis, seed
        The scene, what is measured of it, and the seed of the render.
    """

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, seed: int):
        unit = built.metres_per_engine_unit
        assert capture.footprint is not None
        self.is_disc, self._shift = capture.footprint.is_disc, np.random.default_rng([seed, KEY]).random(2)
        self._size = mi.Vector2f(
            *(_opaque(length / unit) for length in (capture.footprint.width, capture.footprint.height))
        )
        self._device = mi.Point3f(*(_opaque(value / unit) for value in capture.sensor_position))
        self._uv_per_unit = mi.Vector2f(*(_opaque(unit / length) for length in (built.wall.width, built.wall.height)))
        counts_legs = capture.account_first_and_last_bounces
        self._bins_per_unit = _opaque(unit / time_axis.bin_width_opl if counts_legs else 0.0)

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
        across, up = along.x * self._size.x, along.y * self._size.y
        shift = mi.Vector3f(across, up, 0)
        si = mi.SurfaceInteraction3f(sensors.interaction)
        to_device = self._device - si.p
        leg = dr.norm(to_device)
        si.p = si.p + shift
        si.uv = si.uv + mi.Vector2f(across * self._uv_per_unit.x, up * self._uv_per_unit.y)
        from_place = to_device - shift
        new_leg = dr.norm(from_place)
        si.wi = si.to_local(from_place / dr.maximum(new_leg, 1e-30))
        # the difference of the legs without taking them from each other: they may be kilometres
        longer = dr.dot(shift, shift - 2 * to_device) / dr.maximum(leg + new_leg, 1e-30)
        return replace(sensors, interaction=si, delay_fraction=sensors.delay_fraction + longer * self._bins_per_unit)


def _opaque(value: float) -> mi.Float:
    return dr.opaque(mi.Float, float(value))
