"""The line-of-sight engine: ``render(batch) -> Histogram`` of pixels, as the path engine's of sensor points."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import MAX_SUMS, Batch
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.histogram import DeviceHistogram, Histogram, HistogramShape
from nlosrender.engine.launch.launch_params import LaneRandomness
from nlosrender.engine.launch.passes import Passes
from nlosrender.engine.launch.pilot_points import Pilot, pilot_of
from nlosrender.engine.launch.sample_schedule import (
    FIRST_SAMPLES,
    Budget,
    Sampled,
    Schedule,
    accumulate,
    calibrated_by_pilot,
    pilot_replicas,
)
from nlosrender.engine.line_of_sight.loop import trace_view
from nlosrender.engine.line_of_sight.view_params import (
    ViewLaunchParams,
    ViewSettings,
    crosses_rough_surfaces,
    view_launch_params,
)
from nlosrender.engine.path.engine import RenderOptions
from nlosrender.errors import RenderError
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
        self.scale = 1.0
        self.compile_seconds = 0.0

    @property
    def n_slots(self) -> int:
        """Bounce slots that are sampled: all."""
        return self.options.bounces.n_slots

    def shape(self, batch: Batch | Pilot, slots: int) -> HistogramShape:
        """Return the shape of a batch's histogram with ``slots`` bounce slots."""
        options = self.options
        return HistogramShape(options.replicas, batch.sensors.size, 1, slots, options.channels, self.time_axis.n_bins)

    def render(
        self, batch: Batch, budget: Budget, passes: Passes | None = None, known_squares: float = 0.0
    ) -> Histogram:
        """Render one batch.

        Parameters
        ----------
        batch, budget, passes, known_squares
            As for the path engine.

        Returns
        -------
        Histogram
            Axes (channel, bounce, 1, pixel, bin), pixels flattened row by row; radiance [W m^-2 sr^-1].

        Raises
        ------
        RenderError
            The batch is too large for 32-bit indices, or the result is not finite.
        """
        shape = self.shape(batch, self.n_slots)
        if shape.size > MAX_SUMS:
            raise RenderError(
                f"a batch of {shape.size:.2e} sums is more than 32-bit indices reach; lower render.memory_limit"
            )
        schedule = Schedule(budget, shape.replicas, known_squares, shape.lanes)
        sampled = self._accumulate(batch, shape, schedule, passes or Passes())
        mean, variance = sampled.mean, sampled.variance
        if not (np.isfinite(mean).all() and np.isfinite(variance).all()):
            raise RenderError("the line-of-sight engine produced a value that is not finite; please report the scene")
        return Histogram(
            mean[..., :-1], variance[..., :-1], mean[..., -1], sampled.per_lane * shape.replicas, sampled.contrasts
        )

    def calibrate(self, budget: Budget, known_squares: float = 0.0, seconds: float = math.inf) -> Budget:
        """Turn a target error into samples for the whole capture, found by a pilot on a few of its pixels.

        Parameters
        ----------
        budget, known_squares, seconds
            As for the path engine.
        """
        if budget.is_calibrated:
            return budget
        pilot = pilot_of(self.capture)
        replicas = pilot_replicas(self.options.replicas, pilot.sensors.size)
        shape = replace(self.shape(pilot, self.n_slots), replicas=replicas)

        def look(schedule: Schedule, passes: Passes) -> None:
            self._accumulate(pilot, shape, schedule, passes)

        least = FIRST_SAMPLES * self.options.replicas
        return calibrated_by_pilot(budget, replicas, look, known_squares, seconds, least)

    def _accumulate(self, batch: Batch | Pilot, shape: HistogramShape, schedule: Schedule, passes: Passes) -> Sampled:
        pixels = np.array(batch.sensors.flat_indices(self.capture.sensor_grid.nx), dtype=np.uint32)
        params = view_launch_params(self.built, self.capture, self.time_axis, pixels, shape.lanes)

        def launch(histogram: DeviceHistogram, randomness: LaneRandomness, more: int) -> LaneRandomness:
            return self._launch(params, histogram, randomness, more)

        sampled = accumulate(shape, pixels, self.options.seed, launch, schedule, passes, self.scale)
        self.compile_seconds += sampled.compile_seconds
        return sampled

    def _launch(
        self, params: ViewLaunchParams, histogram: DeviceHistogram, randomness: LaneRandomness, more: int
    ) -> LaneRandomness:
        advanced = trace_view(self.settings, params, histogram, randomness, dr.opaque(mi.UInt32, more))
        dr.eval(histogram.sums, advanced.generator, advanced.sequence)
        return advanced
