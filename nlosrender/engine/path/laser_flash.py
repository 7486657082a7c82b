"""Places that a laser's flash lights, at random: a direction in its cone, and where it meets the rectangle wall."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.wall_points import WallPoints
from nlosrender.scene.build import BuiltScene

MIN_COSINE = 1e-6  # between a ray of the flash and the wall's normal: below it the ray passes the wall


class LaserFlash:
    """The flash of a capture; directions are uniform by solid angle, as its energy is: every place counts equally."""

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis):
        unit, flash = built.metres_per_engine_unit, capture.laser_flash
        assert flash is not None
        self._laser = mi.Point3f(*(_opaque(value / unit) for value in capture.laser_position))
        self._half_wall = mi.Vector2f(*(_opaque(length / unit / 2) for length in (built.wall.width, built.wall.height)))
        self._one_minus_cosine = _opaque(2 * math.sin(flash.angle / 4) ** 2)
        counts_legs = capture.account_first_and_last_bounces
        self._bins_per_unit = _opaque(unit / time_axis.bin_width_opl if counts_legs else 0.0)

    def placed(self, lasers: WallPoints, square: mi.Point2f) -> tuple[WallPoints, mi.Bool]:
        """Return laser points (the axis on the wall) moved to where a direction of the cone meets the wall, if it does.

        ``square``: uniform random numbers, which choose the direction.
        """
        si = mi.SurfaceInteraction3f(lasers.interaction)
        along = si.p - self._laser
        leg = dr.norm(along)
        below = square.x * self._one_minus_cosine  # 1 - cosine to the axis
        sine = dr.sqrt(dr.maximum(below * (2 - below), 0))
        turned = 2 * dr.pi * square.y
        local = mi.Vector3f(sine * dr.cos(turned), sine * dr.sin(turned), 1 - below)
        direction = mi.Frame3f(along / leg).to_world(local)
        meets = direction.z < -MIN_COSINE
        distance = self._laser.z / dr.select(meets, -direction.z, 1)
        place = self._laser + distance * direction
        meets &= (dr.abs(place.x) <= self._half_wall.x) & (dr.abs(place.y) <= self._half_wall.y)
        shift = mi.Vector3f(place.x - si.p.x, place.y - si.p.y, 0)
        si.p = si.p + shift
        si.uv = si.uv + 0.5 * mi.Vector2f(shift.x, shift.y) / self._half_wall
        si.wi = si.to_local(-direction)
        # as in ``SensorFootprint.moved``: the legs are not taken from each other
        longer = dr.dot(shift, shift + 2 * along) / (leg + dr.norm(along + shift))
        delay = lasers.delay_fraction + longer * self._bins_per_unit
        return replace(lasers, interaction=si, delay_fraction=delay), meets


def _opaque(value: float) -> mi.Float:
    return dr.opaque(mi.Float, float(value))
