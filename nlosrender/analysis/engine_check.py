"""``nlosrender check-engines``: renders a few sensor points by every technique and compares these pair by pair.

The techniques are the path engine, the path engine without hidden geometry sampling (it shares no surface sampler with
the others, and finds what is in front by rays alone), and the virtual lights. A pair is judged by the Z-test of
``comparison/z_test.py``; the estimated error of virtual lights counts as an error that may have one sign everywhere.
What all techniques have in common (the scene, the histogram, light that none of them samples) is not tested.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.comparison.blocks import Block
from nlosrender.analysis.comparison.z_test import ErrorModel, ZTest, sidak
from nlosrender.analysis.json_values import finite_or_none
from nlosrender.capture.bounces import FILE_BOUNCES, BounceAxis
from nlosrender.capture.plan import replicas_for
from nlosrender.capture.relative_error import relative_l2_error
from nlosrender.config.document import Config
from nlosrender.engine.interface import Budget
from nlosrender.errors import NlosError, OptionError
from nlosrender.rendering.outcome import missing_light
from nlosrender.rendering.stages import bounce_axis, describe_capture, load_scene, prepare, started_backend

if TYPE_CHECKING:
    from nlosrender.engine.interface import Engine
    from nlosrender.engine.launch.pilot_points import Pilot
    from nlosrender.engine.preflight.unsampled_paths import UnsampledPaths

Float64 = NDArray[np.float64]
GATHER_SHARE = 0.1  # of the target error: an error that may have one sign everywhere adds up over bins and points
MAX_REPLICAS = 32  # per sensor point: a variance is then known to sqrt(2 / 31) = 25 %


@dataclass(frozen=True)
class Technique:
    """A way to render a scene: its name, and the keys of ``render`` that ask for it."""

    name: str
    engine: str
    hidden_geometry_sampling: bool = True


TECHNIQUES = (
    Technique("path", "path"),
    Technique("path without hidden geometry sampling", "path", hidden_geometry_sampling=False),
    Technique("virtual lights", "virtual_lights"),
)


@dataclass(frozen=True, eq=False)
class Trial:
    """What a technique made of the points, or why it could not.

    ``mean`` and ``variance`` have the axes (channel, bounce slot, laser, sensor, bin).
    """

    technique: str
    obstacle: str | None = None
    seconds: float = 0.0
    mean: Float64 = field(default_factory=lambda: np.zeros((1, 1, 1, 1, 1)))
    variance: Float64 = field(default_factory=lambda: np.zeros((1, 1, 1, 1, 1)))
    attributes: Mapping[str, object] = field(default_factory=dict)  # as a file's: what the variance means
    split_bounces: bool = True

    @property
    def error(self) -> float:
        """Estimated relative L2 error of H, all bounces together."""
        return relative_l2_error(float(self.variance.sum()), float((self.mean.sum(axis=1) ** 2).sum()))

    @property
    def sizes(self) -> Mapping[str, int]:
        """Return the lengths of a file's axes, as far as the Z-test asks."""
        return {"channel": self.mean.shape[0], "bounce": FILE_BOUNCES}

    @property
    def n_bins(self) -> int:
        """Return the number of bins."""
        return self.mean.shape[-1]


@dataclass(frozen=True)
class BounceDifference:
    """How far two techniques are apart in one bounce."""

    bounce: str
    energy: float | None  # relative difference; None without light
    visible_energy: float | None  # relative difference of the energy that the test would have seen
    rel_l2: float | None  # of H
    expected_rel_l2: float | None  # of both techniques' estimated errors


@dataclass(frozen=True)
class PairCheck:
    """Two techniques compared; relative numbers are relative to the second."""

    techniques: tuple[str, str]
    agrees: bool
    z: float  # the largest deviation; inf: light against none at all
    z_limit: float
    n_statements: int  # 0: both are too dark or too noisy for any
    worst: str | None  # where the largest deviation is
    bounces: tuple[BounceDifference, ...]


@dataclass(frozen=True)
class EngineCheck:
    """All of it."""

    n_sensors: int
    n_lasers: int
    trials: tuple[Trial, ...]
    pairs: tuple[PairCheck, ...]
    unsampled_paths: tuple[str, ...]  # which no technique finds, whatever they agree on

    @property
    def agrees(self) -> bool:
        """Return whether every pair does."""
        return all(pair.agrees for pair in self.pairs)

    def as_json(self) -> dict[str, object]:
        """Return the numbers; what is infinite or not known is null."""
        techniques = [
            {"technique": t.technique, "obstacle": t.obstacle, "seconds": t.seconds}
            | ({} if t.obstacle else {"error_estimate": t.error, "energy": float(t.mean.sum())})
            for t in self.trials
        ]
        pairs = [asdict(pair) for pair in self.pairs]
        counts = {"sensor_points": self.n_sensors, "laser_points": self.n_lasers}
        found = {"agrees": self.agrees, **counts, "techniques": techniques, "pairs": pairs}
        return finite_or_none(found | {"unsampled_paths": list(self.unsampled_paths)})


def check_engines(
    config: Config,
    *,
    points_per_axis: int,
    target_error: float,
    time_limit_s: float,
    significance: float,
    progress: Callable[[str], None] = lambda technique: None,
) -> EngineCheck:
    """Render a few sensor points by every technique that can, and compare them pair by pair; no file is written.

    Parameters
    ----------
    points_per_axis
        Sensor points along each side of the grid, spread over it; of exhaustive captures 3 x 3 laser points.
    target_error, time_limit_s
        When a technique stops: relative L2 error of H, or seconds; in place of the configuration's own goal.
    significance
        Chance of a false alarm over all pairs.
    progress
        Called with the name of each technique before it starts.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As ``render_capture``.
    OptionError
        A line-of-sight capture, which one technique renders.
    """
    if config.capture.is_line_of_sight:
        raise OptionError("check-engines: one technique renders line_of_sight captures; there is nothing to compare.")
    backend = started_backend(config)
    from nlosrender.engine.launch.pilot_points import pilot_of

    built = load_scene(config)
    capture, time_axis = describe_capture(config, built.wall, built)
    pilot = pilot_of(capture, points_per_axis)
    replicas = min(replicas_for(backend.lanes, pilot.sensors.size), MAX_REPLICAS)
    budget, trials = Budget(target_error=target_error, time_limit_s=time_limit_s), []
    missing: tuple[UnsampledPaths, ...] = ()
    for technique in TECHNIQUES:
        progress(technique.name)
        keys = {"engine": technique.engine, "hidden_geometry_sampling": technique.hidden_geometry_sampling}
        keys |= {"spp": None, "temporal_kernel_opl": 0.0}
        changed = config.model_copy(update={"render": config.render.model_copy(update=keys)})
        _, engine = prepare(changed, backend, built, capture, time_axis, changes={"replicas": replicas})
        missing = missing or missing_light(engine)
        trials.append(try_technique(technique, engine, pilot, budget))
    pairs = compare_trials(trials, bounce_axis(config), pilot, significance)
    unsampled = tuple(paths.summary for paths in missing)
    n_lasers = 1 if capture.scan_type == "confocal" else pilot.lasers.size
    return EngineCheck(pilot.sensors.size, n_lasers, tuple(trials), tuple(pairs), unsampled)


def try_technique(technique: Technique, engine: Engine, pilot: Pilot, budget: Budget) -> Trial:
    """Render the points of ``pilot`` with ``engine``, unless it is another one than the technique asks for."""
    if engine.name != technique.engine:
        return Trial(technique.name, engine.reason)
    if engine.name == "virtual_lights" and budget.target_error is not None:
        budget = replace(budget, target_error=GATHER_SHARE * budget.target_error)
    begun = time.perf_counter()
    try:
        histogram = engine.render(pilot, budget)  # type: ignore[arg-type]  # points that are no rectangle
    except NlosError as error:
        return Trial(technique.name, str(error))
    seconds, options = time.perf_counter() - begun, engine.options
    limit, split = options.bounces.max_bounces, options.bounces.split
    attributes = {"render_engine": engine.name, "replicas": options.replicas, "max_bounces": limit}
    return Trial(technique.name, None, seconds, histogram.mean, histogram.variance, attributes, split)


def compare_trials(trials: Sequence[Trial], bounces: BounceAxis, pilot: Pilot, significance: float) -> list[PairCheck]:
    """Compare every two techniques that rendered; ``significance`` is the chance of a false alarm over all pairs."""
    pairs = list(itertools.combinations([trial for trial in trials if trial.obstacle is None], 2))
    return [_compare(*pair, bounces, pilot, sidak(significance, len(pairs))) for pair in pairs]


def _compare(a: Trial, b: Trial, bounces: BounceAxis, pilot: Pilot, significance: float) -> PairCheck:
    test = ZTest(a, b, significance)
    n_sensors = a.mean.shape[3]
    for laser in range(a.mean.shape[2]):
        parts = [values[:, :, laser, None] for values in (a.mean, b.mean, a.variance, b.variance)]
        test.add(Block((0, laser), slice(0, 1), slice(0, n_sensors), bounces.file_indices, *parts))
    test.finish()
    found = test.worst
    worst = None
    if found is not None:
        slot = bounces.file_indices.index(found.bounce)
        place = (
            "all sensor points" if found.sensor is None else f"sensor point {pilot.sensors.indices[found.sensor[1]]}"
        )
        worst = f"bounce {bounces.name(slot)}, {place}, bins {found.first_bin} to {found.last_bin}"
    differences = tuple(_differences(a, b, bounces, test.limit))
    names = a.technique, b.technique
    return PairCheck(names, test.z <= test.limit, test.z, test.limit, test.n_statements, worst, differences)


def _differences(a: Trial, b: Trial, bounces: BounceAxis, limit: float) -> Iterator[BounceDifference]:
    for slot, index in enumerate(bounces.file_indices):
        sigma2 = 0.0
        for trial in (a, b):
            # laser and sensor for rows and columns: all axes are summed
            mean, variance = (values[:, slot : slot + 1] for values in (trial.mean, trial.variance))
            side = ErrorModel(trial).side(mean, variance, (index,))
            sigma2 += float(side.noise.sum()) + float(side.bound.sum()) ** 2
        energies = [float(trial.mean[:, slot].sum()) for trial in (a, b)]
        norm = float(np.linalg.norm(b.mean[:, slot]))
        if energies[1] == 0 or norm == 0:
            yield BounceDifference(bounces.name(slot), None, None, None, None)
            continue
        apart = float(np.linalg.norm(a.mean[:, slot] - b.mean[:, slot])) / norm
        expected = math.sqrt(float((a.variance[:, slot] + b.variance[:, slot]).sum())) / norm
        visible = limit * math.sqrt(sigma2) / energies[1]
        yield BounceDifference(bounces.name(slot), energies[0] / energies[1] - 1, visible, apart, expected)
