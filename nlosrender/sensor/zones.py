"""Zones: what a detector with a lens and few pixels sees of the wall, as sums over sensor points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nlosrender.config.sensor import ZonesConfig
from nlosrender.errors import ConfigError
from nlosrender.sensor.response import Float64

NO_ZONE = -1
PARALLEL = 1e-9  # of the axis to the wall's y axis


def zone_of_points(
    config: ZonesConfig, points: Float64, sensor: Float64, grid_size: tuple[float, float] | None
) -> NDArray[np.int64]:
    """Return which zone each sensor point is in, counted row by row, (rows, columns); ``NO_ZONE``: in none.

    Parameters
    ----------
    config
        With an extent in degrees the zones are rectangles in the angles about the sensor's axis, which looks at the
        middle of the points; else they are rectangles in the wall's x and y around it.
    points
        (rows, columns, 3) in the wall's frame [m].
    sensor
        (3,) where the detector stands [m].
    grid_size
        Width and height of the sensor grid [m]; None: not known.

    Raises
    ------
    ConfigError
        A zone has no sensor point, or the grid has no size.
    """
    middle = points.reshape(-1, 3).mean(axis=0)
    if config.width_deg is not None and config.height_deg is not None:
        axis = (middle - sensor) / np.linalg.norm(middle - sensor)
        up = np.array([0.0, 1.0, 0.0]) - axis[1] * axis
        if np.linalg.norm(up) < PARALLEL:
            raise ConfigError.at("sensor.zones", "the sensor looks along the wall; need width and height in m.")
        up /= np.linalg.norm(up)
        # seen from before the wall, x to the right of the wall's own x, y up
        right, rays = np.cross(up, -axis), points - sensor
        along = rays @ axis
        at = np.degrees(np.stack([np.arctan2(rays @ right, along), np.arctan2(rays @ up, along)], axis=-1))
        extent = config.width_deg, config.height_deg
    else:
        at = (points - middle)[..., :2]
        extent = (config.width, config.height) if config.width and config.height else grid_size or (0.0, 0.0)
        if min(extent) <= 0:
            raise ConfigError.at("sensor.zones", "the sensor grid has no size; need width and height in m.")
    column, row = (
        np.floor((at[..., i] / extent[i] + 0.5) * n).astype(np.int64) for i, n in enumerate((config.nx, config.ny))
    )
    inside = (column >= 0) & (column < config.nx) & (row >= 0) & (row < config.ny)
    zones = np.where(inside, row * config.nx + column, NO_ZONE)
    empty = np.setdiff1d(np.arange(config.nx * config.ny), zones)
    if len(empty):
        y, x = divmod(int(empty[0]), config.nx)
        message = f"zone in row {y}, column {x} has no sensor point, nor have {len(empty) - 1} more; need more points, "
        raise ConfigError.at("sensor.zones", message + "a larger grid, or smaller zones.")
    return zones


def zone_sums(zones: NDArray[np.int64], n_zones: int) -> csr_array:
    """Return the matrix (zones, points) that sums points into zones."""
    flat = zones.ravel()
    inside = np.flatnonzero(flat != NO_ZONE)
    ones = np.ones(len(inside), np.float32)
    return csr_array((ones, (flat[inside], inside)), shape=(n_zones, flat.size))
