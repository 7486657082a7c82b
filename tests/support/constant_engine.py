"""The smallest engine: what the rest of the program asks of one, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Batch, Plan
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.config.render import RenderConfig
from nlosrender.engine.interface import Budget, Engine, OmittedWork, PilotSeconds, TimeEstimate
from nlosrender.engine.launch.device_capture import RenderOptions
from nlosrender.engine.launch.histogram import Histogram
from nlosrender.engine.launch.passes import Passes
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.view import BuiltView


@dataclass(frozen=True, eq=False)
class ConstantEngine:
    """H is ``light`` in every bin of the third bounce, its standard deviation ``deviation`` [J m^-2 sr^-1]."""

    built: BuiltScene | BuiltView
    capture: Capture
    time_axis: TimeAxis
    options: RenderOptions
    light: float
    deviation: float
    name: str = "constant"
    reason: str = "asked for by a test"
    traces_paths: bool = False
    compile_seconds: float = 0.0

    def set_up(self) -> None: ...

    def calibrate(self, budget: Budget, seconds: float = math.inf) -> Budget:
        return budget

    def render(self, batch: Batch, budget: Budget, passes: Passes | None = None) -> Histogram:
        bounces, lasers = self.options.bounces, batch.lasers.size if self.capture.scan_type == "exhaustive" else 1
        lit = np.zeros((self.options.channels, bounces.n_slots, lasers, batch.sensors.size, self.time_axis.n_bins))
        lit[:, bounces.slot(THIRD_BOUNCE)] = 1
        contrasts = self.deviation * lit.sum(axis=(2, 3, 4))[None]  # one: all deviations have the same sign
        return Histogram(self.light * lit, self.deviation**2 * lit, np.zeros(lit.shape[:-1]), 1, contrasts)

    def omitted_work(self) -> Iterator[OmittedWork]:
        yield OmittedWork("everything", "the light is known")

    def shared_samples(self) -> str:
        return ""

    def batch_bytes(self, plan: Plan, available: float = math.inf) -> int:
        return plan.bytes_per_batch

    def warnings(self) -> Iterator[str]:
        return iter(())

    def cost_estimate(self, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds) -> TimeEstimate:
        return TimeEstimate(0.0, "nothing to compute")


@dataclass(frozen=True)
class ChooseConstant:
    """Takes the place of ``planner.choose_engine``; its return type is checked by mypy, in every run of it."""

    light: float
    deviation: float = 0.0

    def __call__(
        self,
        render: RenderConfig,
        built: BuiltScene | BuiltView,
        capture: Capture,
        time_axis: TimeAxis,
        options: RenderOptions,
        lanes: int,
    ) -> Engine:
        return ConstantEngine(built, capture, time_axis, options, self.light, self.deviation)
