"""THE MAP: a capture from its configuration to its file, as one list of stages. Read this first.

Stages: configuration -> scene -> capture and plan -> engine -> file. Mitsuba and Dr.Jit are imported only when a
render starts, after the backend has been chosen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.analysis.forecast import Forecast, forecast_file, forecast_render
from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.grids import Capture, build_capture
from nlosrender.capture.limits import refuse_impossible_grids, refuse_impossible_samples
from nlosrender.capture.plan import Plan, plan_capture
from nlosrender.capture.time_axis import TimeAxis, resolve_time_axis
from nlosrender.config.document import Config
from nlosrender.config.load import config_hash, config_to_dict
from nlosrender.config.warnings import config_warnings
from nlosrender.engine.backend import Backend, batch_memory, physical_memory, start_backend
from nlosrender.errors import ConfigError, Problem
from nlosrender.files.capture_file import CaptureHeader
from nlosrender.files.provenance import provenance_attributes, result_attributes
from nlosrender.files.replacement import check_writable
from nlosrender.files.size import disk_warnings
from nlosrender.files.writer import CaptureWriter
from nlosrender.scene.hidden_geometry import Surface, hidden_surfaces
from nlosrender.scene.relay_wall import RelayWall, relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.engine.path_engine import PathEngine
    from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
    from nlosrender.scene.build import BuiltScene

    Engine = PathEngine | VirtualLightEngine

Progress = Callable[[float], None]  # told the share of the work that is done, in [0, 1]
Warn = Callable[[str], None]  # told one warning


@dataclass
class Stopwatch:
    """Seconds spent per stage."""

    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("scene", "compile", "render", "write"), 0.0)
    )
    begun: float = field(default_factory=time.perf_counter)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start

    def report(self) -> dict[str, float]:
        """Return seconds per stage and ``total`` since the stopwatch was made."""
        return self.seconds | {"total": time.perf_counter() - self.begun}


@dataclass(frozen=True)
class RenderReport:
    """What a finished render has to say for itself."""

    output: Path
    engine: str
    reason: str  # why this engine
    variant: str  # Mitsuba variant
    samples: int  # paths per sensor point, the least of all batches
    error_estimate: float  # relative L2 error of H over the whole capture
    energy: dict[str, float]  # H summed over the capture, per bounce [J m^-2 sr^-1]
    out_of_window: float  # the same outside the time window
    n_bins: int
    n_triangles: int
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Warnings:
    """Warnings, each said once."""

    warn: Warn
    said: dict[str, None] = field(default_factory=dict)  # in the order they were said

    def say(self, texts: Iterable[str]) -> None:
        """Pass on those that are new."""
        for text in texts:
            if text not in self.said:
                self.said[text] = None
                self.warn(text)


def render_capture(
    config: Config, progress: Progress = lambda fraction: None, warn: Warn = lambda text: None
) -> RenderReport:
    """Render one capture and write its file.

    Parameters
    ----------
    config
        A validated configuration.
    progress
        Called now and then with the share of the work done.
    warn
        Called with every warning, before the first batch.

    Raises
    ------
    ConfigError
        Something only the renderer could find wrong: a mesh that cannot be read, a BSDF that Mitsuba rejects.
    BackendError
        There is no usable LLVM or GPU.
    FileError
        The output cannot be written.
    RenderError
        The capture does not fit the memory limit, or the result is not finite.
    """
    stopwatch, warnings = Stopwatch(), Warnings(warn)
    warnings.say(config_warnings(config))
    with stopwatch.stage("scene"):
        check_writable(config.output.path)
        backend, plan, engine, header = set_up(config, warnings)
    provenance = provenance_attributes(
        config_to_dict(config), config_hash(config), engine=engine.name, seed=config.render.seed
    )
    with CaptureWriter(
        config.output.path,
        header,
        attributes=provenance,
        compression=config.output.compression,
        store_variance=config.output.variance,
    ) as writer:
        totals = render_batches(config, plan, engine, writer, stopwatch, progress)
        seconds = stopwatch.report()
        writer.set_attributes(
            result_attributes(
                samples=totals.samples,
                error_estimate=totals.error_estimate,
                seconds=seconds,
                out_of_window_energy=totals.outside,
            )
            | {"variant": backend.variant}
        )
    return RenderReport(
        output=Path(config.output.path),
        engine=engine.name,
        reason=engine_reason(config, engine),
        variant=backend.variant,
        samples=totals.samples or 0,
        error_estimate=totals.error_estimate,
        energy=totals.energy_per_bounce(engine.options.bounces),
        out_of_window=totals.outside,
        n_bins=header.n_bins,
        n_triangles=engine.built.n_triangles,
        seconds=stopwatch.report(),
        warnings=tuple(warnings.said),
    )


def set_up(config: Config, warnings: Warnings) -> tuple[Backend, Plan, Engine, CaptureHeader]:
    """Stages 2 to 4 up to the first ray: scene, capture, plan, engine, and what the file will say of them."""
    backend = start_backend(config.render.backend, colored=config.is_colored)
    built = load_scene(config)
    capture, time_axis = describe_capture(config, built.wall, built)
    plan, engine = prepare(config, backend, built, capture, time_axis)
    header = describe_file(config, built, capture, time_axis)
    warnings.say(late_warnings(config, backend, plan, engine, header))
    return backend, plan, engine, header


def forecast_capture(config: Config) -> Forecast:
    """Say what ``render_capture`` will do and cost; a pilot renders a part of it, and no file is written.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As ``render_capture``.
    """
    warnings = Warnings(lambda text: None)
    begun = time.perf_counter()
    warnings.say(config_warnings(config))
    backend, plan, engine, header = set_up(config, warnings)
    spent = time.perf_counter() - begun
    reason = engine_reason(config, engine)
    return forecast_render(config, backend, plan, engine, reason, header, tuple(warnings.said), spent)


def late_warnings(config: Config, backend: Backend, plan: Plan, engine: Engine, header: CaptureHeader) -> Iterator[str]:
    """Yield the warnings that take a scene, a plan and an engine; ``config_warnings`` needs none of them."""
    from nlosrender.engine.memory import memory_warnings
    from nlosrender.engine.scene_warnings import scene_warnings

    yield from scene_warnings(engine)
    yield from memory_warnings(engine, plan, config.render.memory_limit_bytes, backend.lanes)
    yield from disk_warnings(Path(config.output.path), forecast_file(config, header, engine))


def engine_reason(config: Config, engine: Engine) -> str:
    """Return why the capture is rendered by the engine it is."""
    from nlosrender.engine.planner import choose_engine

    return choose_engine(config.render, engine.capture, engine.built).reason


def load_scene(config: Config) -> BuiltScene:
    """Stage 2: place wall and hidden geometry in the local frame and hand them to Mitsuba (backend started)."""
    from nlosrender.scene.build import build_scene

    wall, surfaces = place_scene(config)
    return build_scene(wall, config.scene.relay_wall.bsdf, surfaces)


def place_scene(config: Config) -> tuple[RelayWall, tuple[Surface, ...]]:
    """Return the relay wall and the hidden surfaces in its local frame, without Mitsuba.

    Raises
    ------
    ConfigError
        A pose is degenerate.
    """
    try:
        wall = relay_wall_from_config(config.scene.relay_wall)
        return wall, hidden_surfaces(config.scene.hidden_geometry, wall)
    except ValueError as error:
        key, _, message = str(error).partition(": ")
        raise ConfigError(Problem("", key, message)) from error


def describe_capture(config: Config, wall: RelayWall, built: BuiltScene) -> tuple[Capture, TimeAxis]:
    """Stage 3: laser and sensor points, legs and bins."""
    refuse_impossible_grids(config.capture, config.render.memory_limit_bytes or physical_memory())
    capture = build_capture(config.capture, wall)
    time_axis = resolve_time_axis(config.time_axis, capture, wall, built.hidden_bounds, config.render.max_bounces)
    return capture, time_axis


def prepare(
    config: Config, backend: Backend, built: BuiltScene, capture: Capture, time_axis: TimeAxis
) -> tuple[Plan, Engine]:
    """Stages 3 and 4: cut the work into batches and set up the engine."""
    from nlosrender.engine.path_engine import PathEngine, PathOptions
    from nlosrender.engine.planner import choose_engine
    from nlosrender.engine.virtual_lights.engine import VirtualLightEngine

    render = config.render
    bounces = BounceAxis(render.max_bounces, render.split_bounces)
    channels = 3 if config.is_colored else 1
    memory, rows = batch_memory(render.memory_limit_bytes), bounces.n_slots * channels
    refuse_impossible_samples(config.capture, rows_per_pair=rows, n_bins=time_axis.n_bins, memory_limit=memory)
    plan = plan_capture(capture, rows_per_pair=rows, n_bins=time_axis.n_bins, lanes=backend.lanes, memory_limit=memory)
    options = PathOptions(
        bounces=bounces,
        laser_sampling=render.laser_sampling,
        hidden_geometry_sampling=render.hidden_geometry_sampling,
        russian_roulette=render.russian_roulette,
        channels=channels,
        seed=render.seed,
        replicas=plan.replicas,
    )
    if choose_engine(render, capture, built).name == "path":
        return plan, PathEngine(built, capture, time_axis, options)
    return plan, VirtualLightEngine(built, capture, time_axis, options, backend.lanes)


@dataclass
class Totals:
    """Sums over all batches."""

    noise: float = 0.0  # sum of variances
    squares: float = 0.0  # sum of squared estimates
    energy: dict[int, float] = field(default_factory=dict)  # per bounce slot
    outside: float = 0.0
    samples: int | None = None

    @property
    def error_estimate(self) -> float:
        """Relative L2 error of H over everything rendered so far."""
        from nlosrender.engine.histogram import relative_l2_error

        return relative_l2_error(self.noise, self.squares)

    def energy_per_bounce(self, bounces: BounceAxis) -> dict[str, float]:
        """Return the energy by bounce number, or under ``all`` when bounces are not split."""
        return {bounces.name(slot): energy for slot, energy in sorted(self.energy.items())}


def render_batches(
    config: Config, plan: Plan, engine: Engine, writer: CaptureWriter, stopwatch: Stopwatch, progress: Progress
) -> Totals:
    """Stages 4 and 6: render batch after batch, write each as it is done."""
    from nlosrender.engine.path_engine import Budget

    totals = Totals()
    render = config.render
    confocal = config.capture.scan_type == "confocal"
    rendering_since = time.perf_counter()
    for number, batch in enumerate(plan.batches):
        limit = render.time_limit_s
        if limit is not None:  # what is left of the time, shared by the batches that are left
            limit = max(0.0, limit - (time.perf_counter() - rendering_since)) / (len(plan.batches) - number)
        budget = Budget(render.spp, render.target_error, limit)
        compiled = engine.compile_seconds
        with stopwatch.stage("render"):
            histogram = engine.render(batch, budget, partial(_progress_within, progress, number, len(plan.batches)))
        compiled = engine.compile_seconds - compiled
        stopwatch.seconds["compile"] += compiled
        stopwatch.seconds["render"] -= compiled
        totals.noise += float(histogram.variance.sum())
        totals.squares += float((histogram.mean**2).sum())
        totals.outside += float(histogram.outside.sum())
        totals.samples = min(histogram.samples, totals.samples if totals.samples is not None else histogram.samples)
        for slot in range(histogram.mean.shape[1]):
            totals.energy[slot] = totals.energy.get(slot, 0.0) + float(histogram.mean[:, slot].sum())
        with stopwatch.stage("write"):
            lasers = (1, 1) if confocal else batch.lasers.shape
            channels, slots, _, _, n_bins = histogram.mean.shape
            axes = (channels, slots, *lasers, *batch.sensors.shape, n_bins)
            writer.write(
                histogram.mean.reshape(axes),
                laser_at=(0, 0) if confocal else (batch.lasers.y0, batch.lasers.x0),
                sensor_at=(batch.sensors.y0, batch.sensors.x0),
                variance=histogram.variance.reshape(axes) if config.output.variance else None,
            )
        progress((number + 1) / len(plan.batches))
    return totals


def _progress_within(progress: Progress, number: int, n_batches: int, share: float) -> None:
    progress((number + share) / n_batches)


def describe_file(config: Config, built: BuiltScene, capture: Capture, time_axis: TimeAxis) -> CaptureHeader:
    """Stage 6: what the file says beside its samples."""
    bounces = BounceAxis(config.render.max_bounces, config.render.split_bounces)
    return CaptureHeader(
        scan_type=capture.scan_type,
        sensor_positions=capture.sensor_grid.positions,
        sensor_normals=capture.sensor_grid.normals,
        laser_positions=capture.laser_grid.positions,
        laser_normals=capture.laser_grid.normals,
        sensor_position=capture.sensor_position,
        laser_position=capture.laser_position,
        sensor_grid_size=capture.sensor_grid.size,
        laser_grid_size=capture.laser_grid.size,
        n_bins=time_axis.n_bins,
        bin_width_opl=time_axis.bin_width_opl,
        start_opl=time_axis.start_opl,
        n_channels=3 if config.is_colored else 1,
        bounce_indices=bounces.file_indices,
        max_bounces=config.render.max_bounces,
        split_bounces=config.render.split_bounces,
        account_first_and_last_bounces=capture.account_first_and_last_bounces,
        hidden_bounds=built.hidden_bounds,
        pose=built.wall.pose,
        frame=config.output.frame,
        planar_wall=built.wall.is_planar,
    )
