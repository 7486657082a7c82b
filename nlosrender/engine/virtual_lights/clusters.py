"""Neighbouring triangles -> one patch: detail that time and distance cannot tell apart costs nothing.

A cluster has the area of its members, their mean normal, and a parallelogram with their second moments as its footprint
in time. Whether it is seen is asked of one member, drawn by area: two sheets in one cluster still hide each other, on
average, and the difference of two resolutions shows the noise of the draw.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.cells import Cells
from nlosrender.engine.virtual_lights.patches import Patches
from nlosrender.scene.pose import Float64

GRID = 0.8  # edge of a cluster's box per size allowed
TALL = 3.0  # height of a box per edge
SLOPES = 1.5  # width of the classes that slopes within a box are sorted into, at coarseness 1


def cluster(
    cells: Cells, normals: Float64, areas: Float64, allowed: Float64, coarseness: float, seed: int = 0
) -> Patches:
    """Merge cells, all of them far smaller than allowed, into one patch per box and class of slopes.

    Parameters
    ----------
    cells
        Cells to merge.
    normals, areas
        (n, 3) and (n,) of the cells.
    allowed
        (n,) size a patch may have at coarseness 1 [engine units].
    coarseness
        Scales it.
    seed
        Of the draw of the members that stand for their clusters.
    """
    centres = cells.corners.mean(axis=1)
    order, starts = _groups(_keys(cells, centres, normals, allowed, coarseness))
    areas, normals, centres = areas[order], normals[order], centres[order]
    corners, shapes, primitives = cells.corners[order], cells.shapes[order], cells.primitives[order]
    total = np.add.reduceat(areas, starts)
    mean = np.add.reduceat(areas[:, None] * centres, starts) / total[:, None]
    normal = np.add.reduceat(areas[:, None] * normals, starts)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    sizes = np.diff(np.append(starts, len(areas)))
    owner = np.repeat(np.arange(len(starts)), sizes)
    stands = _drawn(areas, starts, sizes, np.random.default_rng(seed))
    return Patches(
        _footprints(corners, areas, owner, starts, total, mean, normal),
        total,
        mean,
        normal,
        shapes[stands],
        primitives[stands],
        cells.weights[order][stands].mean(axis=1)[:, 1:],
        np.zeros(len(starts)),
        centres[stands],
        np.ones(len(starts), bool),
    )


def _keys(
    cells: Cells, centres: Float64, normals: Float64, allowed: Float64, coarseness: float
) -> tuple[NDArray[np.int64], ...]:
    """Return what members of a cluster have in common: shape, scale, box and slopes.

    A box stands upright on the axis its normals are nearest to: a tilted or bent surface is cut along the two others
    only, into parallelograms.
    """
    scale = np.floor(np.log2(allowed)).astype(np.int64)  # the same at every coarseness, so that clusters scale with it
    edge = coarseness * GRID * 2.0**scale
    upright, across = _axes(normals)
    rows = np.arange(len(normals))
    along_normal = normals[rows, upright]
    slopes = normals[rows[:, None], across] / np.abs(along_normal)[:, None]
    box = np.floor(centres[rows[:, None], across] / edge[:, None])
    height = np.floor(centres[rows, upright] / (TALL * edge))
    tilt = np.rint(slopes / (SLOPES * coarseness))
    facing = upright * 2 + (along_normal > 0)
    return tuple(
        np.asarray(key, np.int64)
        for key in (cells.shapes, scale, facing, box[:, 0], box[:, 1], height, tilt[:, 0], tilt[:, 1])
    )


def _axes(normals: Float64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the axis (n,) nearest to each normal, and the two others (n, 2)."""
    upright = np.abs(normals).argmax(axis=1)
    return upright, np.stack([(upright + 1) % 3, (upright + 2) % 3], axis=1)


def _groups(keys: tuple[NDArray[np.int64], ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return an order in which equal keys lie together, and where each group starts."""
    joined = np.zeros(len(keys[0]), np.int64)
    for key in keys:  # a number per combination: each key is within a known range, so none overlaps
        low, high = int(key.min()), int(key.max())
        joined = joined * (high - low + 1) + (key - low)
    order = np.argsort(joined, kind="stable")
    ordered = joined[order]
    return order, np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))


def _drawn(
    areas: Float64, starts: NDArray[np.int64], sizes: NDArray[np.int64], generator: np.random.Generator
) -> NDArray[np.int64]:
    """Draw one member of every group with probability in proportion to its area."""
    cumulative = np.cumsum(areas)
    before = cumulative[starts] - areas[starts]
    last = starts + sizes - 1
    at = before + generator.random(len(starts)) * (cumulative[last] - before)
    return np.clip(np.searchsorted(cumulative, at, side="right"), starts, last)


def _footprints(
    corners: Float64,
    areas: Float64,
    owner: NDArray[np.int64],
    starts: NDArray[np.int64],
    total: Float64,
    mean: Float64,
    normal: Float64,
) -> Float64:
    """Return three corners (n, 3, 3) in a row of the parallelograms with the clusters' second moments.

    Moments are taken along the two axes across a box. That of a triangle is the sum of v v^T over its corners and of
    9 c c^T for its centre c, / 12; that of a parallelogram spanned by 2 p and 2 q is (p p^T + q q^T) / 3, so p and q
    are the columns of a Cholesky factor of 3 times the moments: a rectangle stays that rectangle.
    """
    upright, across = _axes(normal)
    spread = corners - mean[owner][:, None]  # (n, 3 corners, 3)
    u, v = (np.take_along_axis(spread, across[owner][:, None, k, None], axis=2)[..., 0] for k in range(2))
    cu, cv = u.mean(axis=1), v.mean(axis=1)
    uu, uv, vv = (
        np.add.reduceat(areas * ((a * b).sum(axis=1) + 9 * ca * cb) / 12, starts) / total
        for a, b, ca, cb in ((u, u, cu, cu), (u, v, cu, cv), (v, v, cv, cv))
    )
    first = np.sqrt(3 * uu)
    shear = 3 * uv / np.maximum(first, 1e-300)
    second = np.sqrt(np.maximum(3 * vv - shear**2, 0))
    p = _in_plane(np.stack([first, shear], axis=1), normal, upright, across)
    q = _in_plane(np.stack([np.zeros_like(second), second], axis=1), normal, upright, across)
    return np.stack([mean - p - q, mean + p - q, mean + p + q], axis=1)


def _in_plane(steps: Float64, normal: Float64, upright: NDArray[np.int64], across: NDArray[np.int64]) -> Float64:
    """Return vectors (n, 3) with components ``steps`` along the two axes ``across``, in the planes of the normals."""
    vector = np.zeros_like(normal)
    np.put_along_axis(vector, across, steps, axis=1)
    rows = np.arange(len(normal))
    vector[rows, upright] = -np.einsum("nk,nk->n", vector, normal) / normal[rows, upright]
    return vector
