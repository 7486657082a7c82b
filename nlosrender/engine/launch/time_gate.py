"""Time gate: Russian roulette on paths whose light can only arrive after the time window (Arvo & Kirk 1990).

Light after the window is one number per row, for which few paths of larger weight suffice; nothing is biased, neither
inside the window nor after it. The straight line to the nearest laser point is a lower bound on the rest of a path,
except through a medium of index below 1: there the roulette may end paths of the window, at the cost of noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.arrivals import latest_of_bounce
from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import columns, on_device
from nlosrender.scene.bounding_box import Bounds, distance_to_box
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64


@dataclass(frozen=True, eq=False)
class TimeGate:
    """What decides whether a lane's path is past the gate; lengths in engine units, all opaque or per lane."""

    latest: mi.Float  # per lane: longest path from its start to a laser point that arrives in the window
    low: mi.Point3f  # box around the laser points, or around the lane's own
    high: mi.Point3f
    survival: float  # probability to continue once all light of a path arrives after the window
    # twice the height of the hidden geometry over a planar wall: light of the wall goes there and back
    detour: mi.Float

    def is_past(self, opl: mi.Float, point: mi.Point3f, on_wall: mi.Bool) -> mi.Bool:
        """Return whether a path of length ``opl`` up to ``point`` can only bring light after the window.

        Light of a planar wall goes to the hidden geometry first: as far as to a laser mirrored at its lowest height.
        """
        reach = dr.maximum(dr.maximum(self.low - point, point - self.high), 0)
        reach.z = dr.maximum(reach.z, dr.select(on_wall, self.detour, 0))
        return opl + dr.norm(reach) > self.latest


def time_gate_roulette(
    time_gate: TimeGate | None,
    generator: mi.PCG32,
    alive: mi.Bool,
    is_past_gate: mi.Bool,
    opl: mi.Float,
    point: mi.Point3f,
    on_wall: mi.Bool,
    throughput: mi.Spectrum,
) -> tuple[mi.Bool, mi.Bool, mi.Spectrum]:
    """Russian roulette, once per path, when it passes the gate; survivors are weighted by 1 / survival.

    Parameters
    ----------
    time_gate
        None: no path passes it.
    generator
        Drawn from only for paths that pass the gate: without any, no path's random numbers change.
    alive, is_past_gate, throughput
        Paths under way, those among them that have survived this roulette, and throughput.
    opl, point, on_wall
        Length of the path up to its last vertex [engine units], that vertex, and whether it lies on the relay wall.

    Returns
    -------
    tuple
        ``alive``, ``is_past_gate`` and ``throughput``.
    """
    if time_gate is None:
        return alive, is_past_gate, throughput
    passes = alive & ~is_past_gate & time_gate.is_past(opl, point, on_wall)
    survives = generator.next_float32(passes) < time_gate.survival
    throughput = dr.select(passes, throughput / time_gate.survival, throughput)
    return alive & (~passes | survives), is_past_gate | passes, throughput


@dataclass(frozen=True, eq=False)
class CaptureTimeGate:
    """The time gate of a whole capture [engine units]: path lengths whose light arrives in its time window.

    Points and legs are those of the whole capture, so that batches and shards do not show.
    """

    sensor_box: Bounds
    laser_box: Bounds
    survival: float  # as ``TimeGate.survival``
    longest: float  # path from a sensor point to a laser point that may arrive in the window
    detour: float

    @classmethod
    def of(cls, built: BuiltScene, capture: Capture, time_axis: TimeAxis, survival: float) -> CaptureTimeGate:
        """Return the time gate of a capture."""
        lowest = built.hidden_bounds[0][2] if built.wall.is_planar and built.hidden_bounds is not None else 0.0
        sensor_legs, laser_legs = capture.sensor_legs.reshape(-1), capture.laser_legs.reshape(-1)
        confocal = capture.scan_type == "confocal"
        legs = (sensor_legs + laser_legs).min() if confocal else sensor_legs.min() + laser_legs.min()
        return cls(
            _box(capture.sensor_grid, built.metres_per_engine_unit),
            _box(capture.laser_grid, built.metres_per_engine_unit),
            survival,
            float(time_axis.end_opl - legs + _slack(capture)) / built.metres_per_engine_unit,
            2 * max(float(lowest), 0.0) / built.metres_per_engine_unit,
        )

    def is_past(self, points: Float64) -> NDArray[np.bool_]:
        """Return (n,) which points (n, 3) lie only on paths that arrive after the window."""
        ways = distance_to_box(points, self.sensor_box) + distance_to_box(points, self.laser_box)
        return ways > self.longest

    def of_points(self, points: Float64) -> TimeGate:
        """Return the gate of VPL subpaths from ``points`` (n, 3), one lane each."""
        latest = self.longest - distance_to_box(points, self.sensor_box)
        low, high = (_opaque_point(corner) for corner in self.laser_box)
        return TimeGate(on_device(mi.Float, latest), low, high, self.survival, dr.opaque(mi.Float, self.detour))

    def of_sensors(
        self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, index: NDArray[np.integer], sensor: mi.UInt32
    ) -> TimeGate:
        """Return the gate of paths from the sensor points ``index`` (n,); lane i starts at number ``sensor[i]``."""
        own = capture.scan_type == "confocal"
        sensor_legs, laser_legs = capture.sensor_legs.reshape(-1), capture.laser_legs.reshape(-1)
        legs = sensor_legs[index] + (laser_legs[index] if own else laser_legs.min())
        latest = (time_axis.end_opl - legs + _slack(capture)) / built.metres_per_engine_unit
        low, high = (_opaque_point(corner) for corner in self.laser_box)
        if own:
            points = mi.Point3f(
                *columns(capture.laser_grid.positions.reshape(-1, 3)[index] / built.metres_per_engine_unit)
            )
            low = high = dr.gather(mi.Point3f, points, sensor)
        per_lane = dr.gather(mi.Float, on_device(mi.Float, latest), sensor)
        dr.eval(per_lane, low)
        return TimeGate(per_lane, low, high, self.survival, dr.opaque(mi.Float, self.detour))


def light_leaves_window(built: BuiltScene, capture: Capture, time_axis: TimeAxis, bounces: BounceAxis) -> bool:
    """Return whether light may arrive after the time window, as far as boxes can tell."""
    latest = latest_of_bounce(capture, built.wall, built.hidden_bounds, bounces.max_bounces)
    return latest > time_axis.end_opl


def _slack(capture: Capture) -> float:
    """Return by how much light may arrive earlier than from laser and sensor points [m]."""
    reach = 0.0 if capture.laser_flash is None else 2 * capture.laser_flash.reach
    return reach + capture.laser_spot_radius + (0.0 if capture.footprint is None else 2 * capture.footprint.reach)


def _box(grid: PointGrid, unit: float) -> Bounds:
    points = grid.positions.reshape(-1, 3) / unit
    return points.min(axis=0), points.max(axis=0)


def _opaque_point(corner: Float64) -> mi.Point3f:
    return mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in corner))
