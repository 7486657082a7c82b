"""Mitsuba's own steady pictures of a line-of-sight capture's scene, to compare its sum over time with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from nlosrender.capture.grids import Capture
from nlosrender.config.document import Config
from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

if TYPE_CHECKING:
    from nlosrender.scene.view import BuiltView

Float64 = NDArray[np.float64]
SEEDS = 8  # independent pictures, whose spread is the noise of their mean
BLOCK = 8  # pixels: sums over blocks are near enough to normal, single pixels of caustics are not
SIGNIFICANCE = 1e-3  # of the whole test


def steady_picture(config: Config, spp: int) -> tuple[Float64, Float64]:
    """Return Mitsuba's picture and its variance, (channel, row, column) each, rows upwards.

    Its ``path`` integrator; for polarised captures inside its ``stokes`` integrator, and channels are I, Q, U, V.

    Parameters
    ----------
    config
        Of a line-of-sight capture.
    spp
        Paths per pixel, shared out over the seeds.
    """
    polarized = config.render.polarized
    start_backend(config.render.backend, colored=config.is_colored, polarized=polarized)
    built = stages.load_view(config)
    capture, _ = stages.describe_capture(config, built.wall, built)
    return mitsuba_picture(built, capture, config.render.max_bounces, polarized, max(1, spp // SEEDS), SEEDS)


def mitsuba_picture(
    built: BuiltView, capture: Capture, max_bounces: int | None, polarized: bool, spp: int, seeds: int
) -> tuple[Float64, Float64]:
    """The same of a scene that is loaded: mean of ``seeds`` pictures of ``spp`` paths per pixel, and its variance."""
    import mitsuba as mi

    grid, plane = capture.sensor_grid, built.wall
    target, up = built.to_engine([0, 0, 0]), built.direction_to_engine([0, 1, 0])
    origin = built.to_engine(capture.sensor_position)
    film = {"type": "hdrfilm", "width": grid.nx, "height": grid.ny, "rfilter": {"type": "box"}}
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), target.tolist(), up.tolist()),
            "fov": float(np.degrees(2 * np.arctan(plane.width / 2 / plane.distance))),
            "near_clip": 0.01,
            "film": film | {"pixel_format": "rgb", "component_format": "float32"},
        }
    )
    # the emitter counts, too
    integrator = {"type": "path", "max_depth": -1 if max_bounces is None else max_bounces + 1}
    tracer = mi.load_dict({"type": "stokes", "nested": integrator} if polarized else integrator)
    # the stokes integrator asks the scene's own sensor which way is up
    lamps = [lamp for lamp in built.scene.emitters() if not lamp.flags() & mi.EmitterFlags.Surface]
    parts = {f"part_{number}": part for number, part in enumerate([*built.scene.shapes(), *lamps])}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, **parts})
    pictures = []
    for seed in range(seeds):
        picture = np.array(mi.render(scene, sensor=sensor, integrator=tracer, spp=spp, seed=seed))
        shown = picture[..., 3::3] if polarized else picture  # after the colours S0.R, S0.G, S0.B, S1.R, ...
        pictures.append(np.moveaxis(shown.astype(np.float64), -1, 0)[:, ::-1])
    stack = np.array(pictures)
    return stack.mean(axis=0), stack.var(axis=0, ddof=1) / seeds


def worst_deviation(ours: Float64, variance: Float64, theirs: Float64, noise: Float64) -> tuple[float, float, int]:
    """Return the largest |z| over blocks of pixels, what chance allows over all of them, and how many there are.

    Parameters
    ----------
    ours, variance, theirs, noise
        (channel, row, column): two pictures, each followed by its variance.
    """
    difference = _blocks(ours - theirs)
    deviation = np.sqrt(_blocks(variance + noise))
    is_noisy = deviation > 0
    z = np.abs(difference[is_noisy]) / deviation[is_noisy]
    limit = float(stats.norm.isf((1 - (1 - SIGNIFICANCE) ** (1 / max(z.size, 1))) / 2))
    return float(z.max(initial=0.0)), limit, int(z.size)


def _blocks(picture: Float64) -> Float64:
    """Return sums over blocks of pixels; a narrower last block joins the one before it."""
    starts = [np.arange(0, max(size - BLOCK + 1, 1), BLOCK) for size in picture.shape[1:]]
    rows: Float64 = np.add.reduceat(picture, starts[0], axis=1)
    return np.add.reduceat(rows, starts[1], axis=2)
