"""What every launch of an engine reads: scene, wall points, and the conversion from engine units to bins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.sensor_footprint import PixelPlaces, SensorFootprint

if TYPE_CHECKING:
    from nlosrender.engine.launch.surface_sampler import SurfaceSampler
    from nlosrender.engine.launch.time_gate import TimeGate
    from nlosrender.engine.launch.wall_points import WallPoints
    from nlosrender.scene.build import BuiltScene

MAX_SURVIVAL = 0.95  # of Russian roulette by the albedo: paths end in a white closed room, after 20 bounces on average


@dataclass(frozen=True, eq=False)
class LaunchParams:
    """Everything a launch reads: scene, points, and the conversion from engine units to bins."""

    built: BuiltScene
    sampler: SurfaceSampler
    sensors: WallPoints  # one per lane
    lasers: WallPoints  # all lasers of the batch
    first_laser: mi.UInt32  # per lane: confocal lanes have their own laser, others start at 0
    lasers_per_lane: int
    n_lasers: mi.UInt32  # opaque copy of ``lasers_per_lane``: its value is not part of the kernel
    bins_per_unit: mi.Float  # engine unit / bin width, opaque
    time_gate: TimeGate | None  # None: all light arrives before the end of the window
    row_of_lane: mi.UInt32  # per lane: which lane's rows of the histogram it adds to
    footprint: SensorFootprint | PixelPlaces | None  # None: sensor points are points

    def in_footprint(self, key: mi.UInt32, active: mi.Bool) -> Self:
        """Return these with the sensor points of paths, known by their ``key``, at random in the footprint."""
        if self.footprint is None:
            return self
        return replace(self, sensors=self.footprint.at_random(self.sensors, key, active))

    def delayed(self, delay_fraction: mi.Float) -> Self:
        """Return these with the delay of sensor points that ``in_footprint`` has moved."""
        if self.footprint is None:
            return self
        return replace(self, sensors=replace(self.sensors, delay_fraction=delay_fraction))

    def at_place(self, place: mi.Point2f) -> Self:
        """Return these with the sensor points at a place (point of the unit square) in the footprint."""
        if not isinstance(self.footprint, SensorFootprint):
            return self
        moved = self.footprint.moved(self.sensors, place)
        dr.eval(moved.interaction, moved.delay_bins, moved.delay_fraction)
        return replace(self, sensors=moved)

    def gather_lanes(self, index: mi.UInt32) -> Self:
        """Return what the lanes at ``index`` read."""
        sensors, first_laser = self.sensors.gather(index), dr.gather(mi.UInt32, self.first_laser, index)
        row_of_lane = dr.gather(mi.UInt32, self.row_of_lane, index)
        dr.eval(sensors.interaction, sensors.delay_bins, sensors.delay_fraction, first_laser, row_of_lane)
        return replace(self, sensors=sensors, first_laser=first_laser, row_of_lane=row_of_lane)

    def delay_bin(self, lasers: WallPoints, opl: mi.Float) -> mi.Int32:
        """Return the bin (any integer) of paths of length ``opl`` [engine units] from ``lasers`` to sensor points."""
        delay = opl * self.bins_per_unit + (lasers.delay_fraction + self.sensors.delay_fraction)
        return mi.Int32(dr.floor(dr.minimum(delay, 1e9))) + lasers.delay_bins + self.sensors.delay_bins
