"""Load a scene once, render it with one engine and one budget, and time that."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from nlosrender.bench.scenes import BenchScene
from nlosrender.capture.grids import Capture
from nlosrender.capture.relative_error import relative_l2_error
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.backend.start import Backend, start_backend
from nlosrender.errors import RenderError
from nlosrender.rendering import stages

if TYPE_CHECKING:
    from nlosrender.capture.plan import Plan
    from nlosrender.engine.interface import Budget, Engine
    from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
    from nlosrender.scene.build import BuiltScene

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A benchmark scene on the device, with what is measured of it."""

    scene: BenchScene
    backend: Backend
    built: BuiltScene
    capture: Capture
    time_axis: TimeAxis

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of a result: (laser, row, column, bin); confocal captures have one laser."""
        grid = self.capture.sensor_grid
        lasers = self.capture.n_lasers if self.capture.scan_type == "exhaustive" else 1
        return lasers, grid.ny, grid.nx, self.time_axis.n_bins


@dataclass(frozen=True, eq=False)
class Run:
    """One render: what came out and what it cost.

    ``seconds`` and ``cpu_seconds`` (all threads) cover setting up the engine and rendering, not loading the scene.
    ``setup_seconds`` are CPU seconds, too: of what grows with the scene and is done once whatever the error asked for.
    """

    values: Float64  # (laser, row, column, bin) H summed over bounces
    seconds: float
    cpu_seconds: float
    estimate: float | None = None  # the engine's own estimate of its relative L2 error
    samples: int = 0  # paths per sensor point
    engine: str = ""
    setup_seconds: float = 0.0


@dataclass
class Timer:
    """Wall-clock and CPU seconds since it was made."""

    begun: float = field(default_factory=time.perf_counter)
    cpu_begun: float = field(default_factory=time.process_time)

    def read(self) -> tuple[float, float]:
        """Return wall-clock seconds and CPU seconds of all threads."""
        return time.perf_counter() - self.begun, time.process_time() - self.cpu_begun


def load(scene: BenchScene) -> LoadedScene:
    """Start the backend and load a scene.

    Raises
    ------
    ConfigError
        The scene's mesh cannot be read.
    BackendError
        Nothing on this machine can render.
    """
    config = scene.config()
    backend = start_backend(config.render.backend)
    built = stages.load_scene(config)
    capture, time_axis = stages.describe_capture(config, built.wall, built)
    return LoadedScene(scene, backend, built, capture, time_axis)


def prepared(
    loaded: LoadedScene, render: Mapping[str, Any], changes: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Plan, Engine]:
    """Return the plan and the engine of a scene; bounces are summed.

    Parameters
    ----------
    loaded
        The scene.
    render
        Keys of the configuration's ``render`` section, such as ``engine``.
    changes
        To the engine's ``RenderOptions``.
    """
    config = loaded.scene.config(split_bounces=False, **render)
    scene = loaded.built, loaded.capture, loaded.time_axis
    return stages.prepare(config, loaded.backend, *scene, changes=changes)


def virtual_lights_of(loaded: LoadedScene) -> tuple[Plan, VirtualLightEngine]:
    """Return the plan of a scene and the virtual-light engine for it.

    Raises
    ------
    RenderError
        The engine does not take the scene.
    """
    plan, engine = prepared(loaded, {"engine": "virtual_lights"})
    if engine.name != "virtual_lights":
        raise RenderError(f"{loaded.scene.name}: the virtual-light engine does not take this scene")
    return plan, cast("VirtualLightEngine", engine)


def render(loaded: LoadedScene, budget: Budget, seed: int = 0, options: Mapping[str, Any] | None = None) -> Run:
    """Render a scene with a fresh engine: nothing learnt in an earlier run is used.

    Parameters
    ----------
    loaded, budget, seed
        What, how well, from which random numbers.
    options
        Keys of the configuration's ``render`` section, such as ``engine``.

    Raises
    ------
    RenderError
        The result is not finite, or does not fit the memory.
    """
    values = np.zeros(loaded.shape)
    noise = squares = 0.0
    samples: list[int] = []
    timer = Timer()
    plan, engine = prepared(loaded, {"seed": seed, **(options or {})})
    engine.set_up()
    _, setup_seconds = timer.read()
    for batch in plan.batches:
        histogram = engine.render(batch, budget)
        sensors = np.s_[batch.sensors.y0 : batch.sensors.y1, batch.sensors.x0 : batch.sensors.x1]
        lasers: slice | NDArray[np.int64] = slice(0, 1)
        if loaded.capture.scan_type == "exhaustive":
            lasers = np.array(batch.lasers.flat_indices(loaded.capture.laser_grid.nx))
        values[(lasers, *sensors)] = histogram.mean.sum(axis=(0, 1)).reshape(-1, *batch.sensors.shape, values.shape[-1])
        noise += float(histogram.variance.sum())
        squares += float((histogram.mean**2).sum())
        samples.append(histogram.samples)
    seconds, cpu_seconds = timer.read()
    return Run(
        values, seconds, cpu_seconds, relative_l2_error(noise, squares), min(samples), engine.name, setup_seconds
    )


def chosen_engine(loaded: LoadedScene) -> str:
    """Return the name of the engine that ``engine: auto`` takes for a scene."""
    return prepared(loaded, {})[1].name
