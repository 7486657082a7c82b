"""Clusters: neighbouring triangles -> one patch, so that detail below time and distance resolution costs nothing.

A cluster's footprint in time is the parallelogram with its members' second moments. It is lit and seen by one normal n
and area A although its members have normals n_i of their own: a Lambertian surface sends light on from direction l to
direction s by l^T M s, with M the sum of A_i n_i n_i^T. With u = M r for one direction r, the rank-one matrix
u u^T / (r . u) does the same wherever l or s is r, and errs elsewhere by the product of their differences from r
(Nystrom approximation); so n = u / |u| and A = |u|^2 / (r . u), with r towards the lasers. Half a sphere, lit and seen
from above, would be 3 times too bright with the sum of the A_i for A, 1.5 times with the length of the sum of the
A_i n_i: docs/virtual-lights.md, 4.3. Laser points in several places leave no such r: there three facets stand for a
rough cluster, whose normals make up M.

Visibility is that of one member, or a few, drawn by area: two sheets in one cluster still hide each other, on average,
and the difference of two resolutions shows the noise of the draw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.area_moments import PAIRS, PLACE, AreaMoments, BoxPlane, light_in_box
from nlosrender.engine.virtual_lights.elements.patches import Patches
from nlosrender.engine.virtual_lights.elements.triangles import centroids, unit_vectors
from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements

MIN_LIT_SHARE = 1e-3  # sum of w over a cluster's area, least: shading normals across the triangles make it 0 or less
TILTS = math.sqrt(1.5) * np.array([1.0, -1.0, 0.0])  # of facets: none in the mean, variance 1
TURNS = 2 * np.pi / 3 * np.arange(3)
CIRCLE = math.sqrt(2) * np.stack([np.cos(TURNS), np.sin(TURNS)], axis=1)  # none in the mean, the unit matrix squared
ROUNDING = 1e-9  # of moments in float64, many times over
MIN_SLOPE_VARIANCE = 1e-12  # float64 rounds covariances by 1e-16 of squared slopes


class Merger:
    """Merges elements far smaller than they need to be into one patch per box, at any scale.

    Coarse clusters are made of finer area moments where these are far fewer than the elements, and of the elements that
    are too large for these.

    Parameters
    ----------
    elements, normals, areas
        Elements of all shapes, their unit normals (n, 3) and areas (n,).
    allowed
        (n,) size a patch may have at scale 1 [engine units].
    ratios
        (n,) sizes of the elements over these.
    light
        (3,) mean of the laser points [engine units].
    is_one_point
        Whether all laser points are there.
    """

    def __init__(
        self,
        elements: Elements,
        normals: Float64,
        areas: Float64,
        allowed: Float64,
        ratios: Float64,
        light: Float64,
        is_one_point: bool,
        tuning: VirtualLightTuning,
    ):
        self.elements, self.normals, self.light, self.tuning = elements, normals, light, tuning
        self._is_one_point, self._centroids = is_one_point, centroids(elements.corners)
        self._ratios = ratios
        self._element_moments = AreaMoments.of(
            elements, normals, areas, allowed, tuning, with_lit_places=not is_one_point
        )
        self._moments_at: dict[float, AreaMoments] = {}  # per scale, powers of two

    def set_up(self) -> None:
        """Sum up the elements at all scales at which that leaves far fewer."""
        self._moments_of(2.0**-self.tuning.moment_halvings)

    def is_small(self, patch_scale: float) -> NDArray[np.bool_]:
        """Return which elements (n,) are merged at a scale."""
        return self._ratios < self.tuning.merge_ratio * patch_scale

    def clusters(self, patch_scale: float, seed: int = 0) -> Patches:
        """Return the clusters of the elements that are merged, at least one; ``seed`` draws representatives."""
        level = 2.0 ** (math.floor(math.log2(patch_scale)) - self.tuning.moment_halvings)
        moments = self._with_larger(self._moments_of(level), level, patch_scale)
        merged = moments.merged(patch_scale, np.random.default_rng(seed), self.tuning)
        representative, plane = merged.representatives[:, 0], BoxPlane.of(merged.places, merged.upright)
        centres = _from_box(plane.mean, merged.upright)
        areas, normals = self._as_one(merged, self.light - centres)
        barycentric = centroids(self.elements.weights[representative])[:, 1:]
        clusters = Patches(
            corners=_parallelograms(plane, merged.upright, centres),
            areas=areas,
            centres=centres,
            normals=normals,
            shapes=self.elements.shapes[representative],
            primitives=self.elements.primitives[representative],
            barycentric=barycentric,
            corner_barycentric=np.repeat(barycentric[:, None], 3, axis=1),
            members=(self._centroids[merged.representatives] - centres[:, None]).astype(np.float32),
            member_normals=self.normals[merged.representatives].astype(np.float32),
            is_cluster=np.ones(len(merged), bool),
        )
        if self._is_one_point:
            return clusters
        is_rough = roughness(merged) > self.tuning.facet_roughness * patch_scale**2
        facets = Facets.of(merged.select(is_rough))
        rough = clusters.select(np.repeat(np.flatnonzero(is_rough), 3))
        rough = replace(
            rough,
            areas=facets.areas,
            centres=facets.centres,
            normals=facets.normals,
            corners=facets.corners,
            members=(rough.members + (rough.centres - facets.centres)[:, None]).astype(np.float32),
        )
        return Patches.joined([clusters.select(~is_rough), rough])

    def _moments_of(self, patch_scale: float) -> AreaMoments:
        """Return the elements merged at a scale that is a power of two, summed up where that leaves far fewer."""
        if patch_scale not in self._moments_at:
            tuning, elements, chosen = self.tuning, self._element_moments, self.is_small(patch_scale)
            boxes = elements.boxes[chosen].sum() / patch_scale**2
            if tuning.min_elements_per_moment * boxes >= np.count_nonzero(chosen):
                return elements.select(chosen)
            finer = self._with_larger(self._moments_of(patch_scale / 2), patch_scale / 2, patch_scale)
            self._moments_at[patch_scale] = finer.merged(patch_scale, np.random.default_rng(1), tuning)
        return self._moments_at[patch_scale]

    def _with_larger(self, moments: AreaMoments, finer: float, coarser: float) -> AreaMoments:
        """Return moments, and the elements that are merged at the ``coarser`` scale, but not at the ``finer`` one."""
        larger = self.is_small(coarser) & ~self.is_small(finer)
        return AreaMoments.joined([moments, self._element_moments.select(larger)]) if larger.any() else moments

    def _as_one(self, merged: AreaMoments, to_lasers: Float64) -> tuple[Float64, Float64]:
        """Return the area (n,) and normal (n, 3) that stand for those of all members, see the top of the module."""
        matrices = merged.light.reshape(-1, 3, 3)
        sign = 2 * (merged.facing % 2) - 1
        # no member is more than 55 degrees off the axis it faces along, or against: this goes along their mean normal
        own = unit_vectors(matrices[np.arange(len(merged)), :, merged.upright] * sign[:, None])
        to_lasers = unit_vectors(to_lasers)
        is_lit = np.einsum("nx,nx->n", own, to_lasers) > self.tuning.min_laser_cosine
        reference = np.where(is_lit[:, None], to_lasers, own)
        light = np.einsum("nxy,ny->nx", matrices, reference)
        onto = np.einsum("nx,nx->n", light, reference)
        # shading normals against those of the triangles: nothing is lit
        areas = np.where(onto > 0, np.einsum("nx,nx->n", light, light) / np.maximum(onto, 1e-300), 0.0)
        return np.minimum(areas, merged.areas), unit_vectors(light)


@dataclass(frozen=True, eq=False)
class Facets:
    """Three facets per group, one group after the other, with the light and the delays of the group's members.

    With slopes p, normals are (p, 1) over its length and M is the sum of w (p, 1) (p, 1)^T: three equal w, their slopes
    on an ellipse about the mean at 120 degrees, have its sum, mean and covariance. Their centres are the positions that
    linear regression gives for these slopes, so that the members' covariance of position and slope is theirs, too; what
    positions vary by besides is the extent of each. docs/virtual-lights.md, 4.3.
    """

    areas: Float64  # (3 n,)
    normals: Float64  # (3 n, 3)
    centres: Float64  # (3 n, 3)
    corners: Float64  # (3 n, 3, 3) as of ``Patches``

    @classmethod
    def of(cls, merged: AreaMoments) -> Facets:
        """Return those of groups whose ``roughness`` is not 0."""
        slopes = _Slopes.of(merged)
        variances, axes = np.linalg.eigh(slopes.covariance)
        along = axes * np.sqrt(np.maximum(variances, 0))[:, None, :]
        of_facets = slopes.mean[:, None] + np.einsum("kj,nij->nki", CIRCLE, along)
        sign = (2 * (merged.facing % 2) - 1)[:, None, None]
        facets = sign * np.concatenate([of_facets, np.ones((len(merged), 3, 1))], axis=2)
        squares = np.square(facets).sum(axis=2)
        normals = np.stack([_from_box(facets[:, k], merged.upright) for k in range(3)], axis=1)
        centres, corners = _placed_by_slope(merged, slopes, variances, axes)
        return cls(
            areas=(slopes.weights[:, None] / 3 * squares).ravel(),
            normals=(normals / np.sqrt(squares)[:, :, None]).reshape(-1, 3),
            centres=centres.reshape(-1, 3),
            corners=corners.reshape(-1, 3, 3),
        )


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Slopes of the members of groups, weighted by w."""

    weights: Float64  # (n,) sums of w; 0 and less where shading normals lie across the triangles
    mean: Float64  # (n, 2)
    covariance: Float64  # (n, 2, 2)

    @classmethod
    def of(cls, merged: AreaMoments) -> _Slopes:
        matrices = light_in_box(merged.light, merged.upright)
        weights = matrices[:, 2, 2]
        means = matrices / np.where(weights == 0, 1.0, weights)[:, None, None]
        mean = means[:, :2, 2]
        return cls(weights, mean, means[:, :2, :2] - mean[:, :, None] * mean[:, None, :])


def _placed_by_slope(
    merged: AreaMoments, slopes: _Slopes, variances: Float64, axes: Float64
) -> tuple[Float64, Float64]:
    """Return centres (n, 3, 3) and corners (n, 3, 3, 3) of three facets whose slopes lie on the ``CIRCLE``.

    ``variances`` (n, 2) of the slopes along orthonormal ``axes`` (n, 2, 2), columns.
    """
    # an axis without variance has no regression: the step along it is 0
    deviations = np.sqrt(np.where(variances > MIN_SLOPE_VARIANCE, variances, np.inf))
    places, by_slopes = (part / slopes.weights[:, None] for part in np.split(merged.lit_places, [9], axis=1))
    middle = places[:, :3]
    mixed = by_slopes.reshape(-1, 2, 3) - slopes.mean[:, :, None] * middle[:, None, :]
    steps = np.einsum("nij,nix->njx", axes, mixed) / deviations[:, :, None]  # per deviation of the slope
    centres = middle[:, None] + np.einsum("kj,njx->nkx", CIRCLE, steps)
    covariance = places[:, 3:][:, PLACE] - middle[:, :, None] * middle[:, None, :]
    rest = covariance - np.einsum("njx,njy->nxy", steps, steps)
    about_centres = np.zeros((len(merged), 10))
    about_centres[:, 0], about_centres[:, 4:] = 1, np.stack([rest[:, i, j] for i, j in PAIRS], axis=1)
    plane = BoxPlane.of(about_centres, merged.upright)
    rises = np.sqrt(3 * plane.thickness)[:, None] * TILTS
    corners = [_parallelograms(plane, merged.upright, centres[:, k], rises[:, k]) for k in range(3)]
    return centres, np.stack(corners, axis=1)


def roughness(merged: AreaMoments) -> Float64:
    """Return the variance (n,) of the slopes in groups; 0 where their weights are too small to divide by."""
    slopes = _Slopes.of(merged)
    variance: Float64 = np.trace(slopes.covariance, axis1=1, axis2=2)
    return np.where(slopes.weights > MIN_LIT_SHARE * merged.areas, variance, 0.0)


def _parallelograms(
    plane: BoxPlane, upright: NDArray[np.int64], centres: Float64, rises: Float64 | float = 0.0
) -> Float64:
    """Return three successive corners (n, 3, 3) of the parallelograms on planes that have their members' moments.

    The moments of one spanned by 2 p and 2 q are (p p^T + q q^T) / 3, so p and q are the columns of a Cholesky factor
    of 3 times the moments: a rectangle stays that rectangle. ``rises`` are added to p, along the upright axis.
    Members whose shading normals lie across their triangles count as negative: moments that are none of an area then
    become those of a line, or of a point.
    """

    def on_plane(one: Float64, other: Float64, rises: Float64 | float) -> Float64:
        """Return steps (n, 3) in the planes, of given components along the two axes after the upright one."""
        up = one * plane.slopes[:, 0] + other * plane.slopes[:, 1] + rises
        return _from_box(np.stack([one, other, up], axis=1), upright)

    uu, uv, vv = 3 * plane.moments.T
    first = np.sqrt(np.maximum(uu, 0))
    shear, longest = uv / np.maximum(first, 1e-300), np.sqrt(np.maximum(vv, 0))
    shear = np.where(np.abs(shear) > (1 + ROUNDING) * longest, np.copysign(longest, uv), shear)
    second = np.sqrt(np.maximum(vv - shear**2, 0))
    p, q = on_plane(first, shear, rises), on_plane(np.zeros_like(second), second, 0.0)
    return np.stack([centres - p - q, centres + p - q, centres + p + q], axis=1)


def _from_box(vectors: Float64, upright: NDArray[np.int64]) -> Float64:
    """Return vectors (n, 3) given along the two axes after ``upright``, and along it."""
    return np.take_along_axis(vectors, (np.arange(3) - upright[:, None] - 1) % 3, axis=1)
