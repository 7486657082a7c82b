"""Random points of the hidden geometry from which light leaves for the sensor points: where walks begin.

A sensor point sees a surface element by its area over its squared distance. Cells of the hidden geometry are chosen
by that measure, with the distance to the nearest sensor or laser point, so that no connection is near-singular: what
a site contributes to any sensor point is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.recurrence import recurrence_steps
from nlosrender.engine.launch.time_gate import GATE_SURVIVAL, CaptureTimeGate
from nlosrender.engine.virtual_lights.elements.round_shapes import onto_round_shapes
from nlosrender.engine.virtual_lights.elements.subdivision import longest_edges, normals_and_areas
from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_point import triangle_weights

# Barycentric coordinates of a cell's centre, and of the points between it and the corners.
POINTS_OF_CELL = np.concatenate([np.full((1, 3), 1 / 3), np.full((3, 3), 1 / 6) + np.eye(3) / 2])


@dataclass(frozen=True, eq=False)
class Vpls:
    """Points of the hidden geometry [engine units], sorted along its cells."""

    positions: Float64  # (n, 3)
    normals: Float64  # (n, 3) geometric, unit
    shapes: NDArray[np.uint32]  # (n,) index into the scene's shapes
    primitives: NDArray[np.uint32]  # (n,) triangle of a mesh, 0 on round shapes
    barycentric: Float64  # (n, 2) within that triangle
    areas: Float64  # (n,) area a site stands for: the reciprocal of n times its density
    importance: Float64  # (n,) area over squared distance from the nearest laser or sensor point

    def __len__(self) -> int:
        return len(self.areas)

    @classmethod
    def joined(cls, parts: list[Vpls]) -> Vpls:
        """Return the sites of all parts, one after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class VplSampler:
    """Draws sites on the cells of a scene.

    Parameters
    ----------
    tessellator
        Holds the cells of meshes and round shapes.
    capture_gate
        Of cells beyond it few sites are drawn; None: none is.
    """

    def __init__(self, tessellator: Tessellator, capture_gate: CaptureTimeGate | None = None):
        elements, on_round = tessellator.elements, tessellator.round_cells()
        self._corners = np.concatenate([elements.corners, *(patches.corners for _, patches in on_round)])
        self._weights = np.concatenate([elements.weights, *(np.zeros((len(patches), 3, 3)) for _, patches in on_round)])
        self._shapes = np.concatenate([elements.shapes, *(patches.shapes for _, patches in on_round)])
        self._primitives = np.concatenate([elements.primitives, *(patches.primitives for _, patches in on_round)])
        rows = [np.repeat(shape.row[None], len(patches), axis=0) for shape, patches in on_round]
        self._round_rows = np.concatenate([np.zeros((len(elements.corners), 7)), *rows])
        self._normals, self._areas = normals_and_areas(self._corners)
        centres = self._corners.mean(axis=1)
        distances = tessellator.distance(centres)
        sizes = longest_edges(self._corners)
        # a cell is no longer than its distance; its own size stands for the distance where it touches a point
        distances = np.maximum(distances, sizes / 2)
        self._reach = distances * (distances + tessellator.reach)
        order = np.lexsort((morton_order(centres), self._shapes))  # shape by shape, neighbours together
        importance = (self._areas / self._reach)[order]
        if capture_gate is not None:
            importance *= 1 - (1 - GATE_SURVIVAL) * self._late_shares(capture_gate)[order]
        self._order = order
        self.is_empty = not importance.sum() > 0
        if not self.is_empty:
            self._probability = importance / importance.sum()
            self._cumulative = np.cumsum(self._probability)

    def _late_shares(self, capture_gate: CaptureTimeGate) -> Float64:
        """Return the share of each cell that lies beyond ``capture_gate``, told by a few of its points: any will do."""
        points = (np.einsum("k,nkx->nx", weights, self._corners) for weights in POINTS_OF_CELL)
        return np.mean([capture_gate.is_beyond(point) for point in points], axis=0)

    def sample(self, count: int, generator: np.random.Generator) -> Vpls:
        """Draw ``count`` sites: one in each of as many equal parts of the cells' measure.

        Parameters
        ----------
        count
            Number of sites.
        generator
            Source of the random offsets; the points themselves are low-discrepancy.
        """
        steps = np.array(recurrence_steps(2), dtype=np.uint64)
        at = (np.arange(count) + generator.random(count)) / count
        chosen = np.minimum(np.searchsorted(self._cumulative, at * self._cumulative[-1]), len(self._cumulative) - 1)
        element = self._order[chosen]
        starts = generator.integers(0, 2**32, 2, dtype=np.uint64)
        bits = (starts[:, None] + steps[:, None] * np.arange(count, dtype=np.uint64)) % 2**32
        u, v = bits / 2.0**32
        weights = np.stack(triangle_weights(u, v), axis=1)
        positions = np.einsum("nk,nkx->nx", weights, self._corners[element])
        barycentric = np.einsum("nk,nkb->nb", weights, self._weights[element])[:, 1:]
        areas = self._areas[element] / (count * self._probability[chosen])
        positions, normals, stretch = onto_round_shapes(positions, self._normals[element], self._round_rows[element])
        areas *= stretch
        return Vpls(
            positions,
            normals,
            self._shapes[element],
            self._primitives[element],
            barycentric,
            areas,
            areas / self._reach[element],
        )
