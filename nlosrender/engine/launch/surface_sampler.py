"""Hidden geometry sampling: points uniform by area on the hidden surfaces (Royo et al. 2022, section 4).

Triangles of all meshes lie in one table, analytic shapes follow them. Inversion of the integer cumulative distribution
by a guide table (Chen & Asau 1974) picks an entry; the remainder is rescaled and serves as coordinate within it, which
keeps low-discrepancy points low-discrepancy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.facing_triangles import facing_triangles, is_one_sided
from nlosrender.engine.launch.morton import morton_order
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.loading.number_of_shape import pointer_index
from nlosrender.scene.triangle_point import triangle_weights

SAMPLEABLE_PLUGINS = ("Rectangle", "Disk", "Sphere", "Cylinder")
_FULL = 2.0**32
MAX_GUIDE_BITS = 22  # 16 MB; more than two parts per entry up to 2^21 entries, so that a search takes about one step
ANALYTIC = 0xFFFFFFFF  # primitive of a point that lies on no triangle


@dataclass(eq=False)
class SurfaceSample:
    """A point on the hidden geometry, one per lane; not frozen, for it may be state of a loop."""

    p: mi.Point3f
    shape: mi.ShapePtr
    n: mi.Normal3f  # geometric normal; on triangles not of unit length
    primitive: mi.UInt32  # triangle within the shape; ANALYTIC for a shape without triangles
    barycentric: mi.Point2f  # within the triangle


class SurfaceSampler:
    """Samples points of the hidden geometry uniformly by area.

    Triangles that no point of the wall can see from their reflecting side are left out: they return no light.

    Parameters
    ----------
    built
        The scene. Shapes of other kinds than meshes, rectangles, disks, spheres and cylinders are not sampled.
    """

    def __init__(self, built: BuiltScene):
        self._built = built
        hidden = built.sampled_shapes
        self._analytic = [shape for shape in hidden if not shape.is_mesh() and shape.class_name() in SAMPLEABLE_PLUGINS]
        self.has_analytic = bool(self._analytic)
        self.covers_everything = all(shape.is_mesh() or shape.class_name() in SAMPLEABLE_PLUGINS for shape in hidden)
        # No surface reflects at points whose geometric normal points away. Shading normals may light a little there.
        self.dark_behind = all(
            is_one_sided(shape) and not (shape.is_mesh() and shape.has_vertex_normals()) for shape in hidden
        )

    @cached_property
    def _table(self) -> _Table:
        """Made on first use: a gather alone does not need it, and it takes a second per million triangles."""
        return _Table.of(self._built)

    def set_up(self) -> None:
        """Make the table: it cannot be made while a loop that samples is recorded."""
        _ = self._table

    @property
    def n_triangles(self) -> int:
        """Triangles that are sampled."""
        return self._table.n_triangles

    @property
    def area(self) -> float:
        """Area of all surfaces that are sampled [engine units squared]."""
        return self._table.area

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to sample."""
        return self.area <= 0

    def sample(self, bits: mi.UInt32, v: mi.Float, active: mi.Bool) -> SurfaceSample:
        """Sample a point with density 1 / ``area`` over the sampled surfaces.

        Parameters
        ----------
        bits
            Uniform 32-bit integers: choose the entry, the remainder serves as first coordinate in it.
        v
            Uniform numbers in [0, 1): second coordinate.
        active
            Lanes that need a sample.
        """
        table, entry = self._table, self._entry(bits, active)
        low = dr.gather(mi.UInt32, table.edges, entry, active)
        high = dr.gather(mi.UInt32, table.edges, entry + 1, active)
        u = dr.minimum(
            (mi.Float(bits - low) + 0.5) / dr.maximum(mi.Float(high - low), 1.0), dr.one_minus_epsilon(mi.Float)
        )
        shape_index = dr.gather(mi.UInt32, table.shape_index, entry, active)
        shape = dr.gather(mi.ShapePtr, self._built.scene.shapes_dr(), shape_index, active)
        is_triangle = entry < self.n_triangles
        point, normal, primitive = mi.Point3f(0), mi.Normal3f(0), mi.UInt32(ANALYTIC)
        within = mi.Point2f(0)
        if self.n_triangles:
            on_triangle = active & is_triangle
            a, b, c = (self._corner(k, entry, on_triangle) for k in range(3))
            within = mi.Point2f(*triangle_weights(u, v, dr.sqrt)[1:])
            point = a + (b - a) * within.x + (c - a) * within.y
            normal = mi.Normal3f(dr.cross(b - a, c - a))
            primitive = dr.select(on_triangle, dr.gather(mi.UInt32, table.primitive, entry, on_triangle), ANALYTIC)
        if self.has_analytic:
            on_analytic = active & ~is_triangle
            at, facing = self._on_analytic(entry, mi.Point2f(u, v), on_analytic)
            point, normal = dr.select(on_analytic, at, point), dr.select(on_analytic, facing, normal)
        return SurfaceSample(point, shape, normal, primitive, within)

    @dr.syntax
    def _entry(self, bits: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Return the entry that covers the integers ``bits``: binary search between two entries of the guide table."""
        table = self._table
        part = bits >> (32 - table.guide_bits)
        low = dr.gather(mi.UInt32, table.guide, part, active)
        high = dr.gather(mi.UInt32, table.guide, part + 1, active)
        while dr.hint(active & (low < high), exclude=[table, bits, active]):
            middle = (low + high) >> 1
            is_beyond = dr.gather(mi.UInt32, table.edges, middle + 1, active) <= bits
            low = dr.select(is_beyond, middle + 1, low)
            high = dr.select(is_beyond, high, middle)
        return low

    def surface(
        self, sample: SurfaceSample, direction: mi.Vector3f, active: mi.Bool, is_plain_diffuse: bool = False
    ) -> mi.SurfaceInteraction3f:
        """Return the surface at sampled points of triangles as a ray in ``direction`` finds it; no ray is traced.

        ``is_plain_diffuse``: its frame is any around the normal.
        """
        if is_plain_diffuse:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.n = dr.normalize(sample.n)
            si.sh_frame = mi.Frame3f(si.n)
            si.t, si.shape, si.p = mi.Float(1), sample.shape, sample.p
            si.prim_index = sample.primitive
            si.wi = si.to_local(-direction)
            return si
        hit = dr.zeros(mi.PreliminaryIntersection3f)
        hit.t = mi.Float(1)
        hit.prim_uv, hit.prim_index = sample.barycentric, sample.primitive
        ray = mi.Ray3f(sample.p - direction, direction)
        si = sample.shape.compute_surface_interaction(ray, hit, mi.RayFlags.All, active)
        si.initialize_sh_frame()
        si.t, si.shape, si.p = mi.Float(1), sample.shape, sample.p
        si.wi = si.to_local(-direction)
        return si

    def reached(
        self, si: mi.SurfaceInteraction3f, point: mi.Point3f, shape: mi.ShapePtr, primitive: mi.UInt32
    ) -> mi.Bool:
        """Return whether a ray sent to a sampled point arrived at it, instead of at something in front of it.

        A straight line meets a triangle once, so there the primitive decides; a curved shape has a near side.
        """
        near = dr.squared_norm(si.p - point) < 1e-6 * (1e-6 + dr.square(si.t))
        same = si.shape == shape
        if not self.has_analytic:
            return same & (si.prim_index == primitive)
        return same & dr.select(primitive == ANALYTIC, near, si.prim_index == primitive)

    def covers(self, si: mi.SurfaceInteraction3f, on_wall: mi.Bool) -> mi.Bool:
        """Return whether the density of ``sample`` at ``si`` is 1 / ``area`` (hidden, of a sampled kind)."""
        hidden = si.is_valid() & ~on_wall
        if self.covers_everything:
            return hidden
        sampled = mi.Bool(False)
        for name in ("Mesh", *SAMPLEABLE_PLUGINS):
            sampled |= si.shape.shape_type() == int(getattr(mi.ShapeType, name))
        return hidden & sampled

    def _on_analytic(self, entry: mi.UInt32, uv: mi.Point2f, active: mi.Bool) -> tuple[mi.Point3f, mi.Normal3f]:
        """Return points uniform by area on analytic shapes, and the normals there."""
        # Not through a ShapePtr: such a call is compiled for every shape that the process holds, those of a program's
        # own scenes too, and kinds that cannot be sampled have no sample_position.
        methods = [own.sample_position for own in self._analytic]
        sample = dr.switch(entry - self.n_triangles, methods, mi.Float(0), uv, active)
        return sample.p, sample.n

    def _corner(self, k: int, entry: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        return mi.Point3f(*(dr.gather(mi.Float, self._table.corners[3 * k + j], entry, active) for j in range(3)))


@dataclass(frozen=True, eq=False)
class _Table:
    """Entries of what is sampled: triangles, then analytic shapes; the arrays are made for entries only."""

    n_triangles: int
    area: float  # engine units squared
    edges: mi.UInt32  # entry i covers the integers [edges[i], edges[i + 1]); the last one also takes 2^32 - 1
    guide_bits: int
    guide: mi.UInt32  # guide table (Chen & Asau 1974): entry at the start of each of 2^guide_bits equal parts
    shape_index: mi.UInt32  # of each entry, in the scene
    primitive: mi.UInt32  # of each triangle within its shape
    corners: list[mi.Float]  # nine, of the triangles

    @classmethod
    def of(cls, built: BuiltScene) -> _Table:
        """Return the table of a scene."""
        corners = [np.zeros((0, 3, 3))]
        shape_indices, primitives, analytic_areas = [np.zeros(0, np.uint32)], [np.zeros(0, np.uint32)], [np.zeros(0)]
        analytic_indices: list[int] = []
        sampled = set(map(pointer_index, built.sampled_shapes))
        for index, shape in enumerate(built.scene.shapes()):
            if pointer_index(shape) not in sampled:
                continue
            if shape.is_mesh():
                triangles, numbers = facing_triangles(built, shape)
                # neighbours in the table are neighbours in space: so are points with near first coordinates
                order = np.argsort(morton_order(triangles.mean(axis=1)), kind="stable")
                corners.append(triangles[order])
                shape_indices.append(np.full(len(numbers), index, np.uint32))
                primitives.append(numbers[order])
            elif shape.class_name() in SAMPLEABLE_PLUGINS:
                analytic_indices.append(index)
                analytic_areas.append(np.ravel(shape.surface_area())[:1].astype(np.float64))
        triangles = np.concatenate(corners)
        areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1)
        areas = np.concatenate([areas / 2, *analytic_areas])
        area = float(areas.sum())
        cumulative = np.minimum(np.rint(np.cumsum(areas) / max(area, 1e-300) * _FULL), _FULL - 1)
        guide_bits = min(max((len(areas) - 1).bit_length() + 1, 1), MAX_GUIDE_BITS)
        parts = np.arange(2**guide_bits, dtype=np.uint64) << np.uint64(32 - guide_bits)
        guide = np.append(np.searchsorted(cumulative[:-1], parts, side="right"), len(areas) - 1)
        table = cls(
            len(triangles),
            area,
            mi.UInt32(np.concatenate([[0], cumulative]).astype(np.uint32)),
            guide_bits,
            on_device(mi.UInt32, guide),
            mi.UInt32(np.concatenate([*shape_indices, np.array(analytic_indices, np.uint32)])),
            mi.UInt32(np.concatenate(primitives)),
            [mi.Float(triangles[:, i, j].astype(np.float32)) for i in range(3) for j in range(3)],
        )
        dr.eval(table.edges, table.shape_index)
        return table
