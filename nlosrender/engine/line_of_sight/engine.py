"""Line-of-sight engine: transient path tracing of the pixels of a camera, of a scene that emits one pulse."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch, Plan
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.interface import Budget, OmittedWork, PilotSeconds, TimeEstimate
from nlosrender.engine.launch.accumulation import Accumulation
from nlosrender.engine.launch.cost_pilot import sampled_batch_bytes, sampling_estimate
from nlosrender.engine.launch.device_capture import RenderOptions
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.lane_random_state import LaneRandomness
from nlosrender.engine.launch.passes import Passes
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of
from nlosrender.engine.launch.schedule import Schedule, calibrated_by_pilot, pilot_replicas
from nlosrender.engine.line_of_sight.loop import trace_view
from nlosrender.engine.line_of_sight.view_params import ViewSettings, crosses_rough_surfaces, view_launch_params
from nlosrender.scene.view import BuiltView


class LineOfSightEngine:
    """Unbiased transient path tracing of what a camera sees.

    Parameters
    ----------
    built, capture, time_axis
        The scene and what is measured of it; sensor points are pixels.
    options
        Bounces, channels, seed.
    reason
        Why this engine renders the scene, in plain words.
    """

    name = "line_of_sight"
    traces_paths = True

    def __init__(
        self,
        built: BuiltView,
        capture: Capture,
        time_axis: TimeAxis,
        options: RenderOptions,
        reason: str = "a camera sees the scene itself",
    ):
        self.reason = reason
        self.built, self.capture, self.time_axis, self.options = built, capture, time_axis, options
        far = (bool(emitter.flags() & mi.EmitterFlags.Infinite) for emitter in built.scene.emitters())
        self.settings = ViewSettings(
            bounces=options.bounces,
            channels=options.channels,
            russian_roulette=options.russian_roulette,
            counts_last_leg=capture.account_first_and_last_bounces,
            has_sky=any(far),
            bends=crosses_rough_surfaces(built.scene),
        )
        self.compile_seconds = 0.0

    def set_up(self) -> None:
        """Do nothing: batches share the scene alone; see ``Engine.set_up``."""

    def render(self, batch: Batch, budget: Budget, passes: Passes | None = None) -> Histogram:
        """Render one batch; see ``Engine.render``.

        Returns
        -------
        Histogram
            Axes (channel, bounce, 1, pixel, bin), pixels flattened row by row; radiance [W m^-2 sr^-1].
        """
        accumulation = self._accumulation(batch, self._shape(batch))
        shape = accumulation.shape
        schedule = Schedule(budget, shape.replicas, lanes=shape.lanes, tuning=self.options.schedule)
        result = accumulation.run(schedule, passes or Passes())
        self.compile_seconds += accumulation.compile_seconds
        return result

    def calibrate(self, budget: Budget, seconds: float = math.inf) -> Budget:
        """Turn a target error into samples by a pilot on a few pixels; see ``Engine.calibrate``."""
        if budget.is_calibrated:
            return budget
        pilot, options = pilot_of(self.capture), self.options
        shape = replace(self._shape(pilot), replicas=pilot_replicas(options.replicas, pilot.sensors.size))
        accumulation = self._accumulation(pilot, shape)
        replicas = options.replicas, shape.replicas
        calibrated = calibrated_by_pilot(budget, replicas, accumulation.run, seconds=seconds, tuning=options.schedule)
        self.compile_seconds += accumulation.compile_seconds
        return calibrated

    def _shape(self, batch: Batch | Pilot) -> HistogramShape:
        options = self.options
        slots, channels = options.bounces.n_slots, options.channels
        return HistogramShape(options.replicas, batch.sensors.size, 1, slots, channels, self.time_axis.n_bins)

    def _accumulation(self, batch: Batch | Pilot, shape: HistogramShape) -> Accumulation:
        pixels = np.array(batch.sensors.flat_indices(self.capture.sensor_grid.nx), dtype=np.uint32)
        params = view_launch_params(self.built, self.capture, self.time_axis, pixels, shape.lanes)

        def launch(histogram: DeviceHistogram, randomness: LaneRandomness, more: int, _: range) -> LaneRandomness:
            advanced = trace_view(self.settings, params, histogram, randomness, dr.opaque(mi.UInt32, more))
            dr.eval(histogram.sums, advanced.generator, advanced.sequence)
            return advanced

        return Accumulation(shape, pixels, self.options.seed, launch)

    # Asked by ``preflight`` and reports

    def omitted_work(self) -> Iterator[OmittedWork]:
        """Yield the work that is left out; see ``Engine.omitted_work``."""
        if not self.settings.polarized:
            yield OmittedWork("polarisation", "render.polarized is false")

    def shared_samples(self) -> str:
        """Return nothing: pixels have samples of their own; see ``Engine.shared_samples``."""
        return ""

    def batch_bytes(self, plan: Plan, available: float = math.inf) -> int:
        """Return the memory of the largest batch; see ``Engine.batch_bytes``."""
        return sampled_batch_bytes(plan, self._shape)

    def warnings(self) -> Iterator[str]:
        """Yield nothing; see ``Engine.warnings``."""
        return iter(())

    def cost_estimate(self, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds) -> TimeEstimate:
        """Estimate the seconds of a render; see ``Engine.cost_estimate``."""
        return sampling_estimate(self, plan, budget, lanes, pilot)
