"""Traces the rays of camera and laser that find the points of a capture with a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.errors import ConfigError
from nlosrender.scene.pixel_points import NO_SHAPE, FirstHits, PixelAreas, PixelPoints
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.config.capture import CaptureConfig, GridConfig
    from nlosrender.scene.view import BuiltView

PROBES = 5  # places along a pixel's sides, its corners included, where a footprint is looked at before the render
MARGIN = 1e-4  # of a beam's length: what it meets in its last part is the surface that it is aimed at


def pixel_points(view: BuiltView, capture_config: CaptureConfig) -> PixelPoints:
    """Return laser and sensor points of a capture, in the frame of the view's engine [m].

    Raises
    ------
    ConfigError
        No pixel sees anything, or a beam meets nothing.
    """
    grid = capture_config.sensor_grid
    assert grid is not None  # a camera has pixels
    eye = view.to_engine(view.wall.default_device_position) * view.metres_per_engine_unit
    sensors = _first_hits(view, eye, _aims(view, grid, capture_config.pixel_point or (0.5, 0.5)))
    areas = None
    if capture_config.footprint is not None:
        sensors, areas = _with_areas(view, grid, sensors)
    if sensors.is_empty.all():
        message = "none of its pixels sees a surface. Check position, look_at and fov_deg."
        raise ConfigError.at("capture.camera", message)
    laser = eye if capture_config.laser_position is None else view.frame.to_local(capture_config.laser_position)
    target, targets = capture_config.laser_target, capture_config.laser_targets
    if capture_config.scan_type == "single" and target is not None:
        lasers = _lit(view, laser, [target], ["capture.laser_target"])
    elif capture_config.scan_type == "exhaustive" and targets is not None:
        lasers = _lit(view, laser, targets, [f"capture.laser_targets.{number}" for number in range(len(targets))])
    else:
        lasers = _followed(view, laser, sensors)
    return PixelPoints(view.frame, sensors, lasers, areas)


def _aims(view: BuiltView, grid: GridConfig, place: Sequence[float]) -> Float64:
    """Return a place of each pixel (in pixels from its lower left corner) on the image plane (rows, columns, 3) [m]."""
    plane = view.wall
    x, y = (
        (2 * (np.arange(count) + along - 0.5) + 1 - count) / (2 * count) * extent
        for count, along, extent in zip((grid.nx, grid.ny), place, (plane.width, plane.height), strict=True)
    )
    return view.to_engine(plane.positions(np.stack(np.meshgrid(x, y), axis=-1))) * view.metres_per_engine_unit


def _with_areas(view: BuiltView, grid: GridConfig, sensors: FirstHits) -> tuple[FirstHits, PixelAreas]:
    """Return the pixels' areas, and the sensor points: of pixels that see nothing there, another place that they see.

    A pixel of which no place of ``PROBES`` x ``PROBES`` sees a surface is empty.
    """
    eye, sides = sensors.origin, np.linspace(0, 1, PROBES)
    probes = [_first_hits(view, eye, _aims(view, grid, (x, y))) for y in sides for x in sides]
    for probe in probes:
        is_other = sensors.is_empty & probe.is_reached
        parts = {
            name: np.where(is_other.reshape(is_other.shape + (1,) * (own.ndim - 2)), getattr(probe, name), own)
            for name, own in vars(sensors).items()
            if isinstance(own, np.ndarray) and own.ndim > 1
        }
        interactions = dr.select(mi.Bool(is_other.ravel()), probe.interactions, sensors.interactions)
        sensors = replace(sensors, interactions=interactions, **parts)
    ways = [np.where(probe.is_reached[..., None], probe.positions - sensors.positions, 0.0) for probe in probes]
    corners, right, up = (_aims(view, grid, place) for place in ((0, 0), (1, 0), (0, 1)))
    reach = float(np.linalg.norm(ways, axis=-1).max())
    return sensors, PixelAreas(corners - eye, np.stack([right[0, 0], up[0, 0]]) - corners[0, 0], reach)


def _first_hits(view: BuiltView, origin: Float64, targets: Float64) -> FirstHits:
    """Trace rays from a point through others (rows, columns, 3) [m, engine's frame]."""
    unit = view.metres_per_engine_unit
    directions = targets - origin
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    flat = directions.reshape(-1, 3)
    ray = mi.Ray3f(mi.Point3f((origin / unit).tolist()), mi.Vector3f(flat.T.astype(np.float32)))
    si = view.scene.ray_intersect(ray)
    si = dr.select(si.is_valid(), si, dr.zeros(mi.SurfaceInteraction3f, len(flat)))
    dr.eval(si)
    is_met = np.array(si.shape != None, dtype=bool).ravel()  # noqa: E711
    registry = _registry(view.scene.shapes_dr())
    order = np.argsort(registry)
    found = order[np.searchsorted(registry, np.where(is_met, _registry(si.shape), registry[0]), sorter=order)]
    shapes = np.where(is_met, found, NO_SHAPE)
    positions, normals = (np.array(part, dtype=np.float64).T for part in (si.p, si.n))
    facing = -np.einsum("nx,nx->n", normals, flat)
    normals = np.where(is_met[:, None], normals * np.sign(facing + (facing == 0))[:, None], -flat)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    if is_met.any():
        positions[~is_met], normals[~is_met] = positions[is_met][0], normals[is_met][0]
    rows = directions.shape[:-1]
    return FirstHits(
        origin=origin,
        directions=directions,
        positions=positions.reshape(directions.shape) * unit,
        normals=normals.reshape(directions.shape),
        is_front=(facing > 0).reshape(rows),
        shapes=shapes.reshape(rows),
        is_reached=is_met.reshape(rows),
        interactions=si,
    )


def _registry(shapes: mi.ShapePtr) -> NDArray[np.int64]:
    return np.array(dr.reinterpret_array(mi.UInt32, shapes), dtype=np.int64).ravel()


def _lit(view: BuiltView, laser: Float64, points: ArrayLike, keys: Sequence[str]) -> FirstHits:
    """Return what the beams from the laser to points (n, 3) [m, scene] meet first."""
    aims = view.frame.to_local(points)[None]
    for key, length in zip(keys, np.linalg.norm(aims[0] - laser, axis=-1), strict=True):
        if length == 0:
            raise ConfigError.at(key, "is where the laser stands, need another point: the beam goes from there to it.")
    hits = _first_hits(view, laser, aims)
    for key, is_empty, aim in zip(keys, hits.is_empty[0], aims[0], strict=True):
        if is_empty:
            place, target = (np.round(view.frame.to_scene(point), 6).tolist() for point in (laser, aim))
            message = f"the beam from {place}, where the laser stands, through {target} meets no surface: it lights "
            raise ConfigError.at(key, f"{message}nothing. Aim at a surface, or move capture.laser_position.")
    return hits


def _followed(view: BuiltView, laser: Float64, sensors: FirstHits) -> FirstHits:
    """Return the sensor points as laser points: without a shape where something is in the beam's way."""
    unit = view.metres_per_engine_unit
    beams = sensors.positions.reshape(-1, 3) - laser
    lengths = np.linalg.norm(beams, axis=-1)
    directions = beams / np.maximum(lengths, 1e-300)[:, None]
    ray = mi.Ray3f(mi.Point3f((laser / unit).tolist()), mi.Vector3f(directions.T.astype(np.float32)))
    ray.maxt = mi.Float((lengths / unit * (1 - MARGIN)).astype(np.float32))
    is_free = ~np.array(view.scene.ray_test(ray), dtype=bool).ravel() & (sensors.shapes.ravel() != NO_SHAPE)
    normals = sensors.normals.reshape(-1, 3)
    seen_from_there = np.sign(-np.einsum("nx,nx->n", normals, directions))
    nowhere = dr.zeros(mi.SurfaceInteraction3f, sensors.shapes.size)
    shape = sensors.shapes.shape
    return FirstHits(
        origin=laser,
        directions=directions.reshape(sensors.directions.shape),
        positions=sensors.positions,
        normals=sensors.normals,
        is_front=np.where(seen_from_there.reshape(shape) > 0, sensors.is_front, ~sensors.is_front),
        shapes=sensors.shapes,
        is_reached=is_free.reshape(shape),
        interactions=dr.select(mi.Bool(is_free), sensors.interactions, nowhere),
    )
