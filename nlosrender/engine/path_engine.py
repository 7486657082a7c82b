"""The path engine: ``render(batch) -> Histogram`` until the asked-for error, sample count or time is reached."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import THIRD_BOUNCE, BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import MOST_SUMS, Batch
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.device_arrays import laser_points, sensor_points
from nlosrender.engine.histogram import DeviceHistogram, Histogram, HistogramShape, to_memory_order
from nlosrender.engine.path_integrator import load_path_integrator
from nlosrender.engine.pilot import Pilot, pilot_of
from nlosrender.engine.second_bounce import deposit_second_bounce
from nlosrender.engine.surface_sampler import SurfaceSampler
from nlosrender.engine.transport import LaneRandomness, PathSettings, Transport
from nlosrender.errors import RenderError
from nlosrender.scene.build import BuiltScene

FIRST_SAMPLES = 32  # per lane, before the first look at the error
LAUNCH_SECONDS = 0.5  # launches are kept this short, for the progress bar and Ctrl-C
NEAR_RATIO = 4.0  # hidden area over pi times (its distance from the wall)^2 above which its density is too peaked
DEFAULT_TARGET = 0.01  # where neither an error nor samples are asked for
SETTLED_SHARE = 0.9  # of the target error: the pilot's estimate has an error of its own
PILOT_ERROR = 3.0  # times the goal: when a pilot has seen enough
PILOT_LANES = 2048
SURROUNDED = 0.75  # share of the hemisphere above which BSDF sampling alone does better

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Budget:
    """When to stop: after ``spp`` samples per sensor point, at ``target_error`` (relative L2 of H), after seconds.

    An engine's ``settle`` turns a target error into fixed settings.
    """

    spp: int | None = None
    target_error: float | None = None
    time_limit_s: float | None = None
    fineness: float | None = None  # settled: coarseness of the patches of the virtual lights
    rounds: int | None = None  # settled: rounds of walks of the virtual lights


@dataclass(frozen=True)
class PathOptions:
    """The techniques of Royo et al. 2022 and what is computed."""

    bounces: BounceAxis
    laser_sampling: bool = True
    hidden_geometry_sampling: bool = True
    russian_roulette: bool = True
    channels: int = 1
    seed: int = 0
    replicas: int = 2
    hidden_fraction: float | None = None  # share of hidden geometry sampling on the wall; None: chosen from the scene


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
        options: PathOptions,
        first_bounce: int = THIRD_BOUNCE,
        reason: str = "asked for",
    ):
        self.reason = reason
        self.built, self.capture, self.time_axis, self.options = built, capture, time_axis, options
        self.sampler = SurfaceSampler(built)
        self.hidden_fraction = self._choose_hidden_fraction()
        flags = [shape.bsdf().flags() for shape in built.hidden_shapes]
        self.settings = PathSettings(
            bounces=options.bounces,
            first_bounce=first_bounce,
            hidden_fraction=self.hidden_fraction,
            laser_sampling=options.laser_sampling,
            russian_roulette=options.russian_roulette,
            spot_radius=capture.laser_spot_radius / built.unit,
            has_transmission=any(bool(flag & mi.BSDFFlags.Transmission) for flag in flags),
        )
        self.integrator = load_path_integrator(self.settings)
        # Throughput is per (engine unit)^2: H falls with the square of a scene's size.
        self.scale = capture.laser_energy / built.unit**2
        self.compile_seconds = 0.0

    def render(
        self,
        batch: Batch,
        budget: Budget,
        progress: Progress = lambda fraction: None,
        known_squares: float = 0.0,
    ) -> Histogram:
        """Render one batch.

        Parameters
        ----------
        batch, budget, progress
            What to render, when to stop, whom to tell the share of the work done.
        known_squares
            Sum of the squares of H known from elsewhere, which ``target_error`` counts in [(engine unit)^-4].

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
        shape = self.shape(batch, max(1, bounces.n_slots - 1) if bounces.split else 1)
        if shape.size > MOST_SUMS:
            raise RenderError(
                f"a batch of {shape.size:.2e} sums is more than 32-bit indices reach; lower render.memory_limit"
            )
        transport = self.transport(batch, shape)
        if not self._has_bounces:
            mean, variance = np.zeros(shape.axes), np.zeros(shape.axes)
            per_lane = 0
        else:
            schedule = _Schedule(budget, shape.replicas, known_squares)
            mean, variance, per_lane = self._accumulate(batch, shape, transport, schedule, progress)
        mean, variance = to_memory_order(mean, shape), to_memory_order(variance, shape)
        if bounces.split:
            second = np.zeros((shape.channels, 1, *mean.shape[2:]))
            keep = 0 if bounces.n_slots == 1 else shape.slots
            mean = np.concatenate([second, mean[:, :keep]], axis=1)
            variance = np.concatenate([second, variance[:, :keep]], axis=1)
        if not self.built.wall.is_planar:
            mean[:, :1] += self._second_bounce(batch, transport)
        mean, variance = mean * self.scale, variance * self.scale**2
        if not (np.isfinite(mean).all() and np.isfinite(variance).all()):
            raise RenderError("the path engine produced a value that is not finite; please report the configuration")
        return Histogram(mean[..., :-1], variance[..., :-1], mean[..., -1], per_lane * shape.replicas)

    def settle(self, budget: Budget, known_squares: float = 0.0) -> Budget:
        """Turn a target error into samples for the whole capture, found by a pilot on a few of its points.

        The number does not depend on how the capture is cut. Budgets with ``spp`` or a time limit stay as they are.

        Parameters
        ----------
        budget
            What is asked for.
        known_squares
            Sum of the squares of H over the pilot's points known from elsewhere [(engine unit)^-4].
        """
        if budget.target_error is None or budget.spp is not None or budget.time_limit_s is not None:
            return budget
        if not self._has_bounces:
            return budget
        pilot = pilot_of(self.capture)
        bounces = self.options.bounces
        slots = max(1, bounces.n_slots - 1) if bounces.split else 1
        replicas = max(self.options.replicas, PILOT_LANES // pilot.sensors.size // 2 * 2)
        shape = replace(self.shape(pilot, slots), replicas=replicas)
        goal = SETTLED_SHARE * budget.target_error
        schedule = _Schedule(Budget(target_error=PILOT_ERROR * goal), replicas, known_squares)
        _, _, per_lane = self._accumulate(pilot, shape, self.transport(pilot, shape), schedule, lambda share: None)
        error = schedule.errors[-1][1]
        return replace(budget, spp=max(1, math.ceil(per_lane * replicas * (error / goal) ** 2)))

    @property
    def _has_bounces(self) -> bool:
        highest = self.options.bounces.max_bounces
        return highest is None or highest >= self.settings.first_bounce

    def _accumulate(
        self, batch: Batch | Pilot, shape: HistogramShape, transport: Transport, schedule: _Schedule, progress: Progress
    ) -> tuple[np.ndarray, np.ndarray, int]:
        histogram = DeviceHistogram(shape)
        lane = dr.arange(mi.UInt32, shape.lanes)
        point = dr.gather(mi.UInt32, mi.UInt32(self.sensor_indices(batch)), lane % shape.sensors)
        key = point * shape.replicas + lane // shape.sensors
        randomness = LaneRandomness.seeded(self.options.seed, key)
        begun = time.perf_counter()
        done = 0
        while (more := schedule.next_samples(done, time.perf_counter() - begun)) > 0:
            launched = time.perf_counter()
            randomness = self.integrator.accumulate(transport, histogram, randomness, more)
            dr.sync_thread()
            seconds = time.perf_counter() - launched
            if done == 0:
                self.compile_seconds += seconds  # the first launch is small: nearly all of it is compilation
            else:
                schedule.speed = more / max(seconds, 1e-6)
            done += more
            if schedule.wants_error(done):
                schedule.record_error(done, histogram.relative_error(done, schedule.known_squares))
            progress(schedule.fraction(done, time.perf_counter() - begun))
        mean, variance = histogram.statistics(done)
        dr.eval(mean, variance)
        return mean.numpy(), variance.numpy(), done

    def shape(self, batch: Batch | Pilot, slots: int) -> HistogramShape:
        """Return the shape of a batch's histogram with ``slots`` bounce slots."""
        lasers = batch.lasers.size if self.capture.scan_type == "exhaustive" else 1
        options = self.options
        return HistogramShape(
            options.replicas, batch.sensors.size, lasers, slots, options.channels, self.time_axis.n_bins
        )

    def transport(self, batch: Batch | Pilot, shape: HistogramShape) -> Transport:
        """Return what the lanes of a batch read."""
        sensors = sensor_points(self.built, self.capture, self.time_axis, self.sensor_indices(batch))
        lasers = laser_points(self.built, self.capture, self.time_axis, self.laser_indices(batch))
        lane = dr.arange(mi.UInt32, shape.lanes)
        sensor = lane % shape.sensors
        confocal = self.capture.scan_type == "confocal"
        first_laser = mi.UInt32(sensor) if confocal else dr.zeros(mi.UInt32, shape.lanes)
        per_lane = sensors.gather(sensor)
        dr.eval(per_lane.interaction, per_lane.delay_bins, per_lane.delay_fraction, first_laser)
        return Transport(
            built=self.built,
            sampler=self.sampler,
            sensors=per_lane,
            lasers=lasers,
            first_laser=first_laser,
            lasers_per_lane=shape.lasers,
            n_lasers=dr.opaque(mi.UInt32, shape.lasers),
            bins_per_unit=dr.opaque(mi.Float, self.built.unit / self.time_axis.bin_width_opl),
        )

    def _second_bounce(self, batch: Batch, transport: Transport) -> np.ndarray:
        """Return the second bounce (channel, 1, laser, sensor, row): exact, so one replica computes it."""
        shape = replace(self.shape(batch, 1), replicas=1)
        lanes = dr.arange(mi.UInt32, shape.lanes)
        single = replace(
            transport,
            sensors=transport.sensors.gather(lanes),
            first_laser=dr.gather(mi.UInt32, transport.first_laser, lanes),
        )
        histogram = DeviceHistogram(shape)
        deposit_second_bounce(single, histogram)
        dr.eval(histogram.sums)
        return to_memory_order(histogram.sums.numpy(), shape)

    def sensor_indices(self, batch: Batch | Pilot) -> np.ndarray:
        """Return the flat indices of a batch's sensor points."""
        return np.array(batch.sensors.flat_indices(self.capture.sensor_grid.nx), dtype=np.uint32)

    def laser_indices(self, batch: Batch | Pilot) -> np.ndarray:
        """Return the flat indices of a batch's laser points."""
        return np.array(batch.lasers.flat_indices(self.capture.laser_grid.nx), dtype=np.uint32)

    def _choose_hidden_fraction(self) -> float:
        """Pick the mixture on the relay wall; one technique alone where it suffices: cheaper and less noisy."""
        options, built = self.options, self.built
        if options.hidden_fraction is not None:
            return options.hidden_fraction
        if not options.hidden_geometry_sampling or self.sampler.is_empty or built.hidden_bounds is None:
            return 0.0
        distance = built.hidden_bounds[0][2] / built.unit
        # All light comes from sampled surfaces, and the wall has no mirror lobe that only its own sampling finds.
        only_hidden = built.wall.is_planar and self.sampler.covers_everything
        only_hidden &= not built.wall_bsdf.flags() & mi.BSDFFlags.Delta
        if only_hidden and distance > 0 and self.sampler.area < NEAR_RATIO * math.pi * distance**2:
            return 1.0
        return 0.0 if self._surrounded_share() > SURROUNDED else 0.5

    def _surrounded_share(self) -> float:
        """Return the cosine-weighted share of directions from the sensor points that meet hidden geometry."""
        grid = self.capture.sensor_grid
        n_points = grid.positions.shape[0] * grid.positions.shape[1]
        index = np.linspace(0, n_points - 1, min(n_points, 64)).astype(np.uint32)
        points = sensor_points(self.built, self.capture, self.time_axis, index).interaction
        lanes = dr.arange(mi.UInt32, len(index) * 64)
        si = dr.gather(mi.SurfaceInteraction3f, points, lanes // 64)
        k = lanes % 64
        stratified = mi.Point2f((mi.Float(k % 8) + 0.5) / 8, (mi.Float(k // 8) + 0.5) / 8)
        direction = si.to_world(mi.warp.square_to_cosine_hemisphere(stratified))
        ray = mi.Ray3f(si.p + 1e-4 * si.n, direction)
        return float(dr.mean(dr.select(self.built.scene.ray_test(ray), mi.Float(1), 0))[0])


class _Schedule:
    """How many samples each launch takes. Only the last launches depend on time, and only with a time limit."""

    def __init__(self, budget: Budget, replicas: int, known_squares: float):
        self.budget, self.known_squares = budget, known_squares
        self.limit = math.ceil(budget.spp / replicas) if budget.spp is not None else None
        self.errors: list[tuple[int, float]] = []  # (samples per lane, relative L2 error)
        self.speed = math.inf  # samples per lane and second
        self._next_look = FIRST_SAMPLES

    def next_samples(self, done: int, seconds: float) -> int:
        """Return the samples per lane of the next launch; 0 when the budget is met."""
        budget = self.budget
        if done == 0:
            return min(FIRST_SAMPLES, self.limit or FIRST_SAMPLES)
        if budget.time_limit_s is not None and seconds >= budget.time_limit_s:
            return 0
        if self.limit is not None:
            goal = self.limit
        elif budget.target_error is not None:
            if self.errors and self.errors[-1][0] == done and self.errors[-1][1] <= budget.target_error:
                return 0
            goal = self._next_look
        else:
            goal = done * 2
        launch = max(1.0, self.speed * LAUNCH_SECONDS)
        if budget.time_limit_s is not None:
            launch = min(launch, max(1.0, self.speed * (budget.time_limit_s - seconds)))
        return int(min(goal - done, launch if math.isfinite(launch) else 4 * done))

    def wants_error(self, done: int) -> bool:
        """Return whether to look at the error now: at sample counts fixed by the errors seen so far."""
        return self.budget.target_error is not None and done >= self._next_look

    def record_error(self, done: int, error: float) -> None:
        """Note the error after ``done`` samples and when to look next: it falls at least as 1 / sqrt(samples)."""
        self.errors.append((done, error))
        target = self.budget.target_error or error
        needed = done * (error / target) ** 2 if target > 0 else done
        self._next_look = int(min(max(needed * 1.05, done * 1.25), done * 4)) + 1

    def fraction(self, done: int, seconds: float) -> float:
        """Return the share of the work that is done, estimated, in [0, 1]."""
        budget = self.budget
        shares = [0.0]
        if self.limit is not None:
            shares.append(done / self.limit)
        if budget.time_limit_s is not None:
            shares.append(seconds / budget.time_limit_s if budget.time_limit_s > 0 else 1.0)
        if budget.target_error is not None and self.errors:
            counted, error = self.errors[-1]
            shares.append((budget.target_error / error) ** 2 * done / counted if error > 0 else 1.0)
        return min(1.0, max(shares))
