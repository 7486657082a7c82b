"""Stages 2 to 4 up to the first ray: configuration -> scene -> capture and plan -> engine, and what the file will say.

Mitsuba and Dr.Jit are imported inside the functions: the backend has to be chosen before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from nlosrender.capture.arrivals import latest_arrival
from nlosrender.capture.bounces import BounceAxis, first_bounce_of
from nlosrender.capture.grids import Capture, build_capture
from nlosrender.capture.limits import refuse_impossible_grids, refuse_impossible_samples, refuse_wide_kernel
from nlosrender.capture.part import WHOLE, Selection
from nlosrender.capture.plan import Plan, plan_capture
from nlosrender.capture.time_axis import TimeAxis, resolve_time_axis
from nlosrender.config.document import Config
from nlosrender.engine.backend.start import Backend, batch_memory, physical_memory, start_backend
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.layout import sensor_tile
from nlosrender.rendering.process_layout import ONE_PROCESS, ProcessLayout
from nlosrender.scene.surfaces import Surface, hidden_surfaces
from nlosrender.scene.walls.wall import RelayWall
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.engine.interface import Budget, Engine
    from nlosrender.scene.build import BuiltScene
    from nlosrender.scene.view import BuiltView


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
    config: Config,
    backend: Backend,
    selection: Selection = WHOLE,
    processes: ProcessLayout = ONE_PROCESS,
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Plan, Engine, CaptureHeader]:
    """Stages 2 to 4 up to the first ray: scene, capture, plan, engine, and what the file will say of them."""
    from nlosrender.engine.preflight.omitted_work import shared_samples

    built = load_view(config) if config.capture.is_line_of_sight else load_scene(config)
    capture, time_axis = describe_capture(config, built.wall, built)
    with processes.named(config.render.memory_limit_bytes):
        plan, engine = prepare(config, backend, built, capture, time_axis, selection, processes, changes)
    return plan, engine, describe_file(config, built, capture, time_axis, shared_samples(engine))


def calibrated_budget(config: Config, engine: Engine) -> Budget:
    """Return when to stop, settled for the whole capture at once: no result depends on how the work is cut."""
    from nlosrender.engine.interface import Budget

    return engine.calibrate(Budget(config.render.spp, config.render.target_error, config.render.time_limit_s))


def load_view(config: Config) -> BuiltView:
    """Stage 2 of a line-of-sight capture: the scene and the camera that sees it (backend started).

    Raises
    ------
    ConfigError
        A pose is degenerate, or Mitsuba rejects something.
    """
    from nlosrender.scene.view import build_view

    return build_view(config.scene, config.capture)


def load_scene(config: Config) -> BuiltScene:
    """Stage 2: place wall and hidden geometry in the local frame and hand them to Mitsuba (backend started)."""
    from nlosrender.scene.build import build_scene
    from nlosrender.scene.loading.pixel_scene import build_pixel_scene

    if config.has_pixel_points:
        return build_pixel_scene(config.scene, config.capture)
    wall, surfaces = place_scene(config)
    return build_scene(wall, config.scene.wall.bsdf, surfaces)


def place_scene(config: Config) -> tuple[RelayWall, tuple[Surface, ...]]:
    """Return the relay wall and the hidden surfaces in its local frame, without Mitsuba.

    Raises
    ------
    ConfigError
        A pose is degenerate.
    """
    wall = relay_wall_from_config(config.scene.wall)
    return wall, hidden_surfaces(config.scene.hidden_geometry, wall.pose)


def describe_capture(config: Config, wall: RelayWall, built: BuiltScene | BuiltView) -> tuple[Capture, TimeAxis]:
    """Stage 3: laser and sensor points, legs and bins."""
    refuse_impossible_grids(config.capture, config.render.memory_limit_bytes or physical_memory())
    capture = build_capture(config.capture, wall, getattr(built, "pixels", None))
    latest = latest_arrival(capture, wall, built.hidden_bounds, config.render.max_bounces)
    time_axis = resolve_time_axis(config.time_axis, latest)
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
    processes: ProcessLayout = ONE_PROCESS,
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[Plan, Engine]:
    """Stages 3 and 4: cut the work into items and set up the engine; ``changes`` to ``RenderOptions`` on request."""
    from nlosrender.engine.launch.device_capture import RenderOptions
    from nlosrender.engine.planner import choose_engine

    render = config.render
    bounces = bounce_axis(config)
    channels = config.n_channels
    limit, rows = processes.memory_limit(render.memory_limit_bytes), bounces.n_slots * channels
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
        max_item_samples=processes.max_item_samples,
        min_items=processes.min_items,
    )
    options = RenderOptions(
        bounces=bounces,
        laser_sampling=render.laser_sampling,
        hidden_geometry_sampling=render.hidden_geometry_sampling,
        russian_roulette=render.russian_roulette,
        channels=channels,
        seed=render.seed,
        replicas=plan.replicas,
        temporal_kernel_bins=render.temporal_kernel_opl / time_axis.bin_width_opl,
    )
    options = replace(options, **changes)
    return plan, choose_engine(render, built, capture, time_axis, options, backend.lanes)


def describe_file(
    config: Config, built: BuiltScene | BuiltView, capture: Capture, time_axis: TimeAxis, shared: str = ""
) -> CaptureHeader:
    """Stage 6: what the file says beside its samples."""
    bounces = bounce_axis(config)
    weights = capture.laser_weights
    spots = None if weights is None else (capture.laser_grid.positions[0], weights)
    return CaptureHeader(
        scan_type=capture.scan_type,
        sensor_positions=capture.sensor_grid.positions,
        sensor_normals=capture.sensor_grid.normals,
        laser_positions=capture.laser_grid.positions if spots is None else capture.middle_of_spots,
        laser_normals=capture.laser_grid.normals if spots is None else capture.laser_grid.normals[:, :1],
        sensor_position=capture.sensor_position,
        laser_position=capture.laser_position,
        sensor_grid_size=capture.sensor_grid.size,
        laser_grid_size=capture.laser_grid.size if spots is None else (0.0, 0.0),
        n_bins=time_axis.n_bins,
        bin_width_opl=time_axis.bin_width_opl,
        start_opl=time_axis.start_opl,
        n_channels=config.n_channels,
        bounce_indices=bounces.file_indices,
        max_bounces=config.render.max_bounces,
        split_bounces=config.render.split_bounces,
        account_first_and_last_bounces=capture.account_first_and_last_bounces,
        hidden_bounds=built.unseen_bounds,
        pose=built.wall.pose,
        frame=config.output.frame,
        planar_wall=built.wall.is_planar,
        empty_sensors=capture.sensor_grid.is_empty,
        empty_lasers=capture.laser_grid.is_empty,
        n_unlit_lasers=capture.n_unlit_lasers,
        shared_samples=shared,
        point_lists=capture.point_lists,
        laser_spots=spots,
        laser_flash="" if capture.laser_flash is None else capture.laser_flash.in_words,
        footprint=None if capture.footprint is None else (capture.footprint.in_words, capture.footprint.area),
    )
