"""Mirror index: the flat mirrors that may reflect light of the lasers to a place, by cells of a grid over the scene.

Behind a small facet the light of a laser point goes on in a narrow cone from the point's image: of the 2,900 facets of
a bunny, a vertex has to try a dozen. docs/virtual-lights.md, 11.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from nlosrender.capture.grids import Capture
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.pose import Float64

LitSphere = tuple[Float64, float]  # centre (3,) and radius of a sphere around all points that are lit [engine units]

FEW = 16  # mirrors that are all tried everywhere: chosen, not measured
MAX_LEVEL = 6  # 64 cells along each axis; a bunny of 1 m has cells as wide as its facets
MAX_PAIRS = 2**22  # of a mirror and a cell, tested at once: 0.1 s, 80 MB
HALF_DIAGONAL = 0.867  # of a cube, over its edge
MARGIN = 1e-3  # of a cell, and of a mirror's radius: float32 rounds both by less


def lit_sphere(built: BuiltScene, capture: Capture) -> LitSphere:
    """Return a sphere around the laser points of a capture, and their spots."""
    points = capture.laser_grid.positions.reshape(-1, 3) / built.metres_per_engine_unit
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    return centre, radius + capture.laser_spot_radius / built.metres_per_engine_unit


@dataclass(frozen=True, eq=False)
class MirrorIndex:
    """Numbers of mirrors, cell by cell."""

    low: mi.Point3f  # corner of the grid
    cells_per_unit: mi.Float
    last: mi.Int32  # number of the last cell along an axis
    bounds: mi.UInt32  # where the mirrors of each cell begin, and the last ones end
    mirrors: mi.UInt32

    @classmethod
    def of_all(cls, n_mirrors: int) -> MirrorIndex:
        """Return the index whose only cell has all mirrors."""
        return cls._opaque(np.zeros(3), 0.0, 1, np.array([0, n_mirrors]), np.arange(max(n_mirrors, 1)))

    @classmethod
    def of(cls, built: BuiltScene, lasers: LitSphere | None, triangles: Float64) -> MirrorIndex:
        """Return the index of mirrors.

        Parameters
        ----------
        built
            The scene, all of whose vertices are looked up.
        lasers
            What is lit; None: nothing is known.
        triangles
            (n, 3, 3) around the mirrors, in their planes [engine units].
        """
        if lasers is None or len(triangles) <= FEW:
            return cls.of_all(len(triangles))
        beams = _Beams.of(lasers, triangles)
        box = built.scene.bbox()
        low, high = (np.ravel(np.asarray(corner, dtype=np.float64)) for corner in (box.min, box.max))
        level, size = 0, float((high - low).max())
        mirror, cell = dr.arange(mi.UInt32, len(triangles)), dr.zeros(mi.UInt32, len(triangles))
        while level < MAX_LEVEL and 8 * dr.width(mirror) <= MAX_PAIRS:
            level, size = level + 1, size / 2
            child = dr.arange(mi.UInt32, 8 * dr.width(mirror))
            mirror, cell = (dr.gather(mi.UInt32, array, child >> 3) for array in (mirror, cell))
            # 10 bits of each coordinate
            cell = (cell << 1) | (child & 1) | ((child & 2) << 9) | ((child & 4) << 18)
            x, y, z = _coordinates(cell)
            centre = mi.Point3f(low) + (mi.Vector3f(x, y, z) + 0.5) * size
            kept = dr.compress(beams.may_meet(mirror, centre, HALF_DIAGONAL * size))
            mirror, cell = (dr.gather(mi.UInt32, array, kept) for array in (mirror, cell))
            dr.eval(mirror, cell)
        side = 1 << level
        x, y, z = _coordinates(cell)
        cell = (z * side + y) * side + x
        ones, pairs = np.ones(dr.width(mirror), np.int8), (np.array(cell), np.array(mirror))
        lists = sparse.csr_matrix((ones, pairs), shape=(side**3, len(triangles)))
        return cls._opaque(low, 1 / size, side, lists.indptr, lists.indices)

    @classmethod
    def _opaque(cls, low: Float64, per_unit: float, side: int, bounds: np.ndarray, mirrors: np.ndarray) -> MirrorIndex:
        corner = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in low))
        lists = (on_device(mi.UInt32, array.astype(np.uint32)) for array in (bounds, mirrors))
        return cls(corner, dr.opaque(mi.Float, per_unit), dr.opaque(mi.Int32, side - 1), *lists)

    def near(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Return where the mirrors that may send light to points begin, and how many there are."""
        place = mi.Vector3i(dr.floor((point - self.low) * self.cells_per_unit))
        place = dr.clip(place, 0, self.last)
        side = self.last + 1
        cell = mi.UInt32((place.z * side + place.y) * side + place.x)
        begin, end = (dr.gather(mi.UInt32, self.bounds, cell + k, active) for k in range(2))
        return begin, end - begin

    def mirror(self, entry: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Return the number of a mirror."""
        return dr.gather(mi.UInt32, self.mirrors, entry, active)


def _coordinates(cell: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Return x, y and z of cells from ten bits each."""
    return cell & 1023, (cell >> 10) & 1023, cell >> 20


@dataclass(frozen=True, eq=False)
class _Beams:
    """Cones that hold the light of all lasers behind their mirrors."""

    rows: mi.Float  # twelve a mirror: apex, sine; axis, cosine; plane on the lasers' side

    @classmethod
    def of(cls, lasers: LitSphere, triangles: Float64) -> _Beams:
        """Return the cones of lines through the sphere around each mirror and the image of that around the lasers."""
        (lit, spread), middle = lasers, triangles.mean(axis=1)
        radius = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1) * (1 + MARGIN)
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offset = -np.einsum("nx,nx->n", normal, middle)
        height = normal @ lit + offset
        axis = middle - (lit - 2 * height[:, None] * normal)
        distance = np.linalg.norm(axis, axis=1)
        axis /= distance[:, None]
        sine = (radius + spread) / distance
        is_open = sine >= 1  # light may go anywhere: the cone is the whole space
        # lines through both spheres meet their common axis where the inner tangents do
        rows = np.zeros((len(triangles), 3, 4))
        rows[:, 0, :3] = middle - axis * (distance * radius / (radius + spread))[:, None]
        rows[:, 0, 3] = np.where(is_open, 2.0, sine)
        rows[:, 1, :3], rows[:, 1, 3] = axis, np.sqrt(1 - np.minimum(sine, 1) ** 2)
        side = np.where(np.abs(height) > spread, np.sign(height), 0.0)
        rows[:, 2, :3], rows[:, 2, 3] = normal * side[:, None], offset * side
        return cls(on_device(mi.Float, rows.ravel().astype(np.float32)))

    def may_meet(self, mirror: mi.UInt32, centre: mi.Point3f, radius: float) -> mi.Bool:
        """Return whether beams may meet spheres."""
        apex, axis, plane = (dr.gather(mi.Vector4f, self.rows, mirror * 3 + row) for row in range(3))
        away = centre - mi.Point3f(apex.x, apex.y, apex.z)
        direction, radius = mi.Vector3f(axis.x, axis.y, axis.z), radius * (1 + MARGIN)
        along = dr.dot(away, direction)
        across = dr.safe_sqrt(dr.squared_norm(away) - dr.square(along))
        is_before = dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), centre) + plane.w >= -radius
        return is_before & ((apex.w > 1) | (across * axis.w - along * apex.w <= radius))
