"""Render a configuration into memory, through the pipeline's own stages, without a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import Plan, plan_capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.config.document import Config
from nlosrender.config.load import parse_config
from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

Array = NDArray[np.float64]
Scene = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Rendering:
    """A capture in memory; ``mean`` and ``variance`` have the axes (channel, bounce, ly, lx, sy, sx, bin).

    ``outside`` (channel, bounce, ly, lx, sy, sx) is H outside the time window. Confocal captures have ly = lx = 1.
    """

    mean: Array
    variance: Array
    outside: Array
    capture: Capture
    time_axis: TimeAxis
    bounces: BounceAxis
    samples: int  # per sensor point
    error_estimate: float
    plan: Plan

    @property
    def total(self) -> Array:
        """Mean summed over channels and bounces: (ly, lx, sy, sx, bin)."""
        return self.mean.sum(axis=(0, 1))

    @property
    def total_variance(self) -> Array:
        """Variance of ``total`` if the bounces were independent."""
        return self.variance.sum(axis=(0, 1))

    def bounce(self, number: int) -> Array:
        """Mean of one bounce, grey: (ly, lx, sy, sx, bin)."""
        return self.mean[0, self.bounces.slot(number)]

    def bounce_variance(self, number: int) -> Array:
        """Variance of one bounce, grey: (ly, lx, sy, sx, bin)."""
        return self.variance[0, self.bounces.slot(number)]


def flat_wall(
    *hidden: Scene,
    scan: str = "single",
    sensors: tuple[int, int] = (5, 3),
    lasers: tuple[int, int] | None = None,
    bins: tuple[float, float, int] = (0.0, 0.02, 300),
    wall: Scene = MappingProxyType({}),
    capture: Scene = MappingProxyType({}),
    **render: Any,
) -> dict[str, Any]:
    """Configuration of hidden items before a 2.0 x 1.6 m wall, legs not counted, third bounce only.

    Parameters
    ----------
    sensors, lasers
        Columns and rows of the grids; the lasers' covers 1.5 x 1.2 m.
    bins
        start_opl, bin_width_opl [m] and n_bins.
    wall, capture, render
        Keys added to these sections.
    """
    grids: dict[str, Any] = {"sensor_grid": {"nx": sensors[0], "ny": sensors[1]}}
    if scan == "exhaustive":
        nx, ny = lasers or (2, 3)
        grids["laser_grid"] = {"nx": nx, "ny": ny, "width": 1.5, "height": 1.2}
    if scan == "single":
        grids["laser_point"] = [0.3, -0.2]
    return {
        "scene": {
            "relay_wall": {"type": "rectangle", "width": 2.0, "height": 1.6, **wall},
            "hidden_geometry": [dict(item) for item in hidden],
        },
        "capture": {"scan_type": scan, **grids, "account_first_and_last_bounces": False, **capture},
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
        "render": {"engine": "path", "max_bounces": 3, "spp": 1024, **render},
    }


def configured(config: Scene | str, overrides: Sequence[str] = (), folder: Path | None = None) -> Config:
    """Validate a dict or YAML text; relative file names start at ``folder``."""
    text = config if isinstance(config, str) else yaml.safe_dump(dict(config))
    return parse_config(text, "law.yaml", folder or Path.cwd(), overrides)


def render(
    config: Scene | str,
    overrides: Sequence[str] = (),
    *,
    folder: Path | None = None,
    batch_bytes: int | None = None,
    **options: Any,
) -> Rendering:
    """Render a configuration into memory.

    Parameters
    ----------
    config, overrides, folder
        As for ``configured``.
    batch_bytes
        Memory of a batch; small values cut the capture into many batches.
    options
        Fields of ``RenderOptions`` that no configuration has, such as ``p_hidden_sampling`` or ``replicas``.
    """
    validated = configured(config, overrides, folder)
    if options:  # they are the path engine's
        validated = validated.model_copy(update={"render": validated.render.model_copy(update={"engine": "path"})})
    backend = start_backend("llvm", colored=validated.is_colored, polarized=validated.render.polarized)
    from nlosrender.engine.interface import Budget

    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    plan, engine = stages.prepare(validated, backend, built, capture, time_axis, changes=options)
    bounces, channels = engine.options.bounces, engine.options.channels
    if batch_bytes is not None:
        rows = bounces.n_slots * channels
        plan = plan_capture(
            capture, rows_per_pair=rows, n_bins=time_axis.n_bins, lanes=backend.lanes, memory_limit=batch_bytes
        )
    confocal = capture.scan_type == "confocal"
    lasers = (1, 1) if confocal or capture.laser_weights is not None else (capture.laser_grid.ny, capture.laser_grid.nx)
    points = (*lasers, capture.sensor_grid.ny, capture.sensor_grid.nx)
    mean = np.full((channels, bounces.n_slots, *points, time_axis.n_bins), np.nan)
    variance, outside = np.full_like(mean, np.nan), np.full(mean.shape[:-1], np.nan)
    budget = Budget(validated.render.spp, validated.render.target_error, validated.render.time_limit_s)
    samples = []
    for batch in plan.batches:
        histogram = engine.render(batch, budget)
        s, b = batch.sensors, batch.lasers
        ly, lx = (slice(0, 1), slice(0, 1)) if confocal else (slice(b.y0, b.y1), slice(b.x0, b.x1))
        where = (slice(None), slice(None), ly, lx, slice(s.y0, s.y1), slice(s.x0, s.x1))
        mean[where] = histogram.mean.reshape(mean[where].shape)
        variance[where] = histogram.variance.reshape(mean[where].shape)
        outside[where] = histogram.outside.reshape(outside[where].shape)
        samples.append(histogram.samples)
    from nlosrender.engine.launch.histogram import relative_l2_error

    error = relative_l2_error(float(variance.sum()), float((mean**2).sum()))
    return Rendering(mean, variance, outside, capture, time_axis, bounces, min(samples), error, plan)
