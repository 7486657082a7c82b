"""Neighbouring triangles -> one patch: detail that time and distance cannot tell apart costs nothing.

A cluster has a parallelogram with its members' second moments as its footprint in time. It is lit and seen by one
normal n and area A although its members have normals n_i of their own: a Lambertian surface sends light on from
direction l to direction s by l^T M s, with M the sum of A_i n_i n_i^T. With u = M r for one direction r, the matrix of
rank one u u^T / (r . u) does the same wherever l or s is r, and errs elsewhere by the product of their differences
from r (Nystrom's approximation); so n = u / |u| and A = |u|^2 / (r . u), with r towards the lasers. The sum of the
A_i for A would be too bright: 1.5 times for half a sphere, lit and seen from above.

Whether it is seen is asked of one member, drawn by area: two sheets in one cluster still hide each other, on
average, and the difference of two resolutions shows the noise of the draw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.area_moments import AreaMoments, BoxPlane, Int64
from nlosrender.engine.virtual_lights.elements.patches import Patches
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, middles
from nlosrender.scene.pose import Float64

STEEPEST = 0.5  # cosine to the lasers, below which members may face away from them
FINER = 1  # times half the size of the clusters: the grains they are made of
WORTHWHILE = 4  # cells per grain


class Merger:
    """Merges cells far smaller than they need to be into one patch per box, at any coarseness.

    Coarse clusters are made of finer ones where these are far fewer than the cells: once summed up, the cells are
    not looked at again.

    Parameters
    ----------
    elements
        Cells of all shapes.
    normals, areas
        (n, 3) and (n,) of the cells.
    allowed
        (n,) size a patch may have at coarseness 1 [engine units].
    light
        (3,) middle of the laser points [engine units].
    """

    def __init__(self, elements: Elements, normals: Float64, areas: Float64, allowed: Float64, light: Float64):
        self.elements, self.normals, self.light = elements, normals, light
        self._element_moments = AreaMoments.of(elements, normals, areas, allowed)
        self._moments_at: dict[float, AreaMoments] = {}  # per coarseness

    @property
    def boxes(self) -> Float64:
        """How many clusters the cells (n,) are at coarseness 1; their number goes with coarseness^-2."""
        return self._element_moments.boxes

    def set_up(self) -> None:
        """Sum up the cells at all resolutions at which that leaves far fewer."""
        self._moments_of(2.0**-FINER)

    def clusters(self, chosen: NDArray[np.bool_], patch_scale: float, seed: int = 0) -> Patches:
        """Return the clusters of the cells that are ``chosen``.

        Parameters
        ----------
        chosen
            (n,) which cells; at least one.
        patch_scale
            Scales the sizes allowed.
        seed
            Of the draw of the members that stand for their clusters.
        """
        level = 2.0 ** (math.floor(math.log2(patch_scale)) - FINER)
        members = self._moments_of(level) if chosen.all() else self._element_moments.at(chosen)
        merged = members.merged(patch_scale, np.random.default_rng(seed))
        parallelogram, representative = _ClusterParallelogram.of(merged), merged.representative
        areas, normals = _as_one(merged, self.light - parallelogram.mean)
        barycentric = middles(self.elements.weights[representative])[:, 1:]
        return Patches(
            parallelogram.corners(),
            areas,
            parallelogram.mean,
            normals,
            self.elements.shapes[representative],
            self.elements.primitives[representative],
            barycentric,
            np.repeat(barycentric[:, None], 3, axis=1),
            middles(self.elements.corners[representative]),
            self.normals[representative],
            np.ones(len(merged), bool),
        )

    def _moments_of(self, patch_scale: float) -> AreaMoments:
        """Return all cells, merged to a coarseness that is a power of two where that leaves far fewer."""
        if WORTHWHILE * self.boxes.sum() > patch_scale**2 * len(self._element_moments):
            return self._element_moments
        if patch_scale not in self._moments_at:
            finer = self._moments_of(patch_scale / 2)
            self._moments_at[patch_scale] = finer.merged(patch_scale, np.random.default_rng(1))
        return self._moments_at[patch_scale]


def _as_one(merged: AreaMoments, towards: Float64) -> tuple[Float64, Float64]:
    """Return the area (n,) and normal (n, 3) that stand for those of all members; ``towards`` (n, 3) the lasers."""
    matrices = merged.light.reshape(-1, 3, 3)
    axis, sign = merged.facing // 2, 2 * (merged.facing % 2) - 1
    # no member is more than 55 degrees off the axis it faces along, or against: this goes along their mean normal
    own = _unit(matrices[np.arange(len(merged)), :, axis] * sign[:, None])
    towards = _unit(towards)
    is_lit = np.einsum("nx,nx->n", own, towards) > STEEPEST
    reference = np.where(is_lit[:, None], towards, own)
    light = np.einsum("nxy,ny->nx", matrices, reference)
    onto = np.einsum("nx,nx->n", light, reference)
    # shading normals against those of the triangles: nothing is lit
    areas = np.where(onto > 0, np.einsum("nx,nx->n", light, light) / np.maximum(onto, 1e-300), 0.0)
    return np.minimum(areas, merged.areas), _unit(light)


@dataclass(frozen=True, eq=False)
class _ClusterParallelogram:
    """Where clusters lie: across the axes their boxes stand on, and on the best planes through their members."""

    upright: Int64  # (n,) these axes
    plane: BoxPlane

    @classmethod
    def of(cls, merged: AreaMoments) -> _ClusterParallelogram:
        """Return where the members lie."""
        upright = merged.facing // 2
        return cls(upright, BoxPlane.of(merged.places, upright))

    @property
    def mean(self) -> Float64:
        """Middles (n, 3)."""
        return self._from_box(self.plane.mean)

    def corners(self) -> Float64:
        """Return three corners (n, 3, 3) in a row of parallelograms with these moments.

        The moments of one spanned by 2 p and 2 q are (p p^T + q q^T) / 3, so p and q are the columns of a Cholesky
        factor of 3 times the moments: a rectangle stays that rectangle.
        """
        uu, uv, vv = 3 * self.plane.moments.T
        first = np.sqrt(np.maximum(uu, 0))
        shear = uv / np.maximum(first, 1e-300)
        second = np.sqrt(np.maximum(vv - shear**2, 0))
        p, q = self._on_plane(first, shear), self._on_plane(np.zeros_like(second), second)
        mean = self.mean
        return np.stack([mean - p - q, mean + p - q, mean + p + q], axis=1)

    def _on_plane(self, one: Float64, other: Float64) -> Float64:
        """Return steps (n, 3) in the planes, of given components along the two axes after ``upright``."""
        up = one * self.plane.slopes[:, 0] + other * self.plane.slopes[:, 1]
        return self._from_box(np.stack([one, other, up], axis=1))

    def _from_box(self, vectors: Float64) -> Float64:
        """Return vectors (n, 3) given along the two axes after ``upright``, and along it."""
        rows, result = np.arange(len(vectors)), np.empty_like(vectors)
        for phase, component in zip((1, 2, 0), vectors.T, strict=True):
            result[rows, (self.upright + phase) % 3] = component
        return result


def _unit(vectors: Float64) -> Float64:
    """Return vectors (n, 3) at unit length; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
