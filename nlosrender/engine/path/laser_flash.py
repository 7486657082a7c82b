"""Places that a laser's flash lights, at random: a direction in its cone, and where it meets the rectangle wall."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from nlosrender.capture.flash import Flash
from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.wall_points import RectanglePoints, WallPoints
from nlosrender.scene.build import BuiltScene

MIN_COSINE = 1e-6  # between a ray of the flash and the wall's normal: below it the ray passes the wall


class LaserFlash:
    """The flash of a capture; directions are uniform by solid angle, as its energy is: every place counts equally.

    Parameters
    ----------
    flash
        Its cone.
    wall
        Moves the laser points.
    half_wall
        (2,) half the wall's width and height [engine units].
    """

    def __init__(self, flash: Flash, wall: RectanglePoints, half_wall: tuple[float, float]):
        self._wall = wall
        self._half_wall = mi.Vector2f(*(dr.opaque(mi.Float, length) for length in half_wall))
        self._one_minus_cosine = dr.opaque(mi.Float, 2 * math.sin(flash.angle / 4) ** 2)

    @classmethod
    def of(cls, built: BuiltScene, capture: Capture, time_axis: TimeAxis) -> LaserFlash | None:
        """Return that of a capture; None where its laser lights points or spots."""
        if capture.laser_flash is None:
            return None
        wall, unit = built.wall, built.metres_per_engine_unit
        points = RectanglePoints(built, capture, time_axis, capture.laser_position)
        return cls(capture.laser_flash, points, (wall.width / unit / 2, wall.height / unit / 2))

    def placed(self, lasers: WallPoints, square: mi.Point2f) -> tuple[WallPoints, mi.Bool]:
        """Return laser points (the axis on the wall) moved to where a direction of the cone meets the wall, if it does.

        ``square``: uniform random numbers, which choose the direction.
        """
        laser, target = self._wall.device, lasers.interaction.p
        below = square.x * self._one_minus_cosine  # 1 - cosine to the axis
        sine = dr.sqrt(dr.maximum(below * (2 - below), 0))
        turned = 2 * dr.pi * square.y
        local = mi.Vector3f(sine * dr.cos(turned), sine * dr.sin(turned), 1 - below)
        axis = target - laser
        direction = mi.Frame3f(axis / dr.norm(axis)).to_world(local)
        meets = direction.z < -MIN_COSINE
        distance = laser.z / dr.select(meets, -direction.z, 1)
        place = laser + distance * direction
        meets &= (dr.abs(place.x) <= self._half_wall.x) & (dr.abs(place.y) <= self._half_wall.y)
        return self._wall.moved(lasers, mi.Vector2f(place.x - target.x, place.y - target.y)), meets
