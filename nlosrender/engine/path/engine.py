"""The path engine: ``render(batch) -> Histogram`` until the asked-for error, sample count or time is reached."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import MAX_SUMS, Batch
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import laser_points, on_device, sensor_points
from nlosrender.engine.launch.energy_contrasts import no_contrasts
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaneRandomness, LaunchParams, PathSettings
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.occlusion import nothing_occludes
from nlosrender.engine.launch.passes import Passes
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of
from nlosrender.engine.launch.plain_diffuse import is_plain_diffuse
from nlosrender.engine.launch.sample_schedule import (
    FIRST_SAMPLES,
    Budget,
    Schedule,
    accumulate,
    calibrated_by_pilot,
    lane_randomness,
    pilot_replicas,
)
from nlosrender.engine.launch.second_bounce import deposit_second_bounce
from nlosrender.engine.launch.surface_sampler import SurfaceSampler
from nlosrender.engine.launch.systematic_sequence import SystematicSequence
from nlosrender.engine.launch.temporal_kernel import TemporalKernel
from nlosrender.engine.launch.time_gate import CaptureTimeGate, light_leaves_window
from nlosrender.engine.path.full_loop import load_path_integrator
from nlosrender.engine.path.hidden_aabb import HiddenAabb
from nlosrender.engine.path.roulette import (
    DIRECT,
    LEAST_PATHS,
    PILOT_SAMPLES,
    PILOT_SEED,
    TRACED,
    best_continuation_period,
    first_phases,
)
from nlosrender.engine.path.technique_mixture import box_often_missed, choose_p_hidden_sampling
from nlosrender.engine.path.third_bounce_loop import are_direct
from nlosrender.errors import RenderError
from nlosrender.scene.build import BuiltScene


@dataclass(frozen=True)
class RenderOptions:
    """The techniques of Royo et al. 2022 and what is computed."""

    bounces: BounceAxis
    laser_sampling: bool = True
    hidden_geometry_sampling: bool = True
    russian_roulette: bool = True
    channels: int = 1
    seed: int = 0
    replicas: int = 2
    has_time_gate: bool = True  # few paths go on that can only bring light after the time window
    temporal_kernel_bins: float = 0.0  # full width of the kernel in time [bins]; 0: a plain histogram
    p_hidden_sampling: float | None = None  # share of hidden geometry sampling on the wall; None: chosen from the scene
    continuation_period: int | None = None  # one path in so many goes on after bounce 3; None: by a pilot


class PathEngine:
    """Unbiased path tracing of a capture, batch by batch.

    Parameters
    ----------
    built, capture, time_axis
        The scene and what is measured of it.
    options
        Techniques, bounces, seed.
    first_bounce
        Lowest bounce to compute, >= 3, for engines that know the lower ones.
    reason
        Why this engine renders the scene, in plain words.
    """

    name = "path"

    def __init__(
        self,
        built: BuiltScene,
        capture: Capture,
        time_axis: TimeAxis,
        options: RenderOptions,
        first_bounce: int = THIRD_BOUNCE,
        reason: str = "asked for",
    ):
        self.reason = reason
        self.built, self.capture, self.time_axis, self.options = built, capture, time_axis, options
        self.sampler = SurfaceSampler(built)
        self.first_bounce = first_bounce
        # Throughput is per (engine unit)^2: H falls with the square of a scene's size.
        self.scale = capture.laser_energy / built.unit**2
        self.kernel = TemporalKernel(options.temporal_kernel_bins) if options.temporal_kernel_bins > 0 else None
        # None: nothing can arrive after the window, and no path is ended for it
        has_time_gate = options.has_time_gate and light_leaves_window(built, capture, time_axis, options.bounces)
        self.capture_gate = CaptureTimeGate.of(built, capture, time_axis) if has_time_gate else None
        self.compile_seconds = 0.0

    # Made when they are needed: an engine that only lends its points to a gather samples no surfaces.

    @cached_property
    def p_hidden_sampling(self) -> float:
        """Share of hidden geometry sampling at a vertex of the wall."""
        if self.options.p_hidden_sampling is not None:
            return self.options.p_hidden_sampling
        if not self.options.hidden_geometry_sampling:
            return 0.0
        return choose_p_hidden_sampling(self.built, self.sampler, self.capture, self.time_axis)

    @cached_property
    def settings(self) -> PathSettings:
        """What the integrator computes, and how."""
        flags = [shape.bsdf().flags() for shape in self.built.hidden_shapes]
        return PathSettings(
            bounces=self.options.bounces,
            first_bounce=self.first_bounce,
            p_hidden_sampling=self.p_hidden_sampling,
            laser_sampling=self.options.laser_sampling,
            russian_roulette=self.options.russian_roulette,
            spot_radius=self.capture.laser_spot_radius / self.built.unit,
            needs_visibility=not nothing_occludes(self.built),
            has_transmission=any(bool(flag & mi.BSDFFlags.Transmission) for flag in flags),
            is_plain_diffuse=is_plain_diffuse(self.built),
        )

    @cached_property
    def hidden_aabb(self) -> HiddenAabb | None:
        """Box around the hidden geometry; None where few rays from the wall miss it, or all are sent to points."""
        if self.p_hidden_sampling > 0:
            return None
        return box_often_missed(self.built, self.capture, self.time_axis)

    @cached_property
    def integrator(self) -> mi.Integrator:
        """Mitsuba's plugin that traces the paths."""
        return load_path_integrator(self.settings)

    def render(
        self,
        batch: Batch,
        budget: Budget,
        passes: Passes | None = None,
        known_squares: float = 0.0,
    ) -> Histogram:
        """Render one batch.

        Parameters
        ----------
        batch, budget, passes
            What to render, when to stop; who is told between two launches how far it is.
        known_squares
            Sum of the squares of H known from elsewhere, which ``target_error`` counts in [(engine unit)^-4]; those of
            the second bounce not among them.

        Returns
        -------
        Histogram
            Axes (channel, bounce, laser, sensor, bin), laser and sensor flattened row by row.

        Raises
        ------
        RenderError
            The batch is too large for 32-bit indices, or the result is not finite.
        """
        bounces = self.options.bounces
        shape = self.shape(batch, self.n_slots)
        if shape.size > MAX_SUMS:
            raise RenderError(
                f"a batch of {shape.size:.2e} sums is more than 32-bit indices reach; lower render.memory_limit"
            )
        if self._has_bounces:
            params = self._of_paths(batch, shape, self._continuation_period(budget))
            if budget.target_error is not None:
                known_squares += self.second_squares(batch)
            schedule = Schedule(budget, shape.replicas, known_squares, shape.lanes * shape.lasers)
            mean, variance, per_lane, contrasts = self._accumulate(batch, shape, params, schedule, passes or Passes())
        else:
            axes = (shape.channels, bounces.n_slots, shape.lasers, shape.sensors, shape.row)
            mean, variance, per_lane = np.zeros(axes), np.zeros(axes), 0
            contrasts = no_contrasts(shape.channels, bounces.n_slots)
        if not self.built.wall.is_planar:
            mean[:, :1] += self.second_bounce(batch)
        if not (np.isfinite(mean).all() and np.isfinite(variance).all()):
            raise RenderError("the path engine produced a value that is not finite; please report the configuration")
        return Histogram(mean[..., :-1], variance[..., :-1], mean[..., -1], per_lane * shape.replicas, contrasts)

    def calibrate(self, budget: Budget, known_squares: float = 0.0, seconds: float = math.inf) -> Budget:
        """Turn a target error into samples for the whole capture, found by a pilot on a few of its points.

        The number does not depend on how the capture is cut. Budgets with ``spp`` or a time limit stay as they are.

        Parameters
        ----------
        budget
            What is asked for.
        known_squares
            As for ``render``, over the pilot's points.
        seconds
            As for ``calibrated_by_pilot``.
        """
        if budget.is_calibrated:
            return budget
        if not self._has_bounces:
            return budget
        pilot = pilot_of(self.capture)
        shape = replace(
            self.shape(pilot, self.n_slots), replicas=pilot_replicas(self.options.replicas, pilot.sensors.size)
        )
        params = self._of_paths(pilot, shape, self._continuation_period(budget))

        def look(schedule: Schedule, passes: Passes) -> None:
            self._accumulate(pilot, shape, params, schedule, passes)

        known_squares += self.second_squares(pilot)
        least = FIRST_SAMPLES * self.options.replicas
        return calibrated_by_pilot(budget, shape.replicas, look, known_squares, seconds, least)

    @property
    def n_slots(self) -> int:
        """Bounce slots that are sampled: all but that of the second bounce, which is computed."""
        bounces = self.options.bounces
        return max(1, bounces.n_slots - 1) if bounces.split else 1

    @property
    def _has_bounces(self) -> bool:
        highest = self.options.bounces.max_bounces
        return highest is None or highest >= self.first_bounce

    def _accumulate(
        self, batch: Batch | Pilot, shape: HistogramShape, params: LaunchParams, schedule: Schedule, passes: Passes
    ) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        bounces, row_points = self.options.bounces, self.sensor_indices(batch)
        points = row_points[self.lane_order(batch)]
        seed, kernel = self.options.seed, self.kernel

        def launch(histogram: DeviceHistogram, randomness: LaneRandomness, more: int) -> LaneRandomness:
            if randomness.phase is None:
                phases = first_phases(
                    seed, points, self.capture.sensor_grid.nx, shape.lanes, params.continuation_period
                )
                randomness = replace(randomness, phase=phases)
            systematic = randomness.systematic
            if systematic is None or systematic.stage != schedule.stage:
                systematic = SystematicSequence.of_paths(schedule.stage, randomness.sequence[0])
            advanced, systematic = self.integrator.accumulate(params, histogram, randomness, systematic, more)
            return replace(advanced, systematic=replace(systematic, stage=schedule.stage))

        first = 1 if bounces.split else 0  # the second bounce has slot 0
        slots = range(-first, bounces.n_slots - first)
        result = accumulate(shape, points, seed, launch, schedule, passes, self.scale, slots, kernel, row_points)
        self.compile_seconds += result.compile_seconds
        return result.mean, result.variance, result.per_lane, result.contrasts

    def shape(self, batch: Batch | Pilot, slots: int) -> HistogramShape:
        """Return the shape of a batch's histogram with ``slots`` bounce slots."""
        lasers = batch.lasers.size if self.capture.scan_type == "exhaustive" else 1
        options = self.options
        return HistogramShape(
            options.replicas, batch.sensors.size, lasers, slots, options.channels, self.time_axis.n_bins
        )

    def launch_params(
        self,
        batch: Batch | Pilot,
        shape: HistogramShape,
        order: NDArray[np.int64] | None = None,
    ) -> LaunchParams:
        """Return what the lanes of a batch read, whether they trace paths or not.

        Parameters
        ----------
        batch, shape
            What is rendered, and the shape of its histogram.
        order
            (n,) the batch's sensor points in the order in which lanes take them; None: as they are.
        """
        index, capture_gate = self.sensor_indices(batch), self.capture_gate
        sensors = sensor_points(self.built, self.capture, self.time_axis, index)
        lasers = laser_points(self.built, self.capture, self.time_axis, self.laser_indices(batch))
        lane = dr.arange(mi.UInt32, shape.lanes)
        sensor = lane % shape.sensors
        if order is not None:
            sensor = dr.gather(mi.UInt32, on_device(mi.UInt32, order), sensor)
        row_of_lane = lane // shape.sensors * shape.sensors + sensor
        confocal = self.capture.scan_type == "confocal"
        first_laser = mi.UInt32(sensor) if confocal else dr.zeros(mi.UInt32, shape.lanes)
        per_lane = sensors.gather(sensor)
        dr.eval(per_lane.interaction, per_lane.delay_bins, per_lane.delay_fraction, first_laser, row_of_lane)
        time_gate = None
        if capture_gate is not None:
            time_gate = capture_gate.of_sensors(self.built, self.capture, self.time_axis, index, sensor)
        return LaunchParams(
            built=self.built,
            sampler=self.sampler,
            sensors=per_lane,
            lasers=lasers,
            first_laser=first_laser,
            lasers_per_lane=shape.lasers,
            n_lasers=dr.opaque(mi.UInt32, shape.lasers),
            bins_per_unit=dr.opaque(mi.Float, self.built.unit / self.time_axis.bin_width_opl),
            time_gate=time_gate,
            hidden_aabb=None,
            row_of_lane=row_of_lane,
            continuation_period=dr.opaque(mi.UInt32, 1),
        )

    def _of_paths(self, batch: Batch | Pilot, shape: HistogramShape, continuation_period: int) -> LaunchParams:
        """Return what the lanes of a batch read that trace paths, neighbours together; see ``LaunchParams``."""
        params = self.launch_params(batch, shape, self.lane_order(batch))
        if self.p_hidden_sampling > 0:
            self.sampler.set_up()
        return replace(
            params, hidden_aabb=self.hidden_aabb, continuation_period=dr.opaque(mi.UInt32, continuation_period)
        )

    def lane_order(self, batch: Batch | Pilot) -> NDArray[np.int64]:
        """Return the order in which lanes take a batch's sensor points: rays of a packet start near each other."""
        positions = self.capture.sensor_grid.positions.reshape(-1, 3)[self.sensor_indices(batch)]
        return np.argsort(morton_order(positions), kind="stable")

    def _continuation_period(self, budget: Budget) -> int:
        """Return of how many paths one goes on beyond the third bounce: the same however the capture is cut."""
        if not self.settings.has_continuation_roulette:
            return 1
        if self.options.continuation_period is not None:
            return self.options.continuation_period
        has_end = budget.target_error is None and budget.time_limit_s is None
        if has_end and (budget.spp or 0) * self.capture.n_sensors < LEAST_PATHS:
            return 1
        return self._best_period

    @cached_property
    def _best_period(self) -> int:
        direct, split = are_direct(self.settings, self.sampler), self.options.bounces.split
        return best_continuation_period(self._pilot_variance, DIRECT if direct else TRACED, split)

    def _pilot_variance(self, continuation_period: int) -> float:
        """Return the variance of H, summed, of a few samples at a few points: in arbitrary units."""
        pilot, nx = pilot_of(self.capture), self.capture.sensor_grid.nx
        replicas = pilot_replicas(self.options.replicas, pilot.sensors.size)
        shape, order = replace(self.shape(pilot, self.n_slots), replicas=replicas), self.lane_order(pilot)
        params, histogram = self._of_paths(pilot, shape, continuation_period), DeviceHistogram(shape, self.kernel)
        points = self.sensor_indices(pilot)[order]
        phases = first_phases(PILOT_SEED, points, nx, shape.lanes, params.continuation_period)
        random = replace(lane_randomness(shape, points, PILOT_SEED), phase=phases)
        systematic = SystematicSequence.of_paths(range(PILOT_SAMPLES), random.sequence[0])
        self.integrator.accumulate(params, histogram, random, systematic, PILOT_SAMPLES)
        return float(histogram.on_host(histogram.statistics(PILOT_SAMPLES)[1])[..., :-1].sum())

    def second_squares(self, batch: Batch | Pilot) -> float:
        """Return the sum of the squares of the second bounce, which a target error counts in [(engine unit)^-4]."""
        if self.built.wall.is_planar:
            return 0.0
        return float(np.square(self.second_bounce(batch)[..., :-1] / self.scale).sum())

    def second_bounce(self, batch: Batch | Pilot) -> np.ndarray:
        """Return the second bounce (channel, 1, laser, sensor, row): exact, so one replica computes it."""
        shape = replace(self.shape(batch, 1), replicas=1)
        histogram = DeviceHistogram(shape)
        deposit_second_bounce(self.launch_params(batch, shape), histogram)
        return histogram.on_host(histogram.total(self.scale))

    def sensor_indices(self, batch: Batch | Pilot) -> np.ndarray:
        """Return the flat indices of a batch's sensor points."""
        return np.array(batch.sensors.flat_indices(self.capture.sensor_grid.nx), dtype=np.uint32)

    def laser_indices(self, batch: Batch | Pilot) -> np.ndarray:
        """Return the flat indices of a batch's laser points."""
        return np.array(batch.lasers.flat_indices(self.capture.laser_grid.nx), dtype=np.uint32)
