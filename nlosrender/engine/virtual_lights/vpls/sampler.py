"""Virtual point lights (VPLs): random points of the hidden geometry whose light the sensor points gather.

The probability of an element goes with its area and with the root mean square, over some sensor points, of what they
receive of it: the density that minimises the L2 error over all of them. A part of the VPLs goes with the area over
d (d + R) instead, d its distance from the nearest sensor or laser point and R half the extent of the sensor grid: that
bounds what a single sensor point receives of one. docs/virtual-lights.md, 7.2 and 7.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import columns, on_device
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.pilot_points import spread
from nlosrender.engine.launch.sequences import recurrence_steps
from nlosrender.engine.launch.time_gate import CaptureTimeGate
from nlosrender.engine.virtual_lights.elements.patches import SurfacePoints
from nlosrender.engine.virtual_lights.elements.round_shapes import onto_round_shapes
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, wall_elements
from nlosrender.engine.virtual_lights.elements.surface_distance import SurfaceDistance
from nlosrender.engine.virtual_lights.elements.triangles import longest_edges, normals_and_areas
from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_point import triangle_weights

if TYPE_CHECKING:
    from nlosrender.engine.launch.flat_mirrors import FlatMirrors
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator

# Barycentric coordinates of a triangle's centroid, and of the points between it and the corners.
GATE_POINTS = np.concatenate([np.full((1, 3), 1 / 3), np.full((3, 3), 1 / 6) + np.eye(3) / 2])


@dataclass(frozen=True, eq=False)
class Vpls(SurfacePoints):
    """VPLs, sorted along the elements they lie on."""

    areas: Float64  # (n,) area that a VPL stands for: the reciprocal of n times its density
    importance: Float64  # (n,) area times the density of its element without a time gate, see above


class VplSampler:
    """Draws VPLs on the elements of a scene; few on those beyond ``capture_gate``, if there is one.

    On a planar wall, too, where a ``mirror`` shows it to its own points.
    """

    def __init__(
        self,
        tessellator: Tessellator,
        capture_gate: CaptureTimeGate | None = None,
        mirror: FlatMirrors | None = None,
    ):
        elements, on_round = tessellator.elements, tessellator.round_elements()
        round_patches = [patches for _, patches in on_round]
        round_rows = [np.tile(shape.row, (len(patches), 1)) for shape, patches in on_round]
        on_wall = Elements.none()
        if mirror is not None and mirror.shows_wall(tessellator.built):
            on_wall = wall_elements(tessellator.built)
        flat = Elements.joined([elements, on_wall])
        self._corners = np.concatenate([flat.corners, *(patches.corners for patches in round_patches)])
        self._weights = np.concatenate([flat.weights, *(np.zeros((len(part), 3, 3)) for part in round_patches)])
        self._shapes = np.concatenate([flat.shapes, *(patches.shapes for patches in round_patches)])
        self._primitives = np.concatenate([flat.primitives, *(patches.primitives for patches in round_patches)])
        self._round_rows = np.concatenate([np.zeros((len(flat), 7)), *round_rows])
        self._normals, self._areas = normals_and_areas(self._corners)
        centres = self._corners.mean(axis=1)
        if mirror is not None and len(on_wall):
            seen = slice(len(elements), len(flat))
            centres[seen] = mirror.images(centres[seen])
        # an element is no longer than its distance; half its size stands for the distance where it touches a point
        distances = tessellator.distance(centres)
        if isinstance(tessellator.distance, SurfaceDistance):  # from points that may see them
            of_round = (tessellator.distance.apart(part.centres, shape.index) for shape, part in on_round)
            distances = np.concatenate([flat.distances, *of_round])
        distances = np.maximum(distances, longest_edges(self._corners) / 2)
        self._density = self._densities(tessellator, centres, 1 / (distances * (distances + tessellator.reach)))
        order = np.lexsort((morton_order(centres), self._shapes))  # shape by shape, neighbours together
        importance = (self._areas * self._density)[order]
        if capture_gate is not None:
            importance *= 1 - (1 - capture_gate.survival) * self._late_shares(capture_gate)[order]
        self._order = order
        self.is_empty = not importance.sum() > 0
        if not self.is_empty:
            self._probability = importance / importance.sum()
            self._cumulative = np.cumsum(self._probability)

    def _densities(self, tessellator: Tessellator, centres: Float64, nearness: Float64) -> Float64:
        """Return the density of elements at ``centres`` without a time gate; ``nearness``: 1 / (d (d + R))."""
        if not len(centres):  # no surface may be seen
            return nearness
        grid, tuning = tessellator.capture.sensor_grid, tessellator.tuning
        some = list(spread(grid, tuning.density_sensors_per_axis).indices)
        sensors = grid.positions.reshape(-1, 3)[some] / tessellator.built.metres_per_engine_unit
        place = mi.Point3f(*columns(centres)), mi.Normal3f(*columns(self._normals))
        least = on_device(mi.Float, np.square(longest_edges(self._corners) / 2))
        points = mi.Point3f(*columns(sensors)), mi.Normal3f(*columns(grid.normals.reshape(-1, 3)[some]))
        squares = _squared_responses(*place, least, *points, dr.opaque(mi.UInt32, len(some)))
        response = np.sqrt(squares.numpy().astype(np.float64))
        near_share = tuning.nearness_share if response.any() else 1.0
        totals = (max(float(density @ self._areas), 1e-300) for density in (nearness, response))
        return near_share * nearness / next(totals) + (1 - near_share) * response / next(totals)

    def _late_shares(self, capture_gate: CaptureTimeGate) -> Float64:
        """Return the part of each element beyond ``capture_gate``, by a few of its points: any value is unbiased."""
        points = (np.einsum("k,nkx->nx", weights, self._corners) for weights in GATE_POINTS)
        return np.mean([capture_gate.is_past(point) for point in points], axis=0)

    def sample(self, count: int, generator: np.random.Generator) -> Vpls:
        """Draw ``count`` VPLs, stratified: one in each of as many equal parts of the elements' measure.

        The points within elements are a low-discrepancy sequence, shifted by ``generator``.
        """
        position = (np.arange(count) + generator.random(count)) / count
        chosen = np.searchsorted(self._cumulative, position * self._cumulative[-1])
        chosen = np.minimum(chosen, len(self._cumulative) - 1)
        element = self._order[chosen]
        starts = generator.integers(0, 2**32, 2, dtype=np.uint64)
        steps = np.array(recurrence_steps(2), dtype=np.uint64)
        u, v = (starts[:, None] + steps[:, None] * np.arange(count, dtype=np.uint64)) % 2**32 / 2.0**32
        weights = np.stack(triangle_weights(u, v), axis=1)
        positions = np.einsum("nk,nkx->nx", weights, self._corners[element])
        positions, normals, stretch = onto_round_shapes(positions, self._normals[element], self._round_rows[element])
        areas = self._areas[element] / (count * self._probability[chosen]) * stretch
        return Vpls(
            positions=positions,
            normals=normals,
            shapes=self._shapes[element],
            primitives=self._primitives[element],
            barycentric=np.einsum("nk,nkb->nb", weights, self._weights[element])[:, 1:],
            areas=areas,
            importance=areas * self._density[element],
        )


@dr.syntax
def _squared_responses(
    centres: mi.Point3f,
    normals: mi.Normal3f,
    least: mi.Float,
    sensors: mi.Point3f,
    facing: mi.Normal3f,
    count: mi.UInt32,
) -> mi.Float:
    """Return the summed squares of both cosines over the squared distance, or ``least``; 0 behind a sensor point."""
    number, total = mi.UInt32(0), mi.Float(0)
    while dr.hint(number < count, exclude=[centres, normals, least, sensors, facing, count]):
        away = centres - dr.gather(mi.Point3f, sensors, number)
        distance2 = dr.maximum(dr.squared_norm(away), least)
        cosines = dr.maximum(dr.dot(away, dr.gather(mi.Normal3f, facing, number)), 0) * dr.dot(away, normals)
        total += dr.square(cosines / dr.square(distance2))
        number += 1
    return total
