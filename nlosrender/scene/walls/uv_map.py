"""From texture coordinates back to the triangle of a mesh: which face covers a point (u, v), and where in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.pose import Float64

Indices = NDArray[np.int64]
EDGE = 1e-6  # barycentric: points so near to an edge belong to the faces on both sides
MOST_PAIRS = 4_000_000  # of points and faces looked at at once, for memory
NOWHERE = -1
# Barycentric coordinates of the points of a face that no other face may cover: its middle, and one near each corner.
_PROBES = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8]]) / np.array([[3], [10], [10], [10]])


class UvMap:
    """The faces of a mesh in the plane of its texture coordinates.

    Parameters
    ----------
    corners
        (n, 3, 2) texture coordinates of the faces' corners, within [0, 1].

    Raises
    ------
    ValueError
        Two faces cover the same point; names it.
    """

    def __init__(self, corners: Float64):
        self._corners = corners
        low, high = corners.min(axis=1), corners.max(axis=1)
        self._n = int(np.clip(np.sqrt(len(corners)), 1, 2048))  # boxes along an axis, about one per face
        first, last = self._box(low), self._box(high)
        across = last - first + 1
        counts = across.prod(axis=1)
        owner = np.repeat(np.arange(len(corners)), counts)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        box = first[owner] + np.stack([place % across[owner, 0], place // across[owner, 0]], axis=1)
        key = box[:, 1] * self._n + box[:, 0]
        order = np.argsort(key, kind="stable")
        self._faces = owner[order]
        self._starts = np.searchsorted(key[order], np.arange(self._n**2 + 1))
        self._refuse_overlaps()

    def locate(self, uv: Float64) -> tuple[Indices, Float64]:
        """Return the face (m,) that covers each point (m, 2), and the barycentric coordinates (m, 3) in it.

        ``NOWHERE`` where no face does. On an edge it is the face of the lower number.
        """
        faces, weights = np.full(len(uv), NOWHERE), np.zeros((len(uv), 3))
        for chosen in self._parts(uv):
            point, face, inside = self._candidates(uv[chosen])
            best = np.full(len(chosen), -np.inf)
            least = inside.min(axis=1)
            np.maximum.at(best, point, least)
            is_best = (least == best[point]) & (least >= -EDGE)
            found, at = np.unique(point[is_best], return_index=True)
            faces[chosen[found]] = face[is_best][at]
            weights[chosen[found]] = inside[is_best][at]
        weights = np.maximum(weights, 0)
        return faces, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)

    def _refuse_overlaps(self) -> None:
        probes = np.einsum("pk,nkx->npx", _PROBES, self._corners).reshape(-1, 2)
        for chosen in self._parts(probes):
            point, face, inside = self._candidates(probes[chosen])
            covering = inside.min(axis=1) > EDGE
            others = np.flatnonzero(covering & (face != chosen[point] // len(_PROBES)))
            if len(others):
                first = chosen[point[others[0]]]
                (u, v), pair = probes[first], sorted((int(first) // len(_PROBES), int(face[others[0]])))
                raise ValueError(
                    f"its texture coordinates overlap: (u, v) = ({u:.4g}, {v:.4g}) lies in the triangles {pair[0]} and "
                    f"{pair[1]}, need one place on the wall for every (u, v)"
                )

    def _parts(self, uv: Float64) -> list[Indices]:
        """Return the indices of points in groups that have at most ``MOST_PAIRS`` candidates, or one point."""
        box = self._box(uv)
        key = box[:, 1] * self._n + box[:, 0]
        total = np.cumsum(self._starts[key + 1] - self._starts[key])
        group = total // MOST_PAIRS
        return [np.flatnonzero(group == number) for number in np.unique(group)]

    def _candidates(self, uv: Float64) -> tuple[Indices, Indices, Float64]:
        """Return pairs of a point and a face near it, with the point's barycentric coordinates (k, 3) there."""
        box = self._box(uv)
        key = box[:, 1] * self._n + box[:, 0]
        counts = self._starts[key + 1] - self._starts[key]
        point = np.repeat(np.arange(len(uv)), counts)
        place = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
        face = self._faces[self._starts[key][point] + place]
        a, b, c = (self._corners[face, k] for k in range(3))
        whole = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):  # a face without extent in (u, v) covers nothing
            second, third = _cross(uv[point] - a, c - a) / whole, _cross(b - a, uv[point] - a) / whole
        inside = np.stack([1 - second - third, second, third], axis=1)
        return point, face, np.where(np.isfinite(inside), inside, -np.inf)

    def _box(self, uv: Float64) -> Indices:
        return np.clip((uv * self._n).astype(np.int64), 0, self._n - 1)


def _cross(a: Float64, b: Float64) -> Float64:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
