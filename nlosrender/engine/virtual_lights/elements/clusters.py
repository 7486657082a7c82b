"""Clusters: neighbouring triangles -> one patch, so that detail below time and distance resolution costs nothing.

A cluster's footprint in time is the parallelogram with its members' second moments. It is lit and seen by one normal n
and area A although its members have normals n_i of their own: a Lambertian surface sends light on from direction l to
direction s by l^T M s, with M the sum of A_i n_i n_i^T. With u = M r for one direction r, the rank-one matrix
u u^T / (r . u) does the same wherever l or s is r, and errs elsewhere by the product of their differences from r
(Nystrom approximation); so n = u / |u| and A = |u|^2 / (r . u), with r towards the lasers. Half a sphere, lit and seen
from above, would be 3 times too bright with the sum of the A_i for A, 1.5 times with the length of the sum of the
A_i n_i: docs/virtual-lights.md, 4.3.

Visibility is that of one member, drawn by area: two sheets in one cluster still hide each other, on average, and the
difference of two resolutions shows the noise of the draw.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.area_moments import AreaMoments, BoxPlane
from nlosrender.engine.virtual_lights.elements.patches import Patches
from nlosrender.engine.virtual_lights.elements.triangles import centroids, unit_vectors
from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import Elements


class Merger:
    """Merges elements far smaller than they need to be into one patch per box, at any scale.

    Coarse clusters are made of finer area moments where these are far fewer than the elements.

    Parameters
    ----------
    elements, normals, areas
        Elements of all shapes, their unit normals (n, 3) and areas (n,).
    allowed
        (n,) size a patch may have at scale 1 [engine units].
    light
        (3,) mean of the laser points [engine units].
    """

    def __init__(
        self,
        elements: Elements,
        normals: Float64,
        areas: Float64,
        allowed: Float64,
        light: Float64,
        tuning: VirtualLightTuning,
    ):
        self.elements, self.normals, self.light, self.tuning = elements, normals, light, tuning
        self._element_moments = AreaMoments.of(elements, normals, areas, allowed, tuning)
        self._moments_at: dict[float, AreaMoments] = {}  # per scale, powers of two

    def set_up(self) -> None:
        """Sum up the elements at all scales at which that leaves far fewer."""
        self._moments_of(2.0**-self.tuning.moment_halvings)

    def clusters(self, chosen: NDArray[np.bool_], patch_scale: float, seed: int = 0) -> Patches:
        """Return the clusters of the ``chosen`` elements (n,), at least one; ``seed`` draws representatives."""
        level = 2.0 ** (math.floor(math.log2(patch_scale)) - self.tuning.moment_halvings)
        moments = self._moments_of(level) if chosen.all() else self._element_moments.select(chosen)
        merged = moments.merged(patch_scale, np.random.default_rng(seed), self.tuning)
        representative, plane = merged.representative, BoxPlane.of(merged.places, merged.upright)
        centres = _from_box(plane.mean, merged.upright)
        areas, normals = self._as_one(merged, self.light - centres)
        barycentric = centroids(self.elements.weights[representative])[:, 1:]
        return Patches(
            corners=_parallelograms(plane, merged, centres),
            areas=areas,
            centres=centres,
            normals=normals,
            shapes=self.elements.shapes[representative],
            primitives=self.elements.primitives[representative],
            barycentric=barycentric,
            corner_barycentric=np.repeat(barycentric[:, None], 3, axis=1),
            members=centroids(self.elements.corners[representative]),
            member_normals=self.normals[representative],
            is_cluster=np.ones(len(merged), bool),
        )

    def _moments_of(self, patch_scale: float) -> AreaMoments:
        """Return all elements, merged to a scale that is a power of two where that leaves far fewer."""
        moments, tuning = self._element_moments, self.tuning
        if tuning.min_elements_per_moment * moments.boxes.sum() > patch_scale**2 * len(moments):
            return moments
        if patch_scale not in self._moments_at:
            finer = self._moments_of(patch_scale / 2)
            self._moments_at[patch_scale] = finer.merged(patch_scale, np.random.default_rng(1), tuning)
        return self._moments_at[patch_scale]

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


def _parallelograms(plane: BoxPlane, merged: AreaMoments, centres: Float64) -> Float64:
    """Return three successive corners (n, 3, 3) of the parallelograms on planes that have their members' moments.

    The moments of one spanned by 2 p and 2 q are (p p^T + q q^T) / 3, so p and q are the columns of a Cholesky factor
    of 3 times the moments: a rectangle stays that rectangle.
    """

    def on_plane(one: Float64, other: Float64) -> Float64:
        """Return steps (n, 3) in the planes, of given components along the two axes after the upright one."""
        up = one * plane.slopes[:, 0] + other * plane.slopes[:, 1]
        return _from_box(np.stack([one, other, up], axis=1), merged.upright)

    uu, uv, vv = 3 * plane.moments.T
    first = np.sqrt(np.maximum(uu, 0))
    shear = uv / np.maximum(first, 1e-300)
    second = np.sqrt(np.maximum(vv - shear**2, 0))
    p, q = on_plane(first, shear), on_plane(np.zeros_like(second), second)
    return np.stack([centres - p - q, centres + p - q, centres + p + q], axis=1)


def _from_box(vectors: Float64, upright: NDArray[np.int64]) -> Float64:
    """Return vectors (n, 3) given along the two axes after ``upright``, and along it."""
    return np.take_along_axis(vectors, (np.arange(3) - upright[:, None] - 1) % 3, axis=1)
