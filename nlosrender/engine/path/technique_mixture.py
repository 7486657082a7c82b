"""Technique mixture: probability of hidden geometry sampling, instead of BSDF sampling, at vertices of the wall."""

from __future__ import annotations

import math
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.interface import OmittedWork
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.hidden_aabb import HiddenAabb
from nlosrender.engine.launch.ray_offsets import offset_origin
from nlosrender.engine.launch.wall_points import sensor_points
from nlosrender.engine.path.tuning import PathTuning
from nlosrender.scene.build import SceneWithoutWall


def choose_p_hidden_sampling(device: DeviceCapture, tuning: PathTuning) -> float:
    """Return the probability of hidden geometry sampling: 0 or 1 where one technique suffices, which is cheaper."""
    built, sampler = device.built, device.sampler
    if sampler.is_empty or built.hidden_bounds is None:
        return 0.0
    distance = built.hidden_bounds[0][2] / built.metres_per_engine_unit
    # All light comes from sampled surfaces, and no delta lobe of the wall needs BSDF sampling.
    only_hidden = built.wall.is_planar and sampler.covers_everything
    only_hidden = only_hidden and not built.wall_bsdf.flags() & mi.BSDFFlags.Delta
    if only_hidden and distance > 0 and sampler.area < tuning.max_area_ratio * math.pi * distance**2:
        return 1.0
    # cosine-weighted share of directions from the sensor points that meet hidden geometry
    rays = _rays_from_sensors(device)
    if isinstance(built, SceneWithoutWall):
        hit = built.scene.ray_intersect_preliminary(rays)
        is_met = hit.is_valid() & ~built.is_wall(hit.shape)
    else:
        is_met = built.scene.ray_test(rays)
    return 0.0 if _share(is_met) > tuning.surrounded_share else 0.5


def box_often_missed(device: DeviceCapture, tuning: PathTuning) -> HiddenAabb | None:
    """Return the box around the hidden geometry, or None where few rays from the wall miss it."""
    built = device.built
    if not built.wall.is_planar or built.hidden_bounds is None:
        return None
    low, high = (np.asarray(corner, dtype=np.float64) / built.metres_per_engine_unit for corner in built.hidden_bounds)
    margin = tuning.box_margin * (1 + max(np.abs(low).max(), np.abs(high).max()))
    box = HiddenAabb.of(low - margin, high + margin)
    return box if _share(box.is_missed(_rays_from_sensors(device))) > tuning.min_miss_share else None


def omitted_techniques(device: DeviceCapture, p_hidden_sampling: float) -> Iterator[OmittedWork]:
    """Yield the sampling technique that is left out where one covers everything."""
    if p_hidden_sampling == 1:
        yield OmittedWork("BSDF sampling at the wall (MIS)", "hidden geometry sampling alone finds all light there")
    elif p_hidden_sampling == 0:
        if not device.options.hidden_geometry_sampling:
            why = "render.hidden_geometry_sampling is false"
        elif device.built.hidden_bounds is None or device.sampler.is_empty:
            why = "there is no hidden surface to sample"
        else:
            why = "hidden geometry surrounds the wall: BSDF sampling alone does better"
        yield OmittedWork("hidden geometry sampling (MIS)", why)


def _share(of_rays: mi.Bool) -> float:
    return float(dr.mean(dr.select(of_rays, mi.Float(1), 0))[0])


def _rays_from_sensors(device: DeviceCapture) -> mi.Ray3f:
    """Return 64 rays, stratified by the cosine, from each of at most 64 sensor points."""
    built, grid = device.built, device.capture.sensor_grid
    n_points = grid.positions.shape[0] * grid.positions.shape[1]
    index = np.linspace(0, n_points - 1, min(n_points, 64)).astype(np.uint32)
    points = sensor_points(built, device.capture, device.time_axis, index).interaction
    lanes = dr.arange(mi.UInt32, len(index) * 64)
    si = dr.gather(mi.SurfaceInteraction3f, points, lanes // 64)
    k = lanes % 64
    stratified = mi.Point2f((mi.Float(k % 8) + 0.5) / 8, (mi.Float(k // 8) + 0.5) / 8)
    direction = si.to_world(mi.warp.square_to_cosine_hemisphere(stratified))
    return mi.Ray3f(offset_origin(built, si, direction), direction)
