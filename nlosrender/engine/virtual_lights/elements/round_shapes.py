"""Spheres and cylinders as patches with the true areas and normals, and points of their elements brought onto them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from nlosrender.engine.virtual_lights.elements.patches import Patches, split_weights
from nlosrender.engine.virtual_lights.elements.surface_distance import SurfaceDistance
from nlosrender.scene.loading.round_surfaces import RoundSurface
from nlosrender.scene.pose import Float64

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.subdivision import WallDistance

ICOSAHEDRON_EDGE = 1.052  # in the unit sphere: 4 / sqrt(10 + 2 sqrt(5)), rounded up
# Of a cylinder's circumference. With fewer, the normals over one patch differ by more than 60 degrees.
MIN_SEGMENTS = 6


@dataclass(frozen=True, eq=False)
class RoundShape:
    """A sphere, or a cylinder without caps [engine units]."""

    index: int  # in the scene's shapes
    centre: Float64  # (3,) of a cylinder: where its axis begins
    radius: float  # negative when the shape is seen from within
    axis: Float64  # (3,) from end to end; zero for a sphere

    @classmethod
    def of(cls, index: int, shape: mi.Shape) -> RoundShape:
        """Return what a Mitsuba sphere or cylinder is."""
        surface = RoundSurface.of(shape)
        return cls(index, surface.centre, (-1 if surface.is_inside else 1) * surface.radius, surface.axis)

    @property
    def row(self) -> Float64:
        """Centre, signed radius and unit axis (7,)."""
        length = np.linalg.norm(self.axis)
        return np.concatenate([self.centre, [self.radius], self.axis / length if length > 0 else self.axis])

    def nearest(self, distance: WallDistance | SurfaceDistance) -> float:
        """Return the distance from the nearest laser or sensor point, of spheres exactly; not from points on itself."""
        along = np.linspace(0, 1, 33)[:, None] * self.axis if self.axis.any() else np.zeros((1, 3))
        places = self.centre + along
        apart = distance.apart(places, self.index) if isinstance(distance, SurfaceDistance) else distance(places)
        return abs(float(apart.min()) - abs(self.radius))

    def count(self, across: float, along: float) -> int:
        """Return how many patches it takes of sizes up to ``across``, and ``along`` the axis of a cylinder."""
        if not self.axis.any():
            return 20 * self._splits(across) ** 2
        n_around, n_along = self._rings(across, along)
        return 2 * n_around * n_along

    def patches(self, across: float, along: float) -> Patches:
        """Return patches of sizes up to ``across``, and ``along`` the axis of a cylinder; their corners lie on it."""
        if self.axis.any():
            return _cylinder(self, *self._rings(across, along))
        return _sphere(self, self._splits(across))

    def _splits(self, allowed: float) -> int:
        return int(np.ceil(ICOSAHEDRON_EDGE * abs(self.radius) / allowed))

    def _rings(self, across: float, along: float) -> tuple[int, int]:
        # a square's diagonal is the size of its triangles
        n_around = int(np.ceil(np.sqrt(2) * 2 * np.pi * abs(self.radius) / across))
        n_along = int(np.ceil(np.sqrt(2) * np.linalg.norm(self.axis) / along))
        return max(n_around, MIN_SEGMENTS), max(n_along, 1)


def onto_round_shapes(positions: Float64, normals: Float64, rows: Float64) -> tuple[Float64, Float64, Float64]:
    """Bring points of elements onto the round shapes they belong to.

    Parameters
    ----------
    positions, normals
        (n, 3) points of flat elements and the elements' unit normals.
    rows
        (n, 7) ``RoundShape.row`` of the shape each belongs to; zeros on flat surfaces.

    Returns
    -------
    tuple
        Positions, normals, and the stretch of area: radius^2 cos / distance^2 on spheres, radius cos / distance on
        cylinders, with distance and cosine seen from the centre or across the axis.
    """
    positions, normals, stretch = positions.copy(), normals.copy(), np.ones(len(positions))
    is_round = rows[:, 3] != 0
    if is_round.any():
        centre, radius, axis = rows[is_round, :3], rows[is_round, 3], rows[is_round, 4:]
        outward = positions[is_round] - centre
        outward -= np.einsum("nx,nx->n", outward, axis)[:, None] * axis
        distance = np.linalg.norm(outward, axis=1)
        outward /= distance[:, None]
        cosine = np.abs(np.einsum("nx,nx->n", outward, normals[is_round]))
        shrink = np.abs(radius) / distance
        stretch[is_round] = cosine * np.where(axis.any(axis=1), shrink, shrink**2)
        positions[is_round] += (np.abs(radius) - distance)[:, None] * outward
        normals[is_round] = np.sign(radius)[:, None] * outward
    return positions, normals, stretch


def _sphere(shape: RoundShape, n: int) -> Patches:
    """Cut a sphere into 20 n^2 spherical triangles: an icosahedron's faces, cut and projected."""
    flat = np.einsum("pkb,tbx->tpkx", split_weights(n), _icosahedron()).reshape(-1, 3, 3)
    unit = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
    a, b, c = unit[:, 0], unit[:, 1], unit[:, 2]
    # solid angle of a spherical triangle (Van Oosterom & Strackee 1983)
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = 1 + np.einsum("ij,ij->i", a, b) + np.einsum("ij,ij->i", b, c) + np.einsum("ij,ij->i", c, a)
    solid_angle = 2 * np.arctan2(triple, denominator)
    direction = unit.mean(axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre, radius = shape.centre, abs(shape.radius)
    return Patches.triangles(
        centre + radius * unit,
        radius**2 * solid_angle,
        centre + radius * direction,
        np.sign(shape.radius) * direction,
        np.full(len(unit), shape.index, np.uint32),
    )


def _cylinder(shape: RoundShape, around: int, along: int) -> Patches:
    """Cut a cylinder into ``around`` times ``along`` rectangles of two patches each."""
    length = float(np.linalg.norm(shape.axis))
    axis, radius = shape.axis / length, abs(shape.radius)
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)

    def point(phase: Float64, height: Float64) -> Float64:
        """Return points at turns of the circumference and heights in [0, 1]."""
        radial = np.cos(2 * np.pi * phase)[..., None] * first + np.sin(2 * np.pi * phase)[..., None] * second
        return shape.centre + radius * radial + height[..., None] * shape.axis

    i, j = (index.ravel() for index in np.meshgrid(np.arange(around), np.arange(along)))
    # (two triangles, 3 corners, turn and height)
    steps = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=np.float64)
    phase, height = (i[:, None, None] + steps[..., 0]) / around, (j[:, None, None] + steps[..., 1]) / along
    corners = point(phase, height).reshape(-1, 3, 3)
    centres = point(phase.mean(axis=2), height.mean(axis=2)).reshape(-1, 3)
    radial = centres - shape.centre
    radial -= (radial @ axis)[:, None] * axis
    count = len(corners)
    return Patches.triangles(
        corners,
        np.full(count, 2 * np.pi * radius * length / count),
        centres,
        np.sign(shape.radius) * radial / radius,
        np.full(count, shape.index, np.uint32),
    )


def _icosahedron() -> Float64:
    """Return the 20 faces (20, 3, 3) of the icosahedron in the unit sphere, counter-clockwise from outside."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array([(s, t * golden, 0) for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([vertices, np.roll(vertices, 1, axis=1), np.roll(vertices, 2, axis=1)])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    edge = 2 / np.sqrt(1 + golden**2)
    near = np.abs(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) - edge) < 1e-9
    faces = []
    for i, j, k in combinations(range(12), 3):
        if near[i, j] and near[j, k] and near[i, k]:
            a, b, c = vertices[[i, j, k]]
            faces.append((a, b, c) if np.dot(a, np.cross(b, c)) > 0 else (a, c, b))
    return np.array(faces)
