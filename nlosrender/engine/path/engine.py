"""Path engine: unbiased transient path tracing of a capture (Royo et al. 2022), batch by batch."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE
from nlosrender.capture.plan import Batch, Plan
from nlosrender.engine.interface import Budget, OmittedWork, PilotSeconds, TimeEstimate
from nlosrender.engine.launch.accumulation import Accumulation, lane_randomness
from nlosrender.engine.launch.cost_pilot import sampled_batch_bytes, sampling_estimate
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.hidden_aabb import HiddenAabb
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.mirror_connections import Mirrors
from nlosrender.engine.launch.near_surfaces import rare_light_warnings
from nlosrender.engine.launch.occlusion import nothing_occludes
from nlosrender.engine.launch.omissions import omitted_by_time_gate, omitted_triangles, omitted_visibility
from nlosrender.engine.launch.passes import Passes
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of
from nlosrender.engine.launch.plain_diffuse import is_plain_diffuse
from nlosrender.engine.launch.schedule import DEFAULT_TARGET, Schedule, calibrated_by_pilot, pilot_replicas
from nlosrender.engine.launch.sequences import SystematicSequence
from nlosrender.engine.launch.temporal_kernel import TemporalKernel
from nlosrender.engine.launch.time_steps import StepKernel, TimeSteps
from nlosrender.engine.path.continuation_period import best_continuation_period, first_phases
from nlosrender.engine.path.full_loop import trace_paths
from nlosrender.engine.path.laser_flash import LaserFlash
from nlosrender.engine.path.settings import PathParams, PathSettings
from nlosrender.engine.path.technique_mixture import box_often_missed, choose_p_hidden_sampling, omitted_techniques
from nlosrender.engine.path.third_bounce_loop import is_third_bounce_loop, trace_third_bounce
from nlosrender.engine.path.tuning import DEFAULT_TUNING, PILOT_SEED, PathTuning


class PathEngine:
    """Unbiased path tracing of a capture.

    Parameters
    ----------
    device
        The capture on the device.
    first_bounce
        Lowest bounce to compute, >= 3, for engines that know the lower ones.
    reason
        Why this engine renders the scene, in plain words.
    tuning
        Its numbers.
    """

    name = "path"

    def __init__(
        self,
        device: DeviceCapture,
        first_bounce: int = THIRD_BOUNCE,
        reason: str = "asked for",
        tuning: PathTuning = DEFAULT_TUNING,
    ):
        self.only_specular = False
        self.device, self.first_bounce, self.reason, self.tuning = device, first_bounce, reason, tuning
        self.built, self.capture, self.time_axis = device.built, device.capture, device.time_axis
        self.options, self.sampler = device.options, device.sampler
        width = self.options.temporal_kernel_bins
        self.kernel = TemporalKernel(width) if width > 0 else None
        self.compile_seconds = 0.0

    # Cached on first use: they trace rays, which engines made for ``plan`` do not need.

    @cached_property
    def p_hidden_sampling(self) -> float:
        """Probability of hidden geometry sampling at a vertex of the wall."""
        if self.options.p_hidden_sampling is not None:
            return self.options.p_hidden_sampling
        if not self.options.hidden_geometry_sampling:
            return 0.0
        return choose_p_hidden_sampling(self.device, self.tuning)

    @cached_property
    def settings(self) -> PathSettings:
        """What the kernels compute, and how."""
        flags = [shape.bsdf().flags() for shape in self.built.hidden_shapes]
        has_spot = self.capture.laser_spot_radius > 0
        return PathSettings(
            bounces=self.options.bounces,
            first_bounce=self.first_bounce,
            p_hidden_sampling=self.p_hidden_sampling,
            laser_sampling=self.options.laser_sampling,
            russian_roulette=self.options.russian_roulette,
            spot_radius=self.capture.laser_spot_radius / self.built.metres_per_engine_unit,
            needs_visibility=not nothing_occludes(self.built),
            has_transmission=any(bool(flag & mi.BSDFFlags.Transmission) for flag in flags),
            is_plain_diffuse=is_plain_diffuse(self.built),
            only_specular=self.only_specular,
            delta_share=self.tuning.delta_share if self.only_specular else 0.0,
            has_mirrors=bool(self.mirrors),
            flashes=self.capture.laser_flash is not None,
            samples_second_bounce=self.device.sees_pixels,
            # with a mirrored spot every path adds what its sensor point sees of it
            max_tries=0 if has_spot and self.mirrors else self.tuning.max_tries,
        )

    @property
    def mirrors(self) -> tuple[Mirrors, ...]:
        """Mirrors by way of which vertices are connected to lasers: from bounce 4 on, with a spot from 3 on."""
        highest, has_spot = self.options.bounces.max_bounces, self.capture.laser_spot_radius > 0
        is_needed = has_spot or highest is None or highest > THIRD_BOUNCE
        return self.device.mirrors if is_needed and self.options.laser_sampling else ()

    @cached_property
    def hidden_aabb(self) -> HiddenAabb | None:
        """Box around the hidden geometry; None where few rays from the wall miss it, or all are sent to points."""
        # with a footprint, places that see less of the box would start more paths: a bias
        if self.p_hidden_sampling > 0 or self.capture.footprint is not None:
            return None
        return box_often_missed(self.device, self.tuning)

    @property
    def traces_paths(self) -> bool:
        """Whether any bounce that this engine computes is asked for."""
        highest = self.options.bounces.max_bounces
        return highest is None or highest >= (FIRST_BOUNCE if self.device.sees_pixels else self.first_bounce)

    @property
    def n_slots(self) -> int:
        """Bounce slots that are sampled: all but that of the second bounce where it is computed."""
        return max(1, self.options.bounces.n_slots - self.settings.first_slot)

    def set_up(self) -> None:
        """Make the table of sampled surfaces; see ``Engine.set_up``."""
        self.sampler.set_up()

    def render(
        self, batch: Batch, budget: Budget, passes: Passes | None = None, known_squares: float = 0.0
    ) -> Histogram:
        """Render one batch; see ``Engine.render``.

        ``known_squares``: sum of the squares of H known from elsewhere, which ``target_error`` counts in
        [(engine unit)^-4], without those of exact light (``DeviceCapture.exact_light``).
        """
        if not self.traces_paths:
            return self.device.histogram_without_samples(batch)
        accumulation = self._accumulation(batch, self.device.shape(batch, self.n_slots), budget)
        shape = accumulation.shape
        if budget.target_error is not None:
            known_squares += self.device.exact_squares(batch)
        lanes, tuning = shape.lanes * shape.lasers, self.options.schedule
        schedule = Schedule(budget, shape.replicas, known_squares, lanes, tuning)
        result = accumulation.run(schedule, passes or Passes())
        np.multiply(result.variance, 1 + (budget.steps_variance_of_paths or 0.0), out=result.variance)
        self.compile_seconds += accumulation.compile_seconds
        self.device.add_exact_light(batch, result)
        return result

    def calibrate(self, budget: Budget, seconds: float = math.inf, known_squares: float = 0.0) -> Budget:
        """Turn a target error into samples; see ``Engine.calibrate``, and ``render`` for ``known_squares``."""
        if budget.is_calibrated or not self.traces_paths:
            return budget
        pilot, options = pilot_of(self.capture), self.options
        shape = self._pilot_shape(pilot)
        accumulation = self._accumulation(pilot, shape, budget)
        known_squares += self.device.exact_squares(pilot)
        replicas = options.replicas, shape.replicas
        calibrated = calibrated_by_pilot(budget, replicas, accumulation.run, known_squares, seconds, options.schedule)
        self.compile_seconds += accumulation.compile_seconds
        if self.only_specular and self.kernel is None and calibrated.spp is not None:
            return self._in_time_steps(calibrated, accumulation, known_squares)
        return calibrated

    def _in_time_steps(self, budget: Budget, pilot: Accumulation, known_squares: float) -> Budget:
        """Return ``budget`` with the time steps that need the fewest paths, and these; see ``TimeSteps``."""
        tuning, histogram = self.tuning, pilot.histogram
        if histogram is None or budget.spp is None:
            return budget
        target = budget.target_error or DEFAULT_TARGET
        goal = self.options.schedule.aim * target
        steps = TimeSteps.of_pilot(histogram, tuning.bins_smoothed, pilot.done, known_squares)
        allowed = [step for step in steps if step.change <= tuning.share_of_steps * target]

        def share_of_paths(step: TimeSteps) -> float:
            return (step.error / steps[0].error) ** 2 / (1 - (step.change / goal) ** 2)

        if not 0 < steps[0].error < math.inf:
            return budget
        best = min(allowed, key=share_of_paths)
        spp = max(
            math.ceil(budget.spp * share_of_paths(best)), self.options.schedule.first_samples * self.options.replicas
        )
        variance = best.change**2 / (goal**2 - best.change**2)
        return replace(budget, spp=spp, bins_per_step_of_paths=best.bins, steps_variance_of_paths=variance)

    def trace(
        self,
        params: PathParams,
        histogram: DeviceHistogram,
        randomness: LaneRandomness,
        systematic: SystematicSequence,
        n_samples: int,
    ) -> tuple[LaneRandomness, SystematicSequence]:
        """Trace ``n_samples`` more paths per lane into ``histogram``; return the advanced random state."""
        loop = trace_third_bounce if is_third_bounce_loop(self.settings, self.sampler) else trace_paths
        count = dr.opaque(mi.UInt32, n_samples)
        advanced, systematic = loop(self.settings, params, histogram, randomness, systematic, count)
        dr.eval(histogram.sums, advanced.generator, advanced.sequence, advanced.phase, systematic.position)
        return advanced, systematic

    def _accumulation(self, batch: Batch | Pilot, shape: HistogramShape, budget: Budget) -> Accumulation:
        """Return the sampling of a batch's paths."""
        bounces, row_points = self.options.bounces, self.device.sensor_indices(batch)
        points, nx = row_points[self.device.lane_order(batch)], self.capture.sensor_grid.lattice.nx
        period = self.continuation_period(budget)
        params = self._path_params(batch, shape, period)
        seed = self.options.seed

        def launch(histogram: DeviceHistogram, randomness: LaneRandomness, more: int, block: range) -> LaneRandomness:
            if randomness.phase is None:
                phases = first_phases(seed, points, nx, shape.lanes, params.continuation_period)
                randomness = replace(randomness, phase=phases)
            systematic = randomness.systematic
            if systematic is None or systematic.block != block:
                systematic = SystematicSequence.of_paths(block, randomness.sequence[0])
            advanced, systematic = self.trace(params, histogram, randomness, systematic, more)
            return replace(advanced, systematic=replace(systematic, block=block))

        first = self.settings.first_slot
        slots = range(-first, bounces.n_slots - first)
        kernel = StepKernel(budget.bins_per_step_of_paths) if budget.bins_per_step_of_paths else self.kernel
        return Accumulation(shape, points, seed, launch, self.device.scale, slots, kernel, row_points)

    def _path_params(self, batch: Batch | Pilot, shape: HistogramShape, period: int) -> PathParams:
        params = self.device.launch_params(batch, shape, self.device.lane_order(batch))
        if self.p_hidden_sampling > 0:
            self.sampler.set_up()
        own: dict[str, Any] = {
            "hidden_aabb": self.hidden_aabb,
            "continuation_period": dr.opaque(mi.UInt32, period),
            "mirrors": self.mirrors,
            "flash": LaserFlash.of(self.built, self.capture, self.time_axis),
            "mirrors_per_vertex": dr.opaque(mi.UInt32, self.tuning.mirrors_per_vertex),
        }
        return PathParams(**vars(params), **own)

    def _pilot_shape(self, pilot: Pilot) -> HistogramShape:
        replicas = pilot_replicas(self.options.replicas, pilot.sensors.size)
        return replace(self.device.shape(pilot, self.n_slots), replicas=replicas)

    def continuation_period(self, budget: Budget) -> int:
        """Return n of the roulette after bounce 3; it does not depend on how the capture is cut."""
        if not self.settings.has_continuation_roulette:
            return 1
        if self.options.continuation_period is not None:
            return self.options.continuation_period
        has_end = budget.target_error is None and budget.time_limit_s is None
        if has_end and (budget.spp or 0) * self.capture.n_sensors < self.tuning.min_paths_for_pilot:
            return 1
        return self._best_period

    @cached_property
    def _best_period(self) -> int:
        is_quick = is_third_bounce_loop(self.settings, self.sampler)
        cost = self.tuning.direct if is_quick else self.tuning.traced
        return best_continuation_period(self._pilot_variance, cost, self.options.bounces.split)

    def _pilot_variance(self, period: int) -> float:
        """Return the variance of H summed over the pilot's points, in arbitrary units."""
        pilot, nx, samples = pilot_of(self.capture), self.capture.sensor_grid.lattice.nx, self.tuning.pilot_samples
        shape, order = self._pilot_shape(pilot), self.device.lane_order(pilot)
        params, histogram = self._path_params(pilot, shape, period), DeviceHistogram(shape, self.kernel)
        points = self.device.sensor_indices(pilot)[order]
        phases = first_phases(PILOT_SEED, points, nx, shape.lanes, params.continuation_period)
        random = replace(lane_randomness(shape, points, PILOT_SEED), phase=phases)
        systematic = SystematicSequence.of_paths(range(samples), random.sequence[0])
        self.trace(params, histogram, random, systematic, samples)
        return float(histogram.on_host(histogram.statistics(samples)[1])[..., :-1].sum())

    # Asked by ``preflight`` and reports

    def omitted_work(self) -> Iterator[OmittedWork]:
        """Yield the work that is left out; see ``Engine.omitted_work``."""
        if not self.settings.needs_visibility:
            yield omitted_visibility()
        if self.p_hidden_sampling > 0:
            yield from omitted_triangles(self.device)
        yield from self.omitted_path_work()

    def omitted_path_work(self) -> Iterator[OmittedWork]:
        """Yield the part of ``omitted_work`` that is about paths; nothing where none is traced."""
        if not self.traces_paths:
            return
        if self.settings.has_time_gate:
            yield from omitted_by_time_gate(self.device)
        if self.hidden_aabb is not None:
            why = "such a path ends where it began"
            yield OmittedWork("rays from the wall that miss the box around all hidden geometry", why)
        yield from omitted_techniques(self.device, self.p_hidden_sampling)

    def shared_samples(self) -> str:
        """Return what makes errors correlated; see ``Engine.shared_samples``."""
        return "all laser points share the paths of a sensor point" if self.device.is_exhaustive else ""

    def batch_bytes(self, plan: Plan, available: float = math.inf) -> int:
        """Return the memory of the largest batch; see ``Engine.batch_bytes``."""
        return sampled_batch_bytes(plan, lambda batch: self.device.shape(batch, self.n_slots))

    def warnings(self) -> Iterator[str]:
        """Yield what paths find by chance only; see ``Engine.warnings``."""
        return rare_light_warnings(self.device, lambda: self.p_hidden_sampling)

    def cost_estimate(self, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds) -> TimeEstimate:
        """Estimate the seconds of a render; see ``Engine.cost_estimate``."""
        if not self.traces_paths:
            return TimeEstimate(0.0, "nothing to compute")
        return sampling_estimate(self, plan, budget, lanes, pilot)
