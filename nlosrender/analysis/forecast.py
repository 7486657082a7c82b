"""What a render will do, cost and leave behind, told before it starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.capture.arrivals import filled_shares
from nlosrender.capture.plan import Plan
from nlosrender.config.document import Config
from nlosrender.constants import readable_duration
from nlosrender.engine.backend.start import Backend, scene_memory
from nlosrender.files.capture_file import CaptureHeader
from nlosrender.files.size import FileSize, forecast_size
from nlosrender.scene.mesh_report import MeshReport

if TYPE_CHECKING:
    from nlosrender.engine.engines import Engine
    from nlosrender.engine.preflight.omitted_work import Skipped

LONGEST_WAIT = 30 * 86_400.0  # s


@dataclass(frozen=True)
class Forecast:
    """The answer of ``nlosrender plan``."""

    engine: str
    reason: str  # why this engine
    variant: str  # Mitsuba variant
    skipped: tuple[Skipped, ...]
    scan_type: str
    sensor_grid: tuple[int, int]  # columns, rows
    laser_grid: tuple[int, int]  # columns, rows; confocal: the sensor grid
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


def forecast_render(
    config: Config,
    backend: Backend,
    plan: Plan,
    engine: Engine,
    header: CaptureHeader,
    warnings: tuple[str, ...],
    seconds_before: float,
    unsampled: tuple[str, ...] = (),
) -> Forecast:
    """Run the pilot and put together what is known of a render.

    Parameters
    ----------
    config, backend, plan, engine
        As set up for the render.
    header, warnings
        What the file will say; what has been said already.
    seconds_before
        What it took to get here from the configuration [s].
    unsampled
        Classes of paths that no technique samples.

    Raises
    ------
    RenderError
        A batch cannot be rendered.
    """
    from nlosrender.engine.path.engine import Budget
    from nlosrender.engine.preflight.batch_memory import batch_bytes
    from nlosrender.engine.preflight.omitted_work import skipped_work
    from nlosrender.engine.preflight.time_estimate import estimate_render_time

    render, capture, time_axis = config.render, engine.capture, engine.time_axis
    n_bytes = batch_bytes(engine, plan)  # refuses what is too large before the pilot allocates a part of it
    budget = Budget(render.spp, render.target_error, render.time_limit_s)
    rendering = estimate_render_time(engine, plan, budget, backend.lanes)
    size = forecast_file(config, header, engine, rendering.lit_shares)
    seconds = None if rendering.seconds is None else rendering.seconds + seconds_before + size.write_seconds
    return Forecast(
        engine=engine.name,
        reason=engine.reason,
        variant=backend.variant,
        skipped=skipped_work(engine, scene_is_colored=config.scene.is_colored),
        scan_type=capture.scan_type,
        sensor_grid=(capture.sensor_grid.nx, capture.sensor_grid.ny),
        laser_grid=(capture.laser_grid.nx, capture.laser_grid.ny),
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
        units=len(plan.units),
        seconds_per_unit=None if rendering.seconds is None else rendering.seconds / len(plan.units),
        estimate_basis=rendering.basis,
        warnings=(*warnings, *duration_warnings(config, seconds)),
        meshes=engine.built.meshes,
        unsampled_paths=unsampled,
    )


def duration_warnings(config: Config, seconds: float | None) -> Iterator[str]:
    """Yield what to do about a render that takes longer than anybody waits.

    Parameters
    ----------
    config
        What is rendered.
    seconds
        It takes [s]; None: not known.
    """
    if seconds is not None and seconds > LONGEST_WAIT:
        goal = "a larger render.target_error" if config.render.spp is None else "a lower render.spp"
        yield (
            f"this takes about {readable_duration(seconds)} on this machine: ask for {goal}, fewer points or bins, or "
            "set render.time_limit_s."
        )


def forecast_file(
    config: Config,
    header: CaptureHeader,
    engine: Engine,
    lit_shares: Sequence[float | None] | None = None,
) -> FileSize:
    """Return how large the file of a render will be.

    Parameters
    ----------
    config, header, engine
        As set up for the render.
    lit_shares
        For each bounce slot the share of bins that held light in a pilot; None where there was none. The boxes
        around the scene, which bound the light of every bounce, are far from tight above the third.
    """
    wall, bounds = engine.built.wall, header.hidden_bounds
    filled = filled_shares(engine.capture, wall, bounds, engine.time_axis, engine.options.bounces)
    if lit_shares is not None:
        filled = tuple(most if lit is None else min(most, lit) for most, lit in zip(filled, lit_shares, strict=True))
    compression, variance = config.output.compression, config.output.variance
    return forecast_size(
        header.sizes,
        header.confocal,
        filled,
        compression=compression,
        variance=variance,
        line_of_sight=config.capture.is_line_of_sight,
    )
