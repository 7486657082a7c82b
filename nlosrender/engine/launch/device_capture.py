"""A capture of the relay wall on the device: what every engine of such captures launches its kernels with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE
from nlosrender.capture.footprint import PixelFootprint
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.energy_contrasts import no_contrasts
from nlosrender.engine.launch.flat_mirrors import FlatMirrors
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.mirror_connections import Mirrors, deposit_mirrored_bounce, mirrors_of
from nlosrender.engine.launch.mirror_index import lit_sphere
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.schedule import DEFAULT_SCHEDULE, ScheduleTuning
from nlosrender.engine.launch.second_bounce import deposit_second_bounce
from nlosrender.engine.launch.sensor_footprint import PixelPlaces, SensorFootprint
from nlosrender.engine.launch.surface_sampler import SurfaceSampler
from nlosrender.engine.launch.time_gate import CaptureTimeGate, light_leaves_window
from nlosrender.engine.launch.wall_points import MovedPoints, RectanglePoints, laser_points, sensor_points

if TYPE_CHECKING:
    from nlosrender.capture.bounces import BounceAxis
    from nlosrender.capture.grids import Capture
    from nlosrender.capture.plan import Batch
    from nlosrender.capture.time_axis import TimeAxis
    from nlosrender.engine.launch.pilot_points import Pilot
    from nlosrender.scene.build import BuiltScene


@dataclass(frozen=True)
class RenderOptions:
    """What is computed, by which techniques of Royo et al. 2022; the last five are set by tests alone."""

    bounces: BounceAxis
    laser_sampling: bool = True
    hidden_geometry_sampling: bool = True
    russian_roulette: bool = True
    channels: int = 1
    seed: int = 0
    temporal_kernel_bins: float = 0.0  # full width of the kernel in time [bins]; 0: a plain histogram
    replicas: int = 2  # independent estimates, whose spread is the stated error
    has_time_gate: bool = True  # Russian roulette on paths that can only bring light after the time window
    gate_survival: float = 1 / 8  # its probability to go on: light after the window is one number, seven eighths saved
    p_hidden_sampling: float | None = None  # of hidden geometry sampling at wall vertices; None: chosen from the scene
    schedule: ScheduleTuning = DEFAULT_SCHEDULE
    continuation_period: int | None = None  # one path in so many goes on after bounce 3; None: by a pilot


class DeviceCapture:
    """Points, histogram shapes and launch parameters of a capture.

    Parameters
    ----------
    built, capture, time_axis
        The scene and what is measured of it.
    options
        What is computed.
    """

    def __init__(self, built: BuiltScene, capture: Capture, time_axis: TimeAxis, options: RenderOptions):
        self.built, self.capture, self.time_axis, self.options = built, capture, time_axis, options
        self.sampler = SurfaceSampler(built)
        # Throughput is per (engine unit)^2: H falls with the square of a scene's size.
        self.scale = capture.laser_energy / built.metres_per_engine_unit**2

    @cached_property
    def footprint(self) -> SensorFootprint | None:
        """The area of the wall that sensor points stand for; None: they are points, or pixels."""
        capture, built = self.capture, self.built
        if capture.footprint is None or isinstance(capture.footprint, PixelFootprint):
            return None
        wall = RectanglePoints(built, capture, self.time_axis, capture.sensor_position)
        return SensorFootprint(capture.footprint, wall, built.metres_per_engine_unit, self.options.seed)

    @cached_property
    def capture_gate(self) -> CaptureTimeGate | None:
        """The end of the time window; None where no light arrives after it, or no path is to be ended for it."""
        if not self.options.has_time_gate:
            return None
        if not light_leaves_window(self.built, self.capture, self.time_axis, self.options.bounces):
            return None
        return CaptureTimeGate.of(self.built, self.capture, self.time_axis, self.options.gate_survival)

    @property
    def is_exhaustive(self) -> bool:
        """Whether every sensor point sees every laser point of a batch."""
        return self.capture.scan_type == "exhaustive"

    def shape(self, batch: Batch | Pilot, slots: int) -> HistogramShape:
        """Return the shape of a batch's histogram with ``slots`` bounce slots."""
        lasers, options = batch.lasers.size if self.is_exhaustive else 1, self.options
        return HistogramShape(
            options.replicas, batch.sensors.size, lasers, slots, options.channels, self.time_axis.n_bins
        )

    def sensor_indices(self, batch: Batch | Pilot) -> NDArray[np.uint32]:
        """Return the flat indices of a batch's sensor points."""
        return np.array(batch.sensors.flat_indices(self.capture.sensor_grid.nx), dtype=np.uint32)

    def laser_indices(self, batch: Batch | Pilot) -> NDArray[np.uint32]:
        """Return the flat indices of a batch's laser points; of spots that are lit at once all of them."""
        if self.capture.laser_weights is not None:
            return np.arange(self.capture.n_lasers, dtype=np.uint32)
        return np.array(batch.lasers.flat_indices(self.capture.laser_grid.nx), dtype=np.uint32)

    def lane_order(self, batch: Batch | Pilot) -> NDArray[np.int64]:
        """Return the order in which lanes take a batch's sensor points: rays of a packet start near each other."""
        positions = self.capture.sensor_grid.positions.reshape(-1, 3)[self.sensor_indices(batch)]
        return np.argsort(morton_order(positions), kind="stable")

    def launch_params(
        self, batch: Batch | Pilot, shape: HistogramShape, order: NDArray[np.int64] | None = None
    ) -> LaunchParams:
        """Return what the lanes of a batch read.

        Parameters
        ----------
        batch, shape
            What is rendered, and the shape of its histogram.
        order
            (n,) the batch's sensor points in the order in which lanes take them; None: as they are.
        """
        built, capture, time_axis = self.built, self.capture, self.time_axis
        index = self.sensor_indices(batch)
        sensors = sensor_points(built, capture, time_axis, index)
        lasers = laser_points(built, capture, time_axis, self.laser_indices(batch))
        lane = dr.arange(mi.UInt32, shape.lanes)
        sensor = lane % shape.sensors
        if order is not None:
            sensor = dr.gather(mi.UInt32, on_device(mi.UInt32, order), sensor)
        row_of_lane = lane // shape.sensors * shape.sensors + sensor
        is_confocal = capture.scan_type == "confocal"
        first_laser = mi.UInt32(sensor) if is_confocal else dr.zeros(mi.UInt32, shape.lanes)
        per_lane = sensors.gather(sensor)
        dr.eval(per_lane.interaction, per_lane.delay_bins, per_lane.delay_fraction, first_laser, row_of_lane)
        gate = self.capture_gate
        per_lane_lasers = shape.lasers if capture.laser_weights is None else capture.n_lasers
        return LaunchParams(
            built=built,
            sampler=self.sampler,
            sensors=per_lane,
            lasers=lasers,
            first_laser=first_laser,
            lasers_per_lane=per_lane_lasers,
            n_lasers=dr.opaque(mi.UInt32, per_lane_lasers),
            bins_per_unit=dr.opaque(mi.Float, built.metres_per_engine_unit / time_axis.bin_width_opl),
            time_gate=None if gate is None else gate.of_sensors(built, capture, time_axis, index, sensor),
            row_of_lane=row_of_lane,
            footprint=self._pixel_places(index, sensor) if self.sees_pixels else self.footprint,
        )

    @property
    def sees_pixels(self) -> bool:
        """Whether sensor points stand for all that their pixels see: paths sample the second bounce then, too."""
        return isinstance(self.capture.footprint, PixelFootprint)

    def _pixel_places(self, index: NDArray[np.integer], lanes: mi.UInt32) -> PixelPlaces:
        points = MovedPoints(self.built, self.capture, self.time_axis, self.capture.sensor_position)
        return PixelPlaces(self.built, points, index, lanes)

    @cached_property
    def mirrors(self) -> tuple[Mirrors, ...]:
        """Flat and round mirrors for connections to the lasers; none where only the second bounce is asked for."""
        highest = self.options.bounces.max_bounces
        if highest is not None and highest < THIRD_BOUNCE:
            return ()
        return mirrors_of(self.built, lit_sphere(self.built, self.capture))

    @cached_property
    def lone_mirror(self) -> FlatMirrors | None:
        """The flat mirror of a scene whose other surfaces have no delta lobes; None: there is no such mirror."""
        flat = self.mirrors[0] if len(self.mirrors) == 1 else None
        return flat if isinstance(flat, FlatMirrors) and flat.is_alone(self.built) else None

    def exact_light(self, batch: Batch | Pilot) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Yield bounce index and H (channel, 1, laser, sensor, row) of light that has no noise: one replica is enough.

        The second bounce, 0 on a planar wall, and the third bounce of laser points reflected by mirrors.
        """
        shape = replace(self.shape(batch, 1), replicas=1)
        if not (self.built.wall.is_planar or self.sees_pixels):
            histogram = DeviceHistogram(shape)
            deposit_second_bounce(self.launch_params(batch, shape), histogram)
            yield FIRST_BOUNCE, histogram.on_host(histogram.total(self.scale))
        if self.mirrors and self.capture.laser_spot_radius == 0:
            histogram = DeviceHistogram(shape)
            for mirrors in self.mirrors:
                deposit_mirrored_bounce(self.launch_params(batch, shape), mirrors, histogram)
            yield THIRD_BOUNCE, histogram.on_host(histogram.total(self.scale))

    def exact_squares(self, batch: Batch | Pilot) -> float:
        """Return the sum of the squares of exact light, which a target error counts in [(engine unit)^-4]."""
        return sum(float(np.square(light[..., :-1] / self.scale).sum()) for _, light in self.exact_light(batch))

    def histogram_without_samples(self, batch: Batch) -> Histogram:
        """Return a batch's histogram without samples: exact light, zero elsewhere."""
        shape, slots = self.shape(batch, 1), self.options.bounces.n_slots
        axes = (shape.channels, slots, shape.lasers, shape.sensors, shape.row)
        result = Histogram.of_rows(np.zeros(axes), np.zeros(axes), 0, no_contrasts(shape.channels, slots))
        self.add_exact_light(batch, result)
        return result

    def add_exact_light(self, batch: Batch, histogram: Histogram) -> None:
        """Add ``exact_light`` to a batch's histogram in place."""
        for bounce, light in self.exact_light(batch):
            slot = self.options.bounces.slot(bounce)
            histogram.mean[:, slot : slot + 1] += light[..., :-1]
            histogram.outside[:, slot : slot + 1] += light[..., -1]
            histogram.refuse_not_finite()
