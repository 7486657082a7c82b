"""The end of the time window as a deadline: which paths can only bring light that comes too late to be seen.

Light after the window is reported as one number, so that a few of these paths, with more weight, do for all (Russian
roulette, Arvo and Kirk 1990): nothing is biased, neither in the window nor after it. How a path goes on is not known,
but no way to a laser point is shorter than the straight one, unless through a medium of an index below 1: there the
roulette may meet light of the window, too, which costs noise and no bias.
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
    """What a lane needs to tell that its path is late; lengths in engine units, none of them part of a kernel."""

    latest: mi.Float  # per lane: longest way from where its paths begin to a laser point that ends in the window
    low: mi.Point3f  # box around the laser points, or around the lane's own
    high: mi.Point3f
    survival: float  # probability of a path to go on once all its light comes after the window
    detour: mi.Float  # height to which light leaves a planar wall and comes back to it, there and back

    def is_past(self, opl: mi.Float, point: mi.Point3f, on_wall: mi.Bool) -> mi.Bool:
        """Return whether a path of length ``opl`` up to ``point`` can only bring light after the window.

        From a planar wall light first goes to the hidden geometry: as far as to the laser's mirror image there.
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
    """End most of the paths that have become late, once each; the others carry the light of all.

    Parameters
    ----------
    time_gate
        None: no path is late.
    generator
        Drawn from by late paths alone: where there are none, no path's numbers change.
    alive, is_past_gate, throughput
        Which paths are under way, which of them have survived this, and what they carry.
    opl, point, on_wall
        Length of the path up to its last vertex [engine units], that vertex, and whether it lies on the relay wall.

    Returns
    -------
    tuple
        ``alive``, ``is_past_gate`` and ``throughput``.
    """
    if time_gate is None:
        return alive, is_past_gate, throughput
    late = alive & ~is_past_gate & time_gate.is_past(opl, point, on_wall)
    survives = generator.next_float32(late) < time_gate.survival
    return alive & (~late | survives), is_past_gate | late, dr.select(late, throughput / time_gate.survival, throughput)


@dataclass(frozen=True, eq=False)
class CaptureTimeGate:
    """How far light of a capture may go and still arrive in its time window [engine units].

    Points and legs are those of the whole capture: what is late must not depend on how it is cut into batches.
    """

    sensor_box: Bounds
    laser_box: Bounds
    survival: float  # as ``TimeGate.survival``
    longest: float  # way from a sensor point to a laser point
    detour: float

    @classmethod
    def of(cls, built: BuiltScene, capture: Capture, time_axis: TimeAxis, survival: float) -> CaptureTimeGate:
        """Return the horizon of a capture."""
        lowest = built.hidden_bounds[0][2] if built.wall.is_planar and built.hidden_bounds is not None else 0.0
        sensor_legs, laser_legs = capture.sensor_legs.reshape(-1), capture.laser_legs.reshape(-1)
        confocal = capture.scan_type == "confocal"
        legs = (sensor_legs + laser_legs).min() if confocal else sensor_legs.min() + laser_legs.min()
        return cls(
            _box(capture.sensor_grid, built.metres_per_engine_unit),
            _box(capture.laser_grid, built.metres_per_engine_unit),
            survival,
            float(time_axis.end_opl - legs + capture.laser_spot_radius) / built.metres_per_engine_unit,
            2 * max(float(lowest), 0.0) / built.metres_per_engine_unit,
        )

    def is_beyond(self, points: Float64) -> NDArray[np.bool_]:
        """Return which points (n, 3) lie only on ways that end after the window, (n,)."""
        ways = distance_to_box(points, self.sensor_box) + distance_to_box(points, self.laser_box)
        return ways > self.longest

    def of_points(self, points: Float64) -> TimeGate:
        """Return the deadline of walks from ``points`` (n, 3), one lane each, that sensor points look at."""
        latest = self.longest - distance_to_box(points, self.sensor_box)
        low, high = (_opaque_point(corner) for corner in self.laser_box)
        return TimeGate(on_device(mi.Float, latest), low, high, self.survival, dr.opaque(mi.Float, self.detour))

    def of_sensors(
        self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, index: NDArray[np.integer], sensor: mi.UInt32
    ) -> TimeGate:
        """Return the deadline of paths from the sensor points ``index`` (n,), of which lanes have the ``sensor``-th."""
        own = capture.scan_type == "confocal"
        sensor_legs, laser_legs = capture.sensor_legs.reshape(-1), capture.laser_legs.reshape(-1)
        legs = sensor_legs[index] + (laser_legs[index] if own else laser_legs.min())
        latest = (time_axis.end_opl - legs + capture.laser_spot_radius) / built.metres_per_engine_unit
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


def _box(grid: PointGrid, unit: float) -> Bounds:
    points = grid.positions.reshape(-1, 3) / unit
    return points.min(axis=0), points.max(axis=0)


def _opaque_point(corner: Float64) -> mi.Point3f:
    return mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in corner))
