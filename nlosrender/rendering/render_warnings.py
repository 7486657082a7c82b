"""Warnings before the first ray that need the scene, the plan and the engine, and the size of the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.capture.arrivals import filled_shares
from nlosrender.capture.plan import Plan
from nlosrender.config.document import Config
from nlosrender.engine.backend.start import Backend
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.size_estimate import FileSize, disk_warnings, forecast_size
from nlosrender.rendering.process_layout import ONE_PROCESS, ProcessLayout

if TYPE_CHECKING:
    from nlosrender.engine.interface import Engine


def render_warnings(
    config: Config,
    backend: Backend,
    plan: Plan,
    engine: Engine,
    header: CaptureHeader,
    processes: ProcessLayout = ONE_PROCESS,
) -> Iterator[str]:
    """Yield the warnings about scene, memory and disk; ``config_warnings`` has those that need the configuration only.

    Raises
    ------
    ConfigError
        A batch does not fit the memory, or the detector the time axis.
    """
    from nlosrender.engine.preflight.batch_memory import memory_warnings
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    yield from scene_warnings(engine)
    if config.sensor is not None:
        from nlosrender.sensor.detector import detector_of, detector_warnings
        from nlosrender.sensor.rebinning import TimeBins

        bins = TimeBins(header.start_opl, header.bin_width_opl, header.n_bins)
        yield from detector_warnings(detector_of(config.sensor, bins))
    yield from memory_warnings(engine, plan, processes.memory_limit(config.render.memory_limit_bytes), backend.lanes)
    share = plan.part.share_of(plan.tiling.everything(header.sizes["laser_y"] * header.sizes["laser_x"]))
    size = expected_file_size(config, header, engine)
    yield from disk_warnings(
        Path(config.output.path), replace(size, disk_bytes_estimate=int(size.disk_bytes_estimate * share))
    )


def expected_file_size(
    config: Config, header: CaptureHeader, engine: Engine, lit_shares: Sequence[float | None] | None = None
) -> FileSize:
    """Return how large the file of a whole capture will be.

    ``lit_shares`` has for each bounce slot the share of bins that held light in a pilot, None where there was none:
    the boxes around the scene, which bound the light of every bounce, are far from tight above the third.
    """
    wall, bounds = engine.built.wall, header.hidden_bounds
    filled = filled_shares(engine.capture, wall, bounds, engine.time_axis, engine.options.bounces)
    if lit_shares is not None:
        filled = tuple(most if lit is None else min(most, lit) for most, lit in zip(filled, lit_shares, strict=True))
    size = forecast_size(
        header.sizes,
        header.confocal,
        filled,
        compression=config.output.compression,
        variance=config.output.variance,
        line_of_sight=config.capture.is_line_of_sight,
    )
    besides = ["the ground truth"] * bool(config.output.ground_truth) + ["the counts"] * (config.sensor is not None)
    if not besides:
        return size
    return replace(size, assumption=f"{size.assumption}; without {' and '.join(besides)}")
