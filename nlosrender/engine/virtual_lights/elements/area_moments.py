"""Area moments: elements summed up box by box, which clusters, and coarser moments, are made of.

docs/virtual-lights.md, 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix

from nlosrender.engine.virtual_lights.elements.patches import SHADOW_RAYS
from nlosrender.engine.virtual_lights.elements.struct_of_arrays import StructOfArrays
from nlosrender.engine.virtual_lights.elements.triangles import centroids
from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements

RIDGE = 1e-6  # of the squared extent, ridge regression: keeps planes through points on a line defined
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # axes of the second moments
PLACE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # in PAIRS

# Multiplicative hashing: one step in each key of a box adds this to its code; odd numbers without a pattern.
HASH = (
    "FAE9076D258CBCB7 CC5D0BBFAE913FFF F3DA18809D1114C1 A924D528141826C7 9F99406924734ED7 "
    "AD92C5AD6764D11D 978BC24DBD49645F D43DBFB0CF4541BD 8F3C6E5B1D27A94B"
)
STEPS = np.array([int(code, 16) for code in HASH.split()], np.uint64)

Int64 = NDArray[np.int64]
UInt64 = NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class AreaMoments(StructOfArrays):
    """Elements, or groups of neighbouring ones that face along the same axis, as sums over their members.

    A box stands upright on the axis that its members' normals are nearest to: a tilted or bent surface is cut along
    the two other axes only, into parallelograms.
    """

    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    scales: Int64  # (n,) binary logarithm of the size allowed, rounded down: that of the boxes
    levels: Float64  # (n,) how far off its plane the surface of a box may go at scale 1 [engine units]
    facing: Int64  # (n,) twice the axis, + 1 where normals go along it
    in_box: Float64  # (n, 3) centres [engine units]: across the box in two directions, and upright
    places: Float64  # (n, 10) area, area times position, and times the products of its components, as ``PAIRS``
    light: Float64  # (n, 9) area times geometric normal times shading normal, transposed
    lit_places: Float64  # (n, 15) see ``_lit_places``, or (n, 0)
    boxes: Float64  # (n,) how many boxes of scale 1 they cover
    representatives: Int64  # (n, SHADOW_RAYS) members, each drawn by area

    @classmethod
    def of(
        cls,
        elements: Elements,
        normals: Float64,
        areas: Float64,
        allowed: Float64,
        tuning: VirtualLightTuning,
        *,
        with_lit_places: bool,
    ) -> AreaMoments:
        """Return every element as a group of its own; parameters as for ``Merger``."""
        centres, index = centroids(elements.corners), np.arange(len(areas))
        upright = np.abs(normals).argmax(axis=1)
        light = (areas[:, None, None] * normals[:, :, None] * elements.shading_normals[:, None, :]).reshape(-1, 9)
        places = _place_moments(elements.corners, centres, areas)
        return cls(
            shapes=elements.shapes,
            scales=_scales(allowed),
            # a patch of this size at distance d is up to a quarter of this off a linear delay, for all its members
            levels=allowed**2 / elements.distances,
            facing=2 * upright + (normals[index, upright] > 0),
            in_box=_in_box(centres, upright),
            places=places,
            light=light,
            lit_places=_lit_places(light, places, upright) if with_lit_places else np.empty((len(areas), 0)),
            boxes=covered_boxes(normals, areas, allowed, tuning),
            representatives=np.repeat(index[:, None], SHADOW_RAYS, axis=1),
        )

    @property
    def areas(self) -> Float64:
        """Areas (n,) [engine units squared]."""
        return self.places[:, 0]

    @property
    def upright(self) -> Int64:
        """Axes (n,) that the boxes stand on."""
        return self.facing // 2

    def merged(self, patch_scale: float, generator: np.random.Generator, tuning: VirtualLightTuning) -> AreaMoments:
        """Return one group per box, of the sizes allowed times ``patch_scale``; ``generator`` draws representatives."""
        members = self._members(patch_scale, tuning)
        first = members.indices[members.indptr[:-1]]
        places = members @ self.places
        return AreaMoments(
            shapes=self.shapes[first],
            scales=self.scales[first],
            levels=self.levels[first],
            facing=self.facing[first],
            in_box=_in_box(places[:, 1:4] / places[:, :1], self.upright[first]),
            places=places,
            light=members @ self.light,
            lit_places=members @ self.lit_places,
            boxes=members @ self.boxes,
            representatives=np.take_along_axis(self.representatives, _drawn(members, self.areas, generator), axis=0),
        )

    def _members(self, patch_scale: float, tuning: VirtualLightTuning) -> csr_matrix:
        """Return which of n groups are in which of m boxes: ones in a sparse matrix (m, n)."""
        across, other, height = self.in_box.T / (patch_scale * tuning.cluster_box * 2.0**self.scales)
        height = np.floor(height / tuning.cluster_box_height)
        keys = [np.floor(across), np.floor(other), height, self.shapes, self.scales, self.facing]
        codes, number = _numbered(keys)
        off, level = self._off_plane(number), patch_scale * self.levels
        is_uneven = np.bincount(number, self.areas * off**2) > np.bincount(number, self.areas * level**2) / 12
        if is_uneven.any():  # surfaces above one another: between them there is no light, nor at one time for both
            keys.append(np.where(is_uneven[number], np.rint(off / level), 0))
            codes, number = _numbered(keys)
        is_sliver = np.bincount(number, self.boxes) < tuning.min_box_fill * patch_scale**2
        total = np.bincount(number, self.areas)
        offsets = [np.bincount(number, self.areas * (place % 1)) / total - 0.5 for place in (across, other)]
        number = _without_slivers(codes, is_sliver, np.array(offsets))[number]
        shape = (int(number.max()) + 1, len(self))
        return coo_matrix((np.ones(len(self)), (number, np.arange(len(self)))), shape=shape).tocsr()

    def _off_plane(self, number: Int64) -> Float64:
        """Return the heights (n,) of groups over the best plane through all in the box that ``number`` (n,) names."""
        places: Float64 = np.stack([np.bincount(number, column) for column in self.places.T], axis=1)
        upright = np.empty(len(places), np.int64)
        upright[number] = self.upright
        plane = BoxPlane.of(places, upright)
        u, v, height = (self.in_box - plane.mean[number]).T
        return height - u * plane.slopes[number, 0] - v * plane.slopes[number, 1]


@dataclass(frozen=True, eq=False)
class BoxPlane:
    """Least-squares planes through what lies in boxes, and its second moments on them."""

    mean: Float64  # (n, 3) centres: across in two directions, and upright
    slopes: Float64  # (n, 2) along these two directions
    moments: Float64  # (n, 3) about the centres: of the first direction, mixed, of the second
    thickness: Float64  # (n,) variance of the heights over the plane

    @classmethod
    def of(cls, places: Float64, upright: Int64) -> BoxPlane:
        """Return the planes of sums (n, 10) as ``AreaMoments.places``, with the axes (n,) that the boxes stand on."""
        sums, index = places[:, 1:] / np.maximum(places[:, :1], 1e-300), np.arange(len(places))
        axes = [(upright + 1) % 3, (upright + 2) % 3, upright]
        mean = np.stack([sums[index, axis] for axis in axes], axis=1)

        def moment(one: int, other: int) -> Float64:
            """Return the second moments along two axes about the centres."""
            return sums[index, 3 + PLACE[axes[one], axes[other]]] - mean[:, one] * mean[:, other]

        uu, uv, vv, uh, vh, hh = (moment(*pair) for pair in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
        ridge = RIDGE * (uu + vv) + 1e-100
        determinant = (uu + ridge) * (vv + ridge) - uv**2
        slopes = ((vv + ridge) * uh - uv * vh) / determinant, ((uu + ridge) * vh - uv * uh) / determinant
        thickness = np.maximum(hh - slopes[0] * uh - slopes[1] * vh, 0)
        return cls(mean, np.stack(slopes, axis=1), np.stack([uu, uv, vv], axis=1), thickness)


def covered_boxes(normals: Float64, areas: Float64, allowed: Float64, tuning: VirtualLightTuning) -> Float64:
    """Return how many boxes of scale 1 elements (n,) cover; parameters as for ``Merger``."""
    return areas * np.abs(normals).max(axis=1) / (tuning.cluster_box * 2.0 ** _scales(allowed)) ** 2


def _scales(allowed: Float64) -> Int64:
    return np.floor(np.log2(allowed)).astype(np.int64)


def _in_box(vectors: Float64, upright: Int64) -> Float64:
    """Return the components (n, 3) of vectors along the two axes after ``upright``, and along it."""
    return np.take_along_axis(vectors, (upright[:, None] + np.array([1, 2, 0])) % 3, axis=1)


def _place_moments(corners: Float64, centres: Float64, areas: Float64) -> Float64:
    """Return area, and area times centre and times second moments, of triangles (n, 10).

    The second moments of a triangle about the origin: the sum of v v^T over its corners and of 9 c c^T for its
    centroid c, / 12.
    """
    result = np.empty((len(areas), 10))
    result[:, 0], result[:, 1:4] = areas, areas[:, None] * centres
    for column, (i, j) in enumerate(PAIRS, 4):
        squares = [corners[:, k, i] * corners[:, k, j] for k in range(3)]
        result[:, column] = areas * (sum(squares) + 9 * centres[:, i] * centres[:, j]) / 12
    return result


def light_in_box(light: Float64, upright: Int64) -> Float64:
    """Return ``AreaMoments.light``, its symmetric part (n, 3, 3) along the two axes after ``upright``, and along it."""
    axes, index = (upright[:, None] + np.array([1, 2, 0])) % 3, np.arange(len(upright))[:, None, None]
    matrices = light.reshape(-1, 3, 3)[index, axes[:, :, None], axes[:, None, :]]
    symmetric: Float64 = (matrices + matrices.swapaxes(1, 2)) / 2
    return symmetric


def _lit_places(light: Float64, places: Float64, upright: Int64) -> Float64:
    """Return positions, and products of their components, times w (n, 9); and positions times w p (n, 6).

    w is area times the squared upright component of the normal, p are the slopes: see ``clusters.Facets``.
    """
    weights, means = light_in_box(light, upright)[:, 2], places[:, 1:] / places[:, :1]
    by_slopes = [weights[:, axis, None] * means[:, :3] for axis in (0, 1)]
    return np.concatenate([weights[:, 2, None] * means, *by_slopes], axis=1)


def _numbered(keys: list[NDArray[Any]]) -> tuple[UInt64, Int64]:
    """Return the sorted hash codes (m,) of all combinations of whole keys, and the index among them (n,).

    Codes of different combinations are as good as random: among a million one pair is the same with probability 3e-8.
    """
    codes = np.zeros(len(keys[0]), np.uint64)
    for key, step in zip(keys, STEPS[: len(keys)], strict=True):
        codes += key.astype(np.int64).view(np.uint64) * step
    return np.unique(codes, return_inverse=True)


def _without_slivers(codes: UInt64, is_sliver: NDArray[np.bool_], offsets: Float64) -> Int64:
    """Return the number (m,) of each box's group when slivers join the box across the side that they lie along.

    ``codes`` (m,) are sorted; ``offsets`` (2, m) lead across from the middle of a box to that of what is in it.
    """
    slivers = np.flatnonzero(is_sliver)
    offsets = offsets[:, slivers]
    side = np.abs(offsets).argmax(axis=0)
    steps = STEPS[side]
    neighbours = codes[slivers] + np.where(offsets[side, np.arange(len(slivers))] > 0, steps, -steps)
    beside = np.minimum(np.searchsorted(codes, neighbours), len(codes) - 1)
    joins = (codes[beside] == neighbours) & ~is_sliver[beside]
    box = np.arange(len(codes))
    box[slivers[joins]] = beside[joins]
    return np.unique(box, return_inverse=True)[1]


def _drawn(members: csr_matrix, areas: Float64, generator: np.random.Generator) -> Int64:
    """Draw members of every box (n, SHADOW_RAYS), each with probability in proportion to its area.

    Stratified, the strata in a random cyclic order: neighbours in the mesh are rarely drawn together.
    """
    starts, ends = members.indptr[:-1], members.indptr[1:]
    cumulative = np.append(0.0, np.cumsum(areas[members.indices]))
    strata = (np.arange(SHADOW_RAYS) + generator.integers(SHADOW_RAYS, size=(len(starts), 1))) % SHADOW_RAYS
    share = (strata + generator.random(strata.shape)) / SHADOW_RAYS
    position = cumulative[starts, None] + share * (cumulative[ends] - cumulative[starts])[:, None]
    chosen = np.searchsorted(cumulative, position, side="right") - 1
    return members.indices[np.clip(chosen, starts[:, None], ends[:, None] - 1)].astype(np.int64)
