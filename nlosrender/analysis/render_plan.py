"""``nlosrender plan``: what a render will do, cost and write; measured by a pilot, without rendering it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from nlosrender.config.document import Config
from nlosrender.config.warnings import config_warnings
from nlosrender.engine.backend.start import scene_memory
from nlosrender.engine.interface import Budget, OmittedWork
from nlosrender.files.size_estimate import FileSize
from nlosrender.readable import readable_duration
from nlosrender.rendering.outcome import missing_light
from nlosrender.rendering.render_report import Warnings
from nlosrender.rendering.render_warnings import expected_file_size, render_warnings
from nlosrender.rendering.stages import set_up_engine, started_backend
from nlosrender.scene.meshes.mesh_report import MeshReport

MAX_WAIT = 30 * 86_400.0  # s; a longer render is a warning


@dataclass(frozen=True)
class RenderPlan:
    """The answer of ``nlosrender plan``."""

    engine: str
    reason: str  # why this engine
    variant: str  # Mitsuba variant
    skipped: tuple[OmittedWork, ...]
    scan_type: str
    sensor_grid: tuple[int, int]  # columns, rows
    laser_grid: tuple[int, int]  # columns, rows; confocal: the sensor grid
    point_lists: tuple[str, ...]  # which of "sensor" and "laser" points are a list: one row
    n_triangles: int  # of the hidden geometry, or of all that a camera sees
    n_bins: int
    bin_width_opl: float  # m
    window_opl: tuple[float, float]  # m
    batches: int
    bytes_per_batch: int  # of the largest
    scene_bytes: int  # that the triangles take, about
    output: Path
    file: FileSize
    seconds_estimate: float | None  # of the command, scene to file, kernels compiled; None: only noise was seen
    seconds_rendering: float | None  # of them, rendering and settling the target error
    units: int  # that are written one by one
    seconds_per_unit: float | None  # rendering
    estimate_basis: str
    warnings: tuple[str, ...]
    meshes: tuple[MeshReport, ...] = ()  # what was read of mesh files
    unsampled_paths: tuple[str, ...] = ()  # classes of paths whose light will be missing: the error will not be known

    def as_json(self) -> dict[str, object]:
        """Return a dict of what JSON knows."""
        return asdict(self) | {"output": str(self.output)}


def plan_render(config: Config) -> RenderPlan:
    """Return what ``pipeline.render_capture`` will do and cost; a pilot renders a part of it, no file is written.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As ``render_capture``.
    """
    begun = time.perf_counter()
    warnings = Warnings(lambda text: None)
    warnings.emit(config_warnings(config))
    backend = started_backend(config)  # chooses LLVM, which has to come before Dr.Jit is imported:
    from nlosrender.engine.preflight.omitted_work import omitted_work
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    plan, engine, header = set_up_engine(config, backend)
    unsampled = missing_light(engine)
    warnings.emit(paths.warning for paths in unsampled)
    warnings.emit(render_warnings(config, backend, plan, engine, header))
    set_up_seconds = time.perf_counter() - begun

    render, capture, time_axis = config.render, engine.capture, engine.time_axis
    n_bytes = engine.batch_bytes(plan)  # refuses what is too large before the pilot allocates a part of it
    budget = Budget(render.spp, render.target_error, render.time_limit_s)
    rendering = estimate_render_time(engine, plan, budget, backend.lanes)
    size = expected_file_size(config, header, engine, rendering.lit_shares)
    seconds = None if rendering.seconds is None else rendering.seconds + set_up_seconds + size.write_seconds
    warnings.emit(duration_warnings(config, seconds))
    return RenderPlan(
        engine=engine.name,
        reason=engine.reason,
        variant=backend.variant,
        skipped=omitted_work(engine, scene_is_colored=config.scene.is_colored),
        scan_type=capture.scan_type,
        sensor_grid=(capture.sensor_grid.nx, capture.sensor_grid.ny),
        laser_grid=(capture.laser_grid.nx, capture.laser_grid.ny),
        point_lists=capture.point_lists,
        n_triangles=engine.built.n_triangles,
        n_bins=time_axis.n_bins,
        bin_width_opl=time_axis.bin_width_opl,
        window_opl=(time_axis.start_opl, time_axis.end_opl),
        batches=len(plan.batches),
        bytes_per_batch=n_bytes,
        scene_bytes=scene_memory(engine.built.n_triangles),
        output=Path(config.output.path),
        file=size,
        seconds_estimate=seconds,
        seconds_rendering=rendering.seconds,
        units=len(plan.work_items),
        seconds_per_unit=None if rendering.seconds is None else rendering.seconds / len(plan.work_items),
        estimate_basis=rendering.basis,
        warnings=tuple(warnings.emitted),
        meshes=engine.built.meshes,
        unsampled_paths=tuple(paths.summary for paths in unsampled),
    )


def duration_warnings(config: Config, seconds: float | None) -> Iterator[str]:
    """Yield a warning about a render of ``seconds`` (None: not known) that takes longer than anybody waits."""
    if seconds is not None and seconds > MAX_WAIT:
        goal = "a larger render.target_error" if config.render.spp is None else "a lower render.spp"
        yield (
            f"this takes about {readable_duration(seconds)} on this machine: ask for {goal}, fewer points or bins, or "
            "set render.time_limit_s."
        )
