"""Ground truth of a capture: what the hidden scene is, seen orthographically from the relay wall along its normal.

Of each point of a grid on the wall one ray leaves along the wall's normal there; on a plane that is an orthographic
view. Occupancy is measured along rays parallel to the wall's normal: between an entry into an item and the exit from it
lies its inside. Everything is in the wall's local frame [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.build import BuiltScene
from nlosrender.scene.loading.number_of_shape import NumberOfShape
from nlosrender.scene.pose import Float64

NOTHING = -1  # item index where a ray meets no hidden surface
MAX_CROSSINGS = 256  # of one ray with surfaces; what lies behind them is left out
# Step of a ray over a surface that it has met, over 1 + the largest coordinate [engine units]: float32 hits are good to
# 4e-7 of it (ray_offsets.py has the measurement), surfaces closer together are taken for one.
STEP = 2e-6
# Rays per edge of a voxel, at odd places: edges of triangles and of voxels often lie at the same simple fractions.
RAYS_PER_EDGE = 2
BAND = 2**22  # voxels times rays that are in memory at a time
SHIFT = np.array([0.0717, 0.0533])  # of these rays, in spacings


@dataclass(frozen=True, eq=False)
class FrontView:
    """Hidden surface in front of each point of a grid (ny, nx) on the wall; NaN and ``NOTHING`` where there is none."""

    depth: Float64  # (ny, nx) m from the wall
    position: Float64  # (ny, nx, 3) m
    normal: Float64  # (ny, nx, 3) unit; of the surface's front, by the normals that are rendered
    albedo: Float64  # (channels, ny, nx)
    item: NDArray[np.int64]  # (ny, nx) index of the hidden item


def front_view(built: BuiltScene, points: Float64, normals: Float64) -> FrontView:
    """Return what lies before points (ny, nx, 3) of the wall in the direction of their unit normals (ny, nx, 3)."""
    unit, shape = built.metres_per_engine_unit, points.shape[:2]
    origins, directions = points.reshape(-1, 3) / unit, normals.reshape(-1, 3)
    if not built.wall.is_planar:
        origins = origins + STEP * (1 + np.abs(origins).max()) * directions
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(directions.T.astype(np.float32)))
    si = built.scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    item = _items(_number_of_item(built), si)
    bsdf = si.bsdf(ray)
    albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, si.is_valid()))
    dr.eval(si.t, si.sh_frame.n, item, albedo)
    items = np.array(item, dtype=np.int64)
    is_seen = items != NOTHING
    depth = np.where(is_seen, np.array(si.t, np.float64), np.nan) * unit
    colors = np.where(is_seen, np.atleast_2d(np.array(albedo, np.float64)), np.nan)
    return FrontView(
        depth=depth.reshape(shape),
        position=(origins * unit + depth[:, None] * directions).reshape(*shape, 3),
        normal=np.where(is_seen[:, None], np.array(si.sh_frame.n, np.float64).T, np.nan).reshape(*shape, 3),
        albedo=colors.reshape(-1, *shape),
        item=items.reshape(shape),
    )


def occupancy(built: BuiltScene, low: Float64, high: Float64, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Return which share of each voxel lies inside of an item, (nz, ny, nx).

    A surface that bounds nothing along a ray, such as a sheet, fills the voxels it passes through.

    Parameters
    ----------
    built
        The scene.
    low, high
        Corners (3,) of all voxels [m].
    shape
        Voxels along z, y and x.
    """
    nz, ny, nx = shape
    voxels = np.zeros(shape, dtype=np.float32)
    x, y = (
        low[k] + (np.arange(n * RAYS_PER_EDGE) + 0.5 + SHIFT[k]) / (n * RAYS_PER_EDGE) * (high[k] - low[k])
        for k, n in enumerate((nx, ny))
    )
    rows = max(BAND // (nx * nz * RAYS_PER_EDGE**2), 1)
    for first in range(0, ny, rows):
        inside = y[first * RAYS_PER_EDGE : (first + rows) * RAYS_PER_EDGE]
        columns = np.stack([axis.ravel() for axis in np.meshgrid(x, inside, indexing="xy")])
        ray, height, sign = _ends(*_crossings(built, columns), low[2], (high[2] - low[2]) / nz, nz)
        share = _filled(ray, height, sign, columns.shape[1], nz)
        blocks = share.reshape(-1, RAYS_PER_EDGE, nx, RAYS_PER_EDGE, nz)
        voxels[:, first : first + rows] = np.moveaxis(blocks.mean(axis=(1, 3)), -1, 0)
    return voxels


def _number_of_item(built: BuiltScene) -> NumberOfShape:
    return NumberOfShape.of(built.hidden_shapes, range(len(built.hidden_shapes)))


def _items(numbers: NumberOfShape, si: mi.SurfaceInteraction3f) -> mi.Int32:
    """Return which item each intersection is with; ``NO_NUMBER`` is ``NOTHING`` with a sign."""
    return dr.reinterpret_array(mi.Int32, numbers.at(si, mi.Bool(True)))


def _crossings(
    built: BuiltScene, columns: Float64
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64, NDArray[np.int64]]:
    """Return ray, item, z [m] and sign (1: enters by the front) of all crossings of rays along z, sorted in this order.

    Parameters
    ----------
    built
        The scene.
    columns
        (2, rays) x and y of the rays [m].
    """
    unit, numbers = built.metres_per_engine_unit, _number_of_item(built)
    found: list[tuple[NDArray[np.int64], ...]] = []
    if built.hidden_bounds is not None:
        start = built.hidden_bounds[0][2] / unit
        z = np.full(columns.shape[1], start - STEP * (1 + abs(start)), dtype=np.float32)
        active = np.arange(columns.shape[1])
        reach = STEP * (1 + max(float(np.abs(corner).max()) for corner in built.hidden_bounds) / unit)
        for _ in range(MAX_CROSSINGS):
            x, y = (columns[:, active] / unit).astype(np.float32)
            si = built.scene.ray_intersect(
                mi.Ray3f(mi.Point3f(x, y, z[active]), mi.Vector3f(0, 0, 1)), mi.RayFlags.Minimal, coherent=True
            )
            item, side, hit = _items(numbers, si), si.n.z, si.p.z
            valid = si.is_valid()
            dr.eval(item, side, hit, valid)
            met = np.array(valid)
            active = active[met]
            if not len(active):
                break
            z[active] = np.array(hit)[met] + reach
            found.append(
                (active, np.array(item)[met], np.array(hit)[met], np.sign(-np.array(side)[met]).astype(np.int64))
            )
    if not found:
        none = np.zeros(0, dtype=np.int64)
        return none, none, np.zeros(0), none
    ray, item, height, sign = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.lexsort((height, item, ray))
    order = order[item[order] != NOTHING]
    return ray[order], item[order].astype(np.int64), height[order].astype(np.float64) * unit, sign[order]


def _ends(
    ray: NDArray[np.int64],
    item: NDArray[np.int64],
    z: Float64,
    sign: NDArray[np.int64],
    start: float,
    edge: float,
    nz: int,
) -> tuple[NDArray[np.int64], Float64, NDArray[np.int64]]:
    """Return where the inside of an item begins (1) and ends (-1) along rays: ray, height in voxels, sign.

    Where entries and exits of one item do not match, its surfaces fill the voxels that they pass through.
    """
    if not len(ray):
        return ray, z, sign
    is_first = np.append(True, (np.diff(ray) != 0) | (np.diff(item) != 0))
    # an item whose front is mostly met from behind is wound the other way round
    for which in np.unique(item):
        if sign[is_first & (item == which)].sum() < 0:
            sign = np.where(item == which, -sign, sign)
    group = np.cumsum(is_first) - 1
    starts = np.flatnonzero(is_first)
    total = np.cumsum(sign)
    depth = total - (total[starts] - sign[starts])[group]  # of nested entries, this crossing included
    is_closed = (np.minimum.reduceat(depth, starts) >= 0) & (depth[np.append(starts[1:], len(ray)) - 1] == 0)
    closed = is_closed[group]
    is_end = closed & (((sign > 0) & (depth == 1)) | ((sign < 0) & (depth == 0)))
    height = (z - start) / edge
    voxel = np.floor(height[~closed])
    rays = np.concatenate([ray[is_end], ray[~closed], ray[~closed]])
    ends = np.clip(np.concatenate([height[is_end], voxel, voxel + 1]), 0, nz)
    return rays, ends, np.concatenate([sign[is_end], np.ones_like(voxel, np.int64), -np.ones_like(voxel, np.int64)])


def _filled(ray: NDArray[np.int64], height: Float64, sign: NDArray[np.int64], n_rays: int, nz: int) -> Float64:
    """Return the share of each voxel along each ray that is inside, (rays, nz), from the ends of the insides."""
    voxel = np.floor(height).astype(np.int64)
    part = height - voxel
    row = nz + 2  # an end at the last voxel's far side changes two voxels beyond
    at = np.concatenate([ray * row + voxel, ray * row + voxel + 1])
    change = np.bincount(at, np.concatenate([sign * (1 - part), sign * part]), n_rays * row).reshape(n_rays, row)
    return np.clip(np.cumsum(change, axis=1)[:, :nz], 0, 1)
