"""THE MAP: a capture from its configuration to its file, as one list of stages. Read this first.

Stages: configuration -> scene -> capture and plan -> engine -> file, the last two unit after unit (``rendering/``).
Mitsuba and Dr.Jit are imported only when a render starts, after the backend has been chosen.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.analysis.engine_check import MOST_REPLICAS, TECHNIQUES, EngineCheck, compare_trials, try_technique
from nlosrender.analysis.forecast import Forecast, forecast_file, forecast_render
from nlosrender.capture.bounces import BounceAxis, first_bounce_of
from nlosrender.capture.grids import Capture, build_capture
from nlosrender.capture.limits import refuse_impossible_grids, refuse_impossible_samples, refuse_wide_kernel
from nlosrender.capture.part import WHOLE, Selection
from nlosrender.capture.plan import Plan, plan_capture, remaining_units, replicas_for
from nlosrender.capture.time_axis import TimeAxis, resolve_time_axis
from nlosrender.config.document import Config
from nlosrender.config.load import config_hash, config_to_dict
from nlosrender.config.warnings import config_warnings
from nlosrender.engine.backend.start import Backend, batch_memory, physical_memory, start_backend
from nlosrender.errors import OptionError
from nlosrender.files.capture_file import CaptureHeader
from nlosrender.files.chunks import sensor_tile
from nlosrender.files.identity import capture_identity, files_read, identity_attributes
from nlosrender.files.kinds import CAPTURE
from nlosrender.files.part_attributes import part_attributes
from nlosrender.files.partial_capture import PartialCapture
from nlosrender.files.provenance import provenance_attributes
from nlosrender.files.replacement import check_writable
from nlosrender.files.size import disk_warnings
from nlosrender.rendering.dask_executor import render_on_cluster
from nlosrender.rendering.dask_worker import Job
from nlosrender.rendering.local import render_units, resumable
from nlosrender.rendering.outcome import Outcome, missing_light
from nlosrender.rendering.report import Progress, RenderReport, Stopwatch, Warn, Warnings, Watch
from nlosrender.rendering.sharing import ALONE, Sharing
from nlosrender.scene.hidden_geometry import Surface, hidden_surfaces
from nlosrender.scene.placing import placed
from nlosrender.scene.relay_wall import RelayWall, relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.engine.path.engine import Budget
    from nlosrender.engine.preflight.unsampled_paths import UnsampledPaths
    from nlosrender.rendering.dask_cluster import Cluster
    from nlosrender.rendering.units import Engine
    from nlosrender.scene.build import BuiltScene
    from nlosrender.scene.view import BuiltView


def render_capture(
    config: Config,
    progress: Progress = lambda fraction: None,
    warn: Warn = lambda text: None,
    *,
    selection: Selection = WHOLE,
    resume: bool | None = None,
    cluster: Cluster | None = None,
    watch: Watch = lambda standing: None,
    strict: bool = False,
) -> RenderReport:
    """Render one capture, or a part of it, and write its file.

    Parameters
    ----------
    config
        A validated configuration.
    progress
        Called now and then with the share of the work done.
    warn
        Called with every warning, before the first unit.
    selection
        The part that is rendered.
    resume
        None: go on with an unfinished render of the same capture where there is one; True: there has to be one;
        False: start anew.
    cluster
        Who renders the units; None: this process. The file is the same.
    watch
        Called with how many units are finished: before the first one, and after each.
    strict
        Refuse to render where light is missing that no technique samples.

    Raises
    ------
    ConfigError
        ``strict``, and there are paths that carry light and are not sampled.
        Something only the renderer could find wrong: a mesh that cannot be read, a BSDF that Mitsuba rejects, a
        capture that does not fit the memory, a memory limit below what the program itself takes.
    OptionError
        The capture does not have the part that is selected.
    BackendError
        There is no usable LLVM or GPU, here or on a worker.
    FileError
        The output cannot be written, there is an unfinished render of something else, or a file that is not this
        capture: another capture is replaced when ``resume`` is False, anything else never.
    RenderError
        The result is not finite.
    IncompleteRender, InterruptedRender
        The render stopped half-way; the same call goes on from there.
    """
    stopwatch, warnings = Stopwatch(), Warnings(warn)
    warnings.say(config_warnings(config))
    resolved, output = config_to_dict(config), config.output
    with stopwatch.stage("scene"):
        check_writable(output.path, CAPTURE, files_read(resolved))
        backend = started_backend(config)
    sharing = ALONE if cluster is None else cluster.sharing
    replicas = replicas_for(backend.lanes, config.capture.sensor_grid.n_points)
    identity = capture_identity(resolved, str(selection), backend.variant, replicas)
    with PartialCapture.claim(output.path, identity, resume) as partial:
        with stopwatch.stage("scene"):
            plan, engine, header = set_up_engine(config, backend, selection, sharing)
            unsampled = missing_light(engine, strict)
            warnings.say(paths.warning for paths in unsampled)
            warnings.say(late_warnings(config, backend, plan, engine, header, sharing))
        with stopwatch.stage("render"):
            budget = settled_budget(config, engine)
        with resumable(partial) as stop:
            provenance = provenance_attributes(
                resolved, config_hash(config), engine=engine.name, seed=config.render.seed, meshes=engine.built.meshes
            )
            partial.open(header, provenance | identity_attributes(identity), output.compression, output.variance)
            warnings.say(partial.damage)
            earlier = len(partial.tally.units)
            units = remaining_units(plan, header.confocal, partial.tally.units)
            if cluster is None:
                render = functools.partial(render_units, units, engine, budget, partial, stop)
            else:
                job = Job(config, selection, identity, backend.name, sharing, set_up_engine)
                render = functools.partial(render_on_cluster, units, job, budget, partial, stop, cluster)
            render(
                store_variance=output.variance,
                stopwatch=stopwatch,
                progress=progress,
                warn=lambda text: warnings.say([text]),
                watch=(lambda standing: watch(replace(standing, error=None))) if unsampled else watch,
            )
            tally = partial.tally
            outcome = Outcome.of(config.render, engine, unsampled, tally.sums)
            warnings.say(outcome.warnings)
            results = outcome.attributes(stopwatch.report(), is_whole=selection == WHOLE)
            if selection != WHOLE:
                results |= part_attributes(plan.part, plan.tiling, tally)
            partial.publish(results)
    return RenderReport(
        output=Path(output.path),
        engine=engine.name,
        reason=engine.reason,
        variant=backend.variant,
        part=None if selection == WHOLE else str(plan.part),
        units=earlier + len(units),
        resumed_units=earlier,
        samples=tally.sums.samples or 0,
        error_estimate=outcome.stated_error,
        energy=tally.sums.energy_per_bounce(outcome.bounces),
        out_of_window=float(tally.sums.outside),
        n_bins=header.n_bins,
        n_triangles=engine.built.n_triangles,
        seconds=stopwatch.report(),
        warnings=tuple(warnings.said),
        unsampled_paths=outcome.missing,
        zero_because=outcome.zero_because,
        error_estimate_per_bounce=outcome.known_per_bounce(tally.sums.errors_per_bounce(outcome.bounces)),
        energy_error_per_bounce=outcome.known_per_bounce(tally.sums.energy_errors(outcome.bounces)),
    )


def started_backend(config: Config) -> Backend:
    """Start what renders a configuration.

    Raises
    ------
    BackendError
        There is no usable LLVM or GPU.
    """
    render = config.render
    return start_backend(render.backend, colored=config.is_colored, polarized=render.polarized)


def set_up_engine(
    config: Config, backend: Backend, selection: Selection = WHOLE, sharing: Sharing = ALONE
) -> tuple[Plan, Engine, CaptureHeader]:
    """Stages 2 to 4 up to the first ray: scene, capture, plan, engine, and what the file will say of them."""
    from nlosrender.engine.preflight.omitted_work import shared_samples

    built = load_view(config) if config.capture.is_line_of_sight else load_scene(config)
    capture, time_axis = describe_capture(config, built.wall, built)
    with sharing.named(config.render.memory_limit_bytes):
        plan, engine = prepare(config, backend, built, capture, time_axis, selection, sharing)
    return plan, engine, describe_file(config, built, capture, time_axis, shared_samples(engine))


def settled_budget(config: Config, engine: Engine) -> Budget:
    """Return when to stop, settled for the whole capture at once: no unit's result depends on how the work is cut."""
    from nlosrender.engine.path.engine import Budget

    return engine.settle(Budget(config.render.spp, config.render.target_error, config.render.time_limit_s))


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
    backend = started_backend(config)
    plan, engine, header = set_up_engine(config, backend)
    unsampled = missing_light(engine)
    warnings.say(paths.warning for paths in unsampled)
    warnings.say(late_warnings(config, backend, plan, engine, header))
    spent = time.perf_counter() - begun
    missing = tuple(paths.summary for paths in unsampled)
    return forecast_render(config, backend, plan, engine, header, tuple(warnings.said), spent, missing)


def check_engines(
    config: Config,
    *,
    points_per_axis: int,
    target_error: float,
    time_limit_s: float,
    significance: float,
    progress: Callable[[str], None] = lambda technique: None,
) -> EngineCheck:
    """Render a few sensor points by every technique that can, and say how far these are apart; no file is written.

    Parameters
    ----------
    config
        A validated configuration; its own goal of samples, error or time is not used.
    points_per_axis
        Sensor points along each side of the grid, spread over it; of exhaustive captures 3 x 3 laser points.
    target_error, time_limit_s
        When a technique stops: relative L2 error of H, or seconds.
    significance
        Chance of a false alarm.
    progress
        Told the name of each technique before it starts.

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
    from nlosrender.engine.path.engine import Budget

    built = load_scene(config)
    capture, time_axis = describe_capture(config, built.wall, built)
    pilot = pilot_of(capture, points_per_axis)
    replicas = min(replicas_for(backend.lanes, pilot.sensors.size), MOST_REPLICAS)
    budget, trials = Budget(target_error=target_error, time_limit_s=time_limit_s), []
    missing: tuple[UnsampledPaths, ...] = ()
    for technique in TECHNIQUES:
        progress(technique.name)
        changes = {"spp": None, "temporal_kernel_opl": 0.0, **technique.changes}
        changed = config.model_copy(update={"render": config.render.model_copy(update=changes)})
        _, engine = prepare(changed, backend, built, capture, time_axis, replicas=replicas)
        missing = missing or missing_light(engine)
        trials.append(try_technique(technique, engine, pilot, budget))
    pairs = compare_trials(trials, bounce_axis(config), pilot, significance)
    unsampled = tuple(paths.summary for paths in missing)
    n_lasers = 1 if capture.scan_type == "confocal" else pilot.lasers.size
    return EngineCheck(pilot.sensors.size, n_lasers, tuple(trials), tuple(pairs), unsampled)


def late_warnings(
    config: Config, backend: Backend, plan: Plan, engine: Engine, header: CaptureHeader, sharing: Sharing = ALONE
) -> Iterator[str]:
    """Yield the warnings that take a scene, a plan and an engine; ``config_warnings`` needs none of them."""
    from nlosrender.engine.preflight.batch_memory import memory_warnings
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    yield from scene_warnings(engine)
    yield from memory_warnings(engine, plan, sharing.memory_limit(config.render.memory_limit_bytes), backend.lanes)
    share = plan.part.share_of(plan.tiling.everything(header.sizes["laser_y"] * header.sizes["laser_x"]))
    size = forecast_file(config, header, engine)
    yield from disk_warnings(
        Path(config.output.path), replace(size, disk_bytes_estimate=int(size.disk_bytes_estimate * share))
    )


def load_view(config: Config) -> BuiltView:
    """Stage 2 of a line-of-sight capture: the scene and the camera that sees it (backend started).

    Raises
    ------
    ConfigError
        A pose is degenerate, or Mitsuba rejects something.
    """
    from nlosrender.scene.view import build_view

    with placed():
        return build_view(config.scene, config.capture)


def load_scene(config: Config) -> BuiltScene:
    """Stage 2: place wall and hidden geometry in the local frame and hand them to Mitsuba (backend started)."""
    from nlosrender.scene.build import build_scene

    wall, surfaces = place_scene(config)
    return build_scene(wall, config.scene.wall.bsdf, surfaces)


def place_scene(config: Config) -> tuple[RelayWall, tuple[Surface, ...]]:
    """Return the relay wall and the hidden surfaces in its local frame, without Mitsuba.

    Raises
    ------
    ConfigError
        A pose is degenerate.
    """
    with placed():
        wall = relay_wall_from_config(config.scene.wall)
        return wall, hidden_surfaces(config.scene.hidden_geometry, wall)


def describe_capture(config: Config, wall: RelayWall, built: BuiltScene | BuiltView) -> tuple[Capture, TimeAxis]:
    """Stage 3: laser and sensor points, legs and bins."""
    refuse_impossible_grids(config.capture, config.render.memory_limit_bytes or physical_memory())
    capture = build_capture(config.capture, wall)
    time_axis = resolve_time_axis(config.time_axis, capture, wall, built.hidden_bounds, config.render.max_bounces)
    refuse_wide_kernel(config.render.temporal_kernel_opl, time_axis)
    return capture, time_axis


def bounce_axis(config: Config) -> BounceAxis:
    """Return which bounces are computed, and where each is added."""
    render = config.render
    return BounceAxis(render.max_bounces, render.split_bounces, first_bounce_of(config.capture.scan_type))


def prepare(
    config: Config,
    backend: Backend,
    built: BuiltScene | BuiltView,
    capture: Capture,
    time_axis: TimeAxis,
    selection: Selection = WHOLE,
    sharing: Sharing = ALONE,
    replicas: int | None = None,
) -> tuple[Plan, Engine]:
    """Stages 3 and 4: cut the work into units and set up the engine; ``replicas`` other than the plan's on request."""
    from nlosrender.engine.path.engine import PathOptions
    from nlosrender.engine.planner import choose_engine

    render = config.render
    bounces = bounce_axis(config)
    channels = config.n_channels
    limit, rows = sharing.memory_limit(render.memory_limit_bytes), bounces.n_slots * channels
    memory = batch_memory(limit, built.n_triangles)
    refuse_impossible_samples(config.capture, rows_per_pair=rows, n_bins=time_axis.n_bins, memory_limit=memory)
    _, *storage_tile = sensor_tile(time_axis.n_bins, capture.sensor_grid.ny, capture.sensor_grid.nx)
    plan = plan_capture(
        capture,
        rows_per_pair=rows,
        n_bins=time_axis.n_bins,
        lanes=backend.lanes,
        memory_limit=memory,
        storage_tile=(storage_tile[0], storage_tile[1]),
        selection=selection,
        unit_samples=sharing.unit_samples,
        least_units=sharing.least_units,
    )
    options = PathOptions(
        bounces=bounces,
        laser_sampling=render.laser_sampling,
        hidden_geometry_sampling=render.hidden_geometry_sampling,
        russian_roulette=render.russian_roulette,
        channels=channels,
        seed=render.seed,
        replicas=replicas or plan.replicas,
        temporal_kernel_bins=render.temporal_kernel_opl / time_axis.bin_width_opl,
    )
    return plan, choose_engine(render, built, capture, time_axis, options, backend.lanes)


def describe_file(
    config: Config, built: BuiltScene | BuiltView, capture: Capture, time_axis: TimeAxis, shared: str = ""
) -> CaptureHeader:
    """Stage 6: what the file says beside its samples."""
    bounces = bounce_axis(config)
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
        n_channels=config.n_channels,
        bounce_indices=bounces.file_indices,
        max_bounces=config.render.max_bounces,
        split_bounces=config.render.split_bounces,
        account_first_and_last_bounces=capture.account_first_and_last_bounces,
        hidden_bounds=built.hidden_bounds,
        pose=built.wall.pose,
        frame=config.output.frame,
        planar_wall=built.wall.is_planar,
        shared_samples=shared,
    )
