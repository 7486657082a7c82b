"""The engines for programs that use Mitsuba themselves: a scene and arrays of points in, H out, no file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.api.configuration import load
from nlosrender.api.progress_bar import Wanted, reported, warn_caller
from nlosrender.capture.relative_error import relative_l2_error
from nlosrender.capture.time_axis import bin_centres
from nlosrender.errors import OptionError
from nlosrender.rendering import stages
from nlosrender.rendering.outcome import missing_light
from nlosrender.scene.walls.wall_from_config import relay_wall_from_config

if TYPE_CHECKING:
    from nlosrender.capture.grids import Capture
    from nlosrender.capture.plan import Batch, Plan
    from nlosrender.config.document import Config
    from nlosrender.engine.interface import Engine
    from nlosrender.rendering.render_report import Progress

Float64 = NDArray[np.float64]
OF_THE_VARIANT = ("color", "polarized", "backend")  # keys of ``render`` that Mitsuba's variant decides


@dataclass(frozen=True, eq=False)
class Transient:
    """Light of a Mitsuba scene at points of a relay wall over time, in the order of the points.

    Axes: channel, bounce, those of the laser points (none of a confocal scan), those of the sensor points, bin.
    """

    H: Float64  # J m^-2 sr^-1 per bin, for a pulse of 1 J
    variance: Float64  # of H
    outside: Float64  # H outside the bins; no bin axis
    bounces: tuple[str, ...]  # what the bounce axis holds: "3", "7 and above"
    opl: Float64  # (bin,) m, optical path length in the middle of each bin
    error_estimate: float  # relative L2 error of H; NaN: light is missing that no technique samples
    engine: str  # which, and why


def transient(
    scene: object,
    wall: Mapping[str, object],
    sensor_points: ArrayLike,
    laser_points: ArrayLike | None = None,
    *,
    time_axis: Mapping[str, object],
    render: Mapping[str, object] | None = None,
    sensor_position: Sequence[float] | None = None,
    laser_position: Sequence[float] | None = None,
    progress: Wanted = False,
) -> Transient:
    """Render what a sensor would see of a scene that Mitsuba has loaded.

    Parameters
    ----------
    scene
        A ``mitsuba.Scene`` [m] with the hidden geometry: meshes, rectangles, disks, spheres, cylinders with any BSDF,
        loaded with the variant ``llvm_ad_mono``, ``llvm_ad_rgb`` or one of these of CUDA (:func:`start_backend`). Its
        sensors play no part; emitters are refused. The relay wall is not in it.
    wall
        ``scene.relay_wall`` of a configuration, in the scene's coordinates.
    sensor_points, laser_points
        (..., 2) wall coordinates x, y [m] from the wall's centre, in any order and shape, none of them twice.
        ``laser_points`` None: confocal, the laser hits each sensor point in turn. Else all pairs are rendered.
    time_axis
        Keys of the section: ``{"bin_width_opl": 0.003, "n_bins": 1024}``, m.
    render
        Keys of the section: ``target_error``, ``max_bounces``, ``engine``, ``seed``, and so on.
    sensor_position, laser_position
        (3,) m in the scene. Given, time counts the legs to the wall; None: it begins and ends at the wall.
    progress
        As of :func:`render`.

    Raises
    ------
    ConfigError
        A key or a shape cannot be used, or a point is off the wall or there twice.
    OptionError
        Points have a wrong shape, or arguments contradict each other.
    BackendError
        The active variant is another one.
    RenderError
        The result is not finite.
    """
    from nlosrender.engine.backend.start import join_backend

    backend, colored = join_backend()
    sensors = _points(sensor_points, "sensor_points")
    lasers = None if laser_points is None else _points(laser_points, "laser_points")
    settings = _settings(render) | {"color": "rgb" if colored else "grey", "backend": backend.name}
    values = {
        "scene": {"relay_wall": wall, "hidden_geometry": []},
        "capture": _scan(sensors, lasers, sensor_position, laser_position),
        "time_axis": time_axis,
        "render": settings,
    }
    config = load(values).config
    from nlosrender.engine.preflight.scene_warnings import scene_warnings
    from nlosrender.engine.preflight.zero_capture import zero_reasons
    from nlosrender.scene.build import build_scene
    from nlosrender.scene.loading.loaded_surfaces import loaded_surfaces

    relay_wall = relay_wall_from_config(config.scene.wall)
    built = build_scene(relay_wall, config.scene.wall.bsdf, loaded_surfaces(scene, relay_wall.pose))
    capture, time = stages.describe_capture(config, relay_wall, built)
    plan, engine = stages.prepare(config, backend, built, capture, time)
    unsampled = missing_light(engine)
    for text in (*(paths.warning for paths in unsampled), *scene_warnings(engine)):
        warn_caller(text)
    with reported(progress, "transient") as told:
        mean, variance, outside = _rendered(plan, engine, config, told)
    if not mean.any():
        warn_caller(f"H is zero everywhere: {'; '.join(zero_reasons(engine, unsampled, float(outside.sum())))}.")
    shape = (*(() if lasers is None else lasers.shape[:-1]), *sensors.shape[:-1])
    error = relative_l2_error(float(variance.sum()), float(np.square(mean).sum()))
    axes = mean.shape[:2]
    return Transient(
        H=mean.reshape(*axes, *shape, time.n_bins),
        variance=variance.reshape(*axes, *shape, time.n_bins),
        outside=outside.reshape(*axes, *shape),
        bounces=tuple(engine.options.bounces.name(slot) for slot in range(axes[1])),
        opl=bin_centres(time.start_opl, time.bin_width_opl, time.n_bins),
        error_estimate=np.nan if unsampled else error,
        engine=f"{engine.name}: {engine.reason}",
    )


def _settings(render: Mapping[str, object] | None) -> dict[str, object]:
    """Return the keys of the section ``render`` that a caller gives; OptionError for those that are not his."""
    if render is not None and not isinstance(render, Mapping):
        raise OptionError(f"render: got {render!r:.60}, need a mapping of keys and values")
    given = dict(render or {})
    if decided := [key for key in OF_THE_VARIANT if key in given]:
        raise OptionError(f"render: {decided[0]} is decided by Mitsuba's variant; leave it away")
    return given


def _scan(
    sensors: Float64, lasers: Float64 | None, sensor_position: Sequence[float] | None, laser_position: object
) -> dict[str, object]:
    """Return the section ``capture`` of points (..., 2); OptionError where one device has a position."""
    if (sensor_position is None) != (laser_position is None):
        raise OptionError("sensor_position, laser_position: need both, for time to count the legs, or none")
    section: dict[str, object] = {
        "scan_type": "confocal" if lasers is None else "exhaustive",
        "account_first_and_last_bounces": sensor_position is not None,
        "sensor_points": sensors.reshape(-1, 2),
    }
    if lasers is not None:
        section["laser_points"] = lasers.reshape(-1, 2)
    if sensor_position is not None:
        section |= {"sensor_position": sensor_position, "laser_position": laser_position}
    return section


def _points(points: ArrayLike, name: str) -> Float64:
    try:
        array = np.asarray(points)
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name}: got {points!r:.60}, need an array of real numbers (..., 2)") from error
    if not array.ndim or array.shape[-1] != 2 or not array.size:
        raise OptionError(f"{name}: got shape {array.shape}, need (..., 2): x and y on the wall [m]")
    return array


def _rendered(plan: Plan, engine: Engine, config: Config, progress: Progress) -> tuple[Float64, Float64, Float64]:
    """Return mean and variance (channel, bounce, laser, sensor, bin), and light outside the bins, points flattened."""
    capture, options = engine.capture, engine.options
    axes = (options.channels, options.bounces.n_slots, capture.lasers_per_sensor, capture.n_sensors)
    mean, variance = np.zeros((2, *axes, engine.time_axis.n_bins))
    outside = np.zeros(axes)
    budget = stages.calibrated_budget(config, engine)
    for done, batch in enumerate(plan.batches):
        progress(done / len(plan.batches))
        histogram = engine.render(batch, budget)
        where = _places(batch, capture)
        mean[where], variance[where], outside[where] = histogram.mean, histogram.variance, histogram.outside
    progress(1.0)
    return mean, variance, outside


def _places(batch: Batch, capture: Capture) -> tuple[Any, ...]:
    sensors = np.array(batch.sensors.flat_indices(capture.sensor_grid.nx))
    is_paired = capture.scan_type == "exhaustive"
    lasers = np.array(batch.lasers.flat_indices(capture.laser_grid.nx)) if is_paired else np.array([0])
    return (slice(None), slice(None), lasers[:, None], sensors[None, :])
