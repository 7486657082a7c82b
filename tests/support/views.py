"""Line-of-sight captures in memory, and Mitsuba's own steady pictures of the same scenes to hold them against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.config.document import Config
from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages
from support.rendering import configured

Array = NDArray[np.float64]
Scene = Mapping[str, Any]
REPLICAS = 16  # independent estimates behind every variance, ours and Mitsuba's


@dataclass(frozen=True, eq=False)
class View:
    """A rendered line-of-sight capture; axes (channel, bounce, row, column, bin), rows upwards."""

    mean: Array
    variance: Array
    outside: Array  # (channel, bounce, row, column)
    engine: Any
    config: Config

    @property
    def steady(self) -> Array:
        """(channel, row, column): the sum over bounces and time, and what arrives outside the window."""
        return self.mean.sum(axis=(1, 4)) + self.outside.sum(axis=1)


def view_config(
    *surfaces: Scene,
    emitters: Sequence[Scene],
    camera: Scene | None = None,
    bins: tuple[float, float, int] = (0.0, 0.05, 320),
    scene: Scene | None = None,
    capture: Scene | None = None,
    **render: Any,
) -> dict[str, Any]:
    """Configuration of surfaces and emitters, seen by a camera of 5 x 3 pixels at z = 4 unless told otherwise."""
    eye = {"position": [0, 0, 4], "look_at": [0, 0, 0], "fov_deg": 30, "width": 5, "height": 3}
    return {
        "scene": {"hidden_geometry": [dict(s) for s in surfaces], "emitters": [dict(e) for e in emitters]}
        | dict(scene or {}),
        "capture": {"scan_type": "line_of_sight", "camera": eye | dict(camera or {})} | dict(capture or {}),
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
        "render": {"spp": 256, "max_bounces": 6} | render,
    }


def see(
    config: Scene | str | Config,
    *,
    folder: Path | None = None,
    replicas: int = REPLICAS,
    batch_rows: int | None = None,
    **options: Any,
) -> View:
    """Render a line-of-sight configuration, with ``replicas`` estimates behind every pixel.

    ``batch_rows`` renders so many rows of pixels at a time; ``options`` are fields of ``RenderOptions``.
    """
    validated = config if isinstance(config, Config) else configured(config, folder=folder)
    backend = start_backend("llvm", colored=validated.is_colored, polarized=validated.render.polarized)
    from nlosrender.capture.plan import Batch
    from nlosrender.capture.tile import Tile
    from nlosrender.engine.interface import Budget

    _, engine, _ = stages.set_up_engine(validated, backend, changes={"replicas": replicas} | options)
    ny, nx = engine.capture.sensor_grid.ny, engine.capture.sensor_grid.nx
    rows = batch_rows or ny
    tiles = [Tile(y, min(y + rows, ny), 0, nx) for y in range(0, ny, rows)]
    budget = engine.calibrate(Budget(validated.render.spp, validated.render.target_error))
    parts = [engine.render(Batch(tile, Tile(0, 1, 0, 1)), budget) for tile in tiles]

    def joined(name: str) -> Array:
        arrays = [getattr(part, name) for part in parts]
        together = np.concatenate(arrays, axis=3)[:, :, 0]
        return together.reshape(*together.shape[:2], ny, nx, *together.shape[3:])

    return View(joined("mean"), joined("variance"), joined("outside"), engine, validated)


def steady_reference(view: View, spp: int) -> tuple[Array, Array]:
    """Return Mitsuba's steady picture of a view's scene and its variance: (channel, row, column), rows upwards.

    Channels are red, green, blue, or the Stokes components of a polarised view.
    """
    from nlosrender.bench.paper.steady import mitsuba_picture

    engine = view.engine
    highest, polarized = engine.options.bounces.max_bounces, view.config.render.polarized
    return mitsuba_picture(engine.built, engine.capture, highest, polarized, spp, REPLICAS)
