"""Inverse of a mesh's texture coordinates: the face that covers a point (u, v), and barycentric coordinates in it."""

from __future__ import annotations

import numpy as np

from nlosrender.scene.meshes.triangle_mesh import Int64
from nlosrender.scene.pose import Float64

EDGE = 1e-6  # barycentric: points nearer to an edge belong to the faces on both sides; ten times float32's rounding
MAX_PAIRS = 4_000_000  # of points and faces looked at at once: 0.5 GB
NOWHERE = -1
# Barycentric coordinates of the points of a face that no other face may cover: its middle, and one near each corner.
_PROBES = np.array([[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8]]) / np.array([[3], [10], [10], [10]])


class UvMap:
    """The faces of a mesh in the plane of its texture coordinates, sorted into a uniform grid of boxes.

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
        self._n = int(np.clip(np.sqrt(len(corners)), 1, 2048))  # boxes along an axis, about one per face
        first, last = self._box(corners.min(axis=1)), self._box(corners.max(axis=1))
        across = last - first + 1
        face, place = _ranges(across.prod(axis=1))
        keys = self._key(first[face] + np.stack([place % across[face, 0], place // across[face, 0]], axis=1))
        order = np.argsort(keys, kind="stable")
        self._faces = face[order]
        self._starts = np.searchsorted(keys[order], np.arange(self._n**2 + 1))
        self._refuse_overlaps()

    def locate(self, uv: Float64) -> tuple[Int64, Float64]:
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
            for other in np.flatnonzero(covering & (face != chosen[point] // len(_PROBES)))[:1]:
                first = chosen[point[other]]
                (u, v), pair = probes[first], sorted((int(first) // len(_PROBES), int(face[other])))
                raise ValueError(
                    f"its texture coordinates overlap: (u, v) = ({u:.4g}, {v:.4g}) lies in the triangles {pair[0]} and "
                    f"{pair[1]}, need one place on the wall for every (u, v)"
                )

    def _parts(self, uv: Float64) -> list[Int64]:
        """Return the indices of points in groups that have at most ``MAX_PAIRS`` candidates, or one point."""
        group = np.cumsum(self._counts(uv)[1]) // MAX_PAIRS
        return [np.flatnonzero(group == number) for number in np.unique(group)]

    def _candidates(self, uv: Float64) -> tuple[Int64, Int64, Float64]:
        """Return pairs of a point and a face near it, with the point's barycentric coordinates (k, 3) there."""
        starts, counts = self._counts(uv)
        point, place = _ranges(counts)
        face = self._faces[starts[point] + place]
        a, b, c = (self._corners[face, k] for k in range(3))
        whole = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):  # a face without extent in (u, v) covers nothing
            second, third = _cross(uv[point] - a, c - a) / whole, _cross(b - a, uv[point] - a) / whole
        inside = np.stack([1 - second - third, second, third], axis=1)
        return point, face, np.where(np.isfinite(inside), inside, -np.inf)

    def _counts(self, uv: Float64) -> tuple[Int64, Int64]:
        """Return the first entry of ``_faces`` in the box of each point, and the number of entries there."""
        key = self._key(self._box(uv))
        return self._starts[key], self._starts[key + 1] - self._starts[key]

    def _box(self, uv: Float64) -> Int64:
        return np.clip((uv * self._n).astype(np.int64), 0, self._n - 1)

    def _key(self, box: Int64) -> Int64:
        return box[:, 1] * self._n + box[:, 0]


def _ranges(counts: Int64) -> tuple[Int64, Int64]:
    """Return, for ``counts`` (n,) entries of each owner, the owner of every entry and the entry's number there."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def _cross(a: Float64, b: Float64) -> Float64:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
