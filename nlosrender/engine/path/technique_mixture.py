"""Which share of a path's vertices on the wall samples the hidden geometry: chosen from the scene."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.engine.launch.device_arrays import sensor_points
from nlosrender.engine.launch.surface_sampler import SurfaceSampler
from nlosrender.engine.path.hidden_aabb import HiddenAabb
from nlosrender.engine.path.laser_connections import offset_origin
from nlosrender.scene.build import BuiltScene

NEAR_RATIO = 4.0  # hidden area over pi times (its distance from the wall)^2 above which its density is too peaked
SURROUNDED = 0.75  # share of the hemisphere above which BSDF sampling alone does better
OFTEN = 0.2  # of the rays from the wall miss the box: asking it costs less than it saves
BOX_MARGIN = 1e-5  # of the largest coordinate: float32 places of surfaces are within it


def choose_p_hidden_sampling(
    built: BuiltScene, sampler: SurfaceSampler, capture: Capture, time_axis: TimeAxis
) -> float:
    """Return the mixture on the relay wall; one technique alone where it suffices: cheaper and less noisy."""
    if sampler.is_empty or built.hidden_bounds is None:
        return 0.0
    distance = built.hidden_bounds[0][2] / built.unit
    # All light comes from sampled surfaces, and the wall has no mirror lobe that only its own sampling finds.
    only_hidden = built.wall.is_planar and sampler.covers_everything
    only_hidden &= not built.wall_bsdf.flags() & mi.BSDFFlags.Delta
    if only_hidden and distance > 0 and sampler.area < NEAR_RATIO * math.pi * distance**2:
        return 1.0
    return 0.0 if surrounded_share(built, capture, time_axis) > SURROUNDED else 0.5


def surrounded_share(built: BuiltScene, capture: Capture, time_axis: TimeAxis) -> float:
    """Return the cosine-weighted share of directions from the sensor points that meet hidden geometry."""
    is_met = built.scene.ray_test(_rays_from_sensors(built, capture, time_axis))
    return float(dr.mean(dr.select(is_met, mi.Float(1), 0))[0])


def box_often_missed(built: BuiltScene, capture: Capture, time_axis: TimeAxis) -> HiddenAabb | None:
    """Return the box around the hidden geometry, or None where few rays from the wall miss it."""
    if not built.wall.is_planar or built.hidden_bounds is None:
        return None
    least, most = (np.asarray(corner, dtype=np.float64) / built.unit for corner in built.hidden_bounds)
    margin = BOX_MARGIN * (1 + max(np.abs(least).max(), np.abs(most).max()))
    box = HiddenAabb.of(least - margin, most + margin)
    is_missed = box.is_missed(_rays_from_sensors(built, capture, time_axis))
    return box if float(dr.mean(dr.select(is_missed, mi.Float(1), 0))[0]) > OFTEN else None


def _rays_from_sensors(built: BuiltScene, capture: Capture, time_axis: TimeAxis) -> mi.Ray3f:
    """Return 64 rays, stratified by the cosine, from each of at most 64 sensor points."""
    grid = capture.sensor_grid
    n_points = grid.positions.shape[0] * grid.positions.shape[1]
    index = np.linspace(0, n_points - 1, min(n_points, 64)).astype(np.uint32)
    points = sensor_points(built, capture, time_axis, index).interaction
    lanes = dr.arange(mi.UInt32, len(index) * 64)
    si = dr.gather(mi.SurfaceInteraction3f, points, lanes // 64)
    k = lanes % 64
    stratified = mi.Point2f((mi.Float(k % 8) + 0.5) / 8, (mi.Float(k // 8) + 0.5) / 8)
    direction = si.to_world(mi.warp.square_to_cosine_hemisphere(stratified))
    return mi.Ray3f(offset_origin(built, si, direction), direction)
