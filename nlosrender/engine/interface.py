"""Engine interface: the protocol that all engines implement, and the values that cross it.

``planner`` alone knows which engines there are. Engine folders import ``launch/``, this module and themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from nlosrender.capture.grids import Capture
    from nlosrender.capture.plan import Batch, Plan
    from nlosrender.capture.time_axis import TimeAxis
    from nlosrender.engine.launch.device_capture import RenderOptions
    from nlosrender.engine.launch.histogram import Histogram
    from nlosrender.engine.launch.passes import Passes
    from nlosrender.scene.build import BuiltScene
    from nlosrender.scene.view import BuiltView


@dataclass(frozen=True)
class Budget:
    """When to stop: at ``spp`` samples per sensor point, ``target_error`` (relative L2 of H) or ``time_limit_s``.

    ``Engine.calibrate`` turns a target error into the settings below it, which do not depend on how a capture is cut.
    """

    spp: int | None = None
    target_error: float | None = None
    time_limit_s: float | None = None
    patch_scale: float | None = None  # of the virtual lights: size of patches over that at the coarsest resolution
    # of the virtual lights: the difference of their two resolutions over the error of the finer one; None: a bound
    difference_divisor: float | None = None
    # of the virtual lights: sensor points along rows and columns from one node of the lattice that visibility is
    # interpolated on to the next, and rays from each of them to a patch; None: every sensor point sends its own
    visibility_step: int | None = None
    rays_per_node: int | None = None
    rounds: int | None = None  # of the virtual lights: rounds of VPL subpaths
    # of the virtual lights: bins in a time step of the light of VPLs, and what such steps change, squared, over its
    # variance; the same of the paths beside them
    bins_per_step: int | None = None
    steps_variance: float | None = None
    bins_per_step_of_paths: int | None = None
    steps_variance_of_paths: float | None = None
    footprint_places: int | None = None  # of the virtual lights: places in the footprint of a sensor point

    @property
    def is_calibrated(self) -> bool:
        """Whether no pilot is needed: samples or a time are given, or nothing is."""
        return self.target_error is None or self.spp is not None or self.time_limit_s is not None

    @property
    def lasts_until_its_time_limit(self) -> bool:
        """Whether nothing but time ends sampling."""
        return self.time_limit_s is not None and self.spp is None and self.target_error is None


@dataclass(frozen=True)
class PilotSeconds:
    """How long the pilots of a cost estimate may take."""

    tracing: float = 1.0  # two launches of half a second, the shortest whose speed is that of a long render
    calibration: float = 5.0  # of the pilot that says how many paths a target error takes; beyond it extrapolated


@dataclass(frozen=True)
class TimeEstimate:
    """Seconds a render will take."""

    seconds: float | None  # None: the pilot found too little light
    basis: str  # what was measured and how it was extrapolated
    lit_shares: tuple[float | None, ...] | None = None  # per bounce slot: bins with light in the pilot; None: no pilot


@dataclass(frozen=True)
class OmittedWork:
    """One kind of work that is not done because the scene does not need it."""

    what: str
    why: str


class Engine(Protocol):
    """Renders the batches of one capture; the backend is started.

    Two batches of a capture may be rendered in any order, in any process: their bits are those of any other cutting.
    """

    @property
    def name(self) -> str:
        """Name as files and reports have it."""

    @property
    def reason(self) -> str:
        """Why this engine renders the scene, in plain words."""

    @property
    def built(self) -> BuiltScene | BuiltView:
        """The scene."""

    @property
    def capture(self) -> Capture:
        """What is measured of it."""

    @property
    def time_axis(self) -> TimeAxis:
        """Its bins."""

    @property
    def options(self) -> RenderOptions:
        """What is computed."""

    @property
    def traces_paths(self) -> bool:
        """Whether every sensor point has paths of its own, so that small batches leave processors idle."""

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling kernels so far."""

    def set_up(self) -> None:
        """Make what all batches share, otherwise made on first use; benchmarks time it separately."""

    def calibrate(self, budget: Budget, seconds: float = math.inf) -> Budget:
        """Turn a target error into settings for the whole capture, found by a pilot on a few of its points.

        Parameters
        ----------
        budget
            What is asked for. With samples or a time limit it stays as it is, as far as these decide.
        seconds
            After which the pilot of paths ends: what it has seen is extrapolated.
        """

    def render(self, batch: Batch, budget: Budget, passes: Passes | None = None) -> Histogram:
        """Render one batch.

        Parameters
        ----------
        batch, budget
            What to render, when to stop.
        passes
            Callbacks between launches for progress, interruption and saved states; the state to resume from.

        Returns
        -------
        Histogram
            Axes (channel, bounce, laser, sensor, bin), laser and sensor flattened row by row.

        Raises
        ------
        RenderError
            The batch is too large for 32-bit indices, or the result is not finite.
        """

    def omitted_work(self) -> Iterator[OmittedWork]:
        """Yield the work that this engine leaves out for this capture."""

    def shared_samples(self) -> str:
        """Return what sensor or laser points share that makes their errors correlated, in words; empty: nothing."""

    def batch_bytes(self, plan: Plan, available: float = math.inf) -> int:
        """Return the memory of the largest batch: histograms, their statistics and copies [bytes].

        Raises
        ------
        ConfigError
            What all batches share, such as patches, takes more than ``available`` bytes.
        RenderError
            A batch has more sums than 32-bit indices reach.
        """

    def warnings(self) -> Iterator[str]:
        """Yield warnings about what this engine does not get right in this scene, a sentence each."""

    def cost_estimate(self, plan: Plan, budget: Budget, lanes: int, pilot: PilotSeconds) -> TimeEstimate:
        """Estimate the seconds of a render from a pilot on part of the capture.

        Rendering alone and the calibration, as if without a time limit: no start, no compilation, no writing.

        Parameters
        ----------
        plan, budget
            The batches, and when a render stops.
        lanes
            Lanes that keep the backend busy.
        pilot
            How long pilots may take.
        """


class SupplementaryEngine(Engine, Protocol):
    """An engine that adds its bounces to those of another one.

    ``only_specular``, set before the first use: of these only light that a delta lobe has reflected or let through.
    """

    only_specular: bool

    def calibrate(self, budget: Budget, seconds: float = math.inf, known_squares: float = 0.0) -> Budget:
        """Calibrate as ``Engine.calibrate``, with ``known_squares`` as for ``render`` over the pilot's points."""

    def render(
        self, batch: Batch, budget: Budget, passes: Passes | None = None, known_squares: float = 0.0
    ) -> Histogram:
        """Render as ``Engine.render``.

        ``known_squares``: sum of the squares of the other engine's H, which ``target_error`` counts in
        [(engine unit)^-4], without those of exact light (``DeviceCapture.exact_light``).
        """

    def omitted_path_work(self) -> Iterator[OmittedWork]:
        """Yield the omitted work that is about paths."""
