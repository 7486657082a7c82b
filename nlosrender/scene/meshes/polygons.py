"""Cuts the polygons of mesh files into triangles: fans where one covers the polygon once, ear clipping for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from nlosrender.scene.meshes.triangle_mesh import Int64, unit_rows
from nlosrender.scene.pose import Float64

SLIVER = 1e-6  # of a polygon's size squared: areas below, also negative ones, are rounding of float32 coordinates
BENT = 1e-2  # of a polygon's size: farther from their plane its corners show that it has no single surface
MAX_CORNERS = 1000  # of a polygon; more is a damaged count

Cut = tuple[Int64, Int64]  # which polygon each triangle is part of, (m,); and which of its corners it has, (m, 3)


def cut_polygons(groups: Sequence[Float64], named: Callable[[int, int], str]) -> tuple[list[Cut], tuple[str, ...]]:
    """Cut polygons into triangles.

    Parameters
    ----------
    groups
        Corners of the polygons, (polygons, corners, 3), one array per number of corners; those of less than 3 have
        no area. Finite.
    named
        Returns the name of a polygon in messages, from its group and its number in it.

    Returns
    -------
    tuple
        A cut per group; and a sentence about polygons that are far from flat. The triangles of a convex polygon are
        the fan from its first corner.

    Raises
    ------
    ValueError
        A polygon crosses itself; names it.
    """
    cuts, bent = [], []
    for group, points in enumerate(groups):
        n, k = points.shape[:2]
        fan = np.stack([np.zeros(max(k - 2, 0), np.int64), np.arange(1, k - 1), np.arange(2, k)], axis=-1)
        corners = np.repeat(fan[:, None], n, axis=1)  # (k - 2, n, 3)
        if k > 3:
            local, normals = _local(points)
            first = _fan_starts(local, normals)
            corners = (corners + np.maximum(first, 0)[:, None]) % k
            for polygon in np.flatnonzero(first < 0):
                corners[:, polygon] = _clipped(local[polygon], normals[polygon], named(group, int(polygon)))
            height = np.abs(np.einsum("nkx,nx->nk", local - local.mean(axis=1, keepdims=True), normals)).max(axis=1)
            bent += [(float(height[polygon]), group, int(polygon)) for polygon in np.flatnonzero(height > BENT)]
        cuts.append((np.tile(np.arange(n), max(k - 2, 0)), corners.reshape(-1, 3)))
    if not bent:
        return cuts, ()
    most, *worst = max(bent)
    return cuts, (
        f"{len(bent)} of its polygons are not flat, {named(*worst)} by {100 * most:.2g} % of its size: where they are "
        "cut decides their shape. Triangulate them to choose.",
    )


def _local(points: Float64) -> tuple[Float64, Float64]:
    """Return the corners with each polygon at the origin and of size 1, and unit normals (zero: without area)."""
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused by its coordinates later
        local = points - points[:, :1]
        size = np.abs(local).max(axis=(1, 2), keepdims=True)
        local = np.nan_to_num(np.divide(local, size, out=np.zeros_like(local), where=size > 0))
    normals = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)  # Newell: twice the area, whatever the shape
    return local, unit_rows(normals, SLIVER)


def _fan_starts(local: Float64, normals: Float64) -> Int64:
    """Return the first corner (n,) from which a fan covers each polygon once; -1 where there is none."""
    first = np.full(len(local), -1)
    for start in range(local.shape[1]):
        left = np.flatnonzero(first < 0)
        if not len(left):
            break
        spokes = np.roll(local[left], -start, axis=1)
        spokes = spokes[:, 1:] - spokes[:, :1]
        cross = np.cross(spokes[:, :-1], spokes[:, 1:])
        areas = np.einsum("nkx,nx->nk", cross, normals[left])
        # more than a full turn about the first corner: the triangles overlap, although each is counter-clockwise
        turns = np.arctan2(np.maximum(areas, 0), np.einsum("nkx,nkx->nk", spokes[:, :-1], spokes[:, 1:])).sum(axis=1)
        no_area = ~normals[left].any(axis=1) & (np.linalg.norm(cross, axis=-1) <= SLIVER).all(axis=1)
        right = normals[left].any(axis=1) & (areas >= -SLIVER).all(axis=1) & (turns < 2 * np.pi)
        first[left[right | no_area]] = start
    return first


def _clipped(local: Float64, normal: Float64, name: str) -> Int64:
    """Return the triangles (k - 2, 3) of one polygon by ear clipping; holes may be joined to the rim by double edges.

    Repeated corners leave triangles without area.
    """
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(axis, normal)
    flat = local @ np.stack([x, np.cross(normal, x)], axis=-1)
    kept = [i for i in range(len(flat)) if (flat[i] != flat[i - 1]).any()]
    if not normal.any() or len(kept) < 3 or _crosses_itself(flat[kept]):
        raise ValueError(f"{name} is a polygon that crosses itself, or is folded: triangulate it")
    triangles = np.zeros((len(local) - 2, 3), np.int64)
    count = 0
    while len(kept) > 2:
        ear = _ear(flat[kept])
        if ear is None:
            break
        triangles[count] = kept[ear - 1], kept[ear], kept[(ear + 1) % len(kept)]
        count += 1
        del kept[ear]
    # Triangles between corners of a polygon cover each point as often as it runs around it, backward ones negatively:
    # where none is backward, none overlap.
    areas = _turn(*np.moveaxis(flat[triangles], 1, 0))
    if len(kept) > 2 or areas.min() < -len(flat) * SLIVER:
        raise ValueError(f"{name} is a polygon that cannot be cut into triangles: triangulate it")
    return triangles


def _ear(flat: Float64) -> int | None:
    """Return a corner that can be cut off a polygon (k, 2) that runs counter-clockwise; the roundest, or None."""
    before, after = np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0)
    areas = _turn(before, flat, after)
    if len(flat) == 3:
        return 1
    inwards = flat[areas < SLIVER]  # an ear holds one of these, if it holds any corner
    lengths = np.linalg.norm(after - before, axis=1) + np.linalg.norm(flat - before, axis=1)
    roundest = np.argsort(-areas / np.maximum(lengths, 1e-300) ** 2, kind="stable")
    for margin in (SLIVER, 0.0):  # cut along a corner that all but touches, rounding makes the rest cross itself
        for ear in roundest:
            a, b, c = before[ear], flat[ear], after[ear]
            sides = [_turn(a, b, inwards), _turn(b, c, inwards), _turn(c, a, inwards)]
            at_corner = np.any([(np.abs(inwards - corner) <= SLIVER).all(axis=1) for corner in (a, b, c)], axis=0)
            blocks = (np.min(sides, axis=0) >= -margin) & ~at_corner
            if areas[ear] >= -SLIVER and (areas[ear] <= SLIVER or not blocks.any()):
                return int(ear)
    return None


def _crosses_itself(flat: Float64) -> bool:
    """Return whether two edges of a polygon (k, 2) cross; edges that touch do not."""
    start, end = flat, np.roll(flat, -1, axis=0)
    sides = [_turn(start[:, None], end[:, None], points[None]) for points in (start, end)]
    apart = (sides[0] * sides[1] < 0) & (np.minimum(*np.abs(sides)) > SLIVER)
    return bool((apart & apart.T).any())


def _turn(a: Float64, b: Float64, c: Float64) -> Float64:
    """Return twice the signed area of triangles (..., 2)."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
