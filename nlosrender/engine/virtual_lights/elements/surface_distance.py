"""Distance from laser and sensor points that lie on any surfaces, where patches of the same surfaces are gathered.

A point exchanges no light with its own plane, nor with a sphere or cylinder that it is on the outside of: these do not
count, however near. docs/virtual-lights.md, 3.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from nlosrender.engine.virtual_lights.elements.triangles import centroids, normals_and_areas
from nlosrender.scene.pixel_points import FirstHits
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements

# Engine units, and what follows from float32: as for walls (subdivision.py).
MIN_DISTANCE = 1e-8
MIN_IN_PLANE_DISTANCE = 1e-3  # from a point in the element's plane
MIN_COSINE = 1e-5  # below it an element lies in the plane of a point
PLANE_ROUNDING = 1e-5  # of normals and offsets: points of one plane come as float32
MIN_PLANE_POINTS = 4  # that make a group of their own; points of a curved mesh have as many planes as triangles
N_NEIGHBOURS = 8  # of the other points, as of those of a mesh wall


@dataclass(frozen=True, eq=False)
class _Group:
    """Points that lie in one plane, or on one round shape."""

    tree: cKDTree
    positions: Float64
    normal: Float64 | None  # of the plane; None: on a round shape
    shape: int

    def distance(self, places: Float64, shape: int | None) -> Float64:
        """Return the distance (n,) of places (n, 3), on shape ``shape``, inf where these are in the plane."""
        if self.normal is None:
            return np.full(len(places), np.inf) if shape == self.shape else np.asarray(self.tree.query(places)[0])
        distances, nearest = self.tree.query(places)
        heights = np.abs((places - self.positions[nearest]) @ self.normal)
        return np.where(heights > MIN_COSINE * distances, distances, np.inf)


class SurfaceDistance:
    """Distance from the nearest laser or sensor point of a scene without relay wall.

    Parameters
    ----------
    hits
        Where the points lie.
    unit
        Metres per engine unit.
    round_shapes
        Numbers of the spheres and cylinders of the scene.
    """

    def __init__(self, hits: tuple[FirstHits, ...], unit: float, round_shapes: frozenset[int]):
        reached = [each.is_reached.ravel() for each in hits]

        def joined(name: str) -> NDArray[np.float64]:
            parts = (getattr(each, name) for each in hits)
            return np.concatenate(
                [part.reshape(is_in.size, -1)[is_in] for part, is_in in zip(parts, reached, strict=True)]
            )

        positions, normals = joined("positions") / unit, joined("normals")
        shapes = joined("shapes")[:, 0].astype(np.int64)
        self._tree = cKDTree(positions)
        is_round = np.isin(shapes, list(round_shapes))
        offsets = np.einsum("nx,nx->n", positions, normals)[:, None]
        keys = np.rint(np.concatenate([normals, offsets], axis=1) / PLANE_ROUNDING) * ~is_round[:, None]
        keys = np.concatenate([keys, np.where(is_round, shapes, -1)[:, None]], axis=1)
        _, labels, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        labels = labels.ravel()
        is_grouped = is_round | (counts[labels] >= MIN_PLANE_POINTS)
        self._groups = []
        for label in np.unique(labels[is_grouped]):
            own = labels == label
            first = int(np.flatnonzero(own)[0])
            normal = None if is_round[first] else normals[first]
            self._groups.append(_Group(cKDTree(positions[own]), positions[own], normal, int(shapes[first])))
        self._loose, self._loose_normals = positions[~is_grouped], normals[~is_grouped]
        self._loose_tree = cKDTree(self._loose) if len(self._loose) else None

    def __call__(self, places: Float64) -> Float64:
        """Return the distance (n,) of places (n, 3) from the nearest point, whatever lies in its plane."""
        return np.asarray(self._tree.query(places)[0])

    def apart(self, places: Float64, shape: int | None = None) -> Float64:
        """Return the distance (n,) of places (n, 3) of round shape ``shape`` from points that may see them."""
        distances = [group.distance(places, shape) for group in self._groups]
        if self._loose_tree is not None:
            distances.append(self._from_loose(places))
        return np.min(distances, axis=0)

    def of_elements(self, elements: Elements) -> Float64:
        """Return the distance (n,) of the centroids of elements from points that may see them."""
        centres, normals = centroids(elements.corners), normals_and_areas(elements.corners)[0]
        distances = self.apart(centres)
        close = np.flatnonzero(distances < MIN_IN_PLANE_DISTANCE)
        nearest = self._tree.data[self._tree.query(centres[close])[1]]
        heights = np.abs(np.einsum("nx,nx->n", centres[close] - nearest, normals[close]))
        is_off_plane = heights > MIN_COSINE * distances[close]
        least = np.where(is_off_plane, MIN_DISTANCE, MIN_IN_PLANE_DISTANCE)
        distances[close] = np.maximum(distances[close], least)
        extent = self._tree.maxes - self._tree.mins
        return np.minimum(distances, np.linalg.norm(extent) + self(centres))  # in the plane of all points: no light

    def _from_loose(self, places: Float64) -> Float64:
        """Return the distance (n,) from the nearest of the other points whose plane ``places`` are not in.

        If all ``N_NEIGHBOURS`` nearest ones are in their planes, the distance of the last: no other one is nearer.
        """
        assert self._loose_tree is not None
        count = min(N_NEIGHBOURS, len(self._loose))
        distances, index = self._loose_tree.query(places, k=np.arange(1, count + 1))
        heights = np.einsum("nkx,nkx->nk", places[:, None] - self._loose[index], self._loose_normals[index])
        apart = np.abs(heights) > MIN_COSINE * distances
        apart[:, -1] = True
        return np.asarray(distances[np.arange(len(places)), apart.argmax(axis=1)])
