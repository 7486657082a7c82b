"""Patches on the device: where they are, what they reflect, and the points that stand for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import columns, on_device
from nlosrender.engine.launch.morton import morton_order
from nlosrender.engine.launch.plain_diffuse import is_uniform_diffuse
from nlosrender.engine.launch.recurrence import recurrence_steps
from nlosrender.engine.path.laser_connections import off_the_surface
from nlosrender.engine.virtual_lights.elements.patches import Patches, split_weights
from nlosrender.engine.virtual_lights.elements.round_shapes import RoundShape
from nlosrender.engine.virtual_lights.visibility.masks import Surface
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.loading.round_surfaces import ROUND_PLUGINS
from nlosrender.scene.pose import Float64
from nlosrender.scene.triangle_point import triangle_weights

# A textured patch is cut into this many squared parts, a random point of each is looked up: 16 of many, 144 of few.
TEXTURE_SPLITS, FEW_PATCHES = (4, 12), 2**14


@dataclass(frozen=True, eq=False)
class PatchRegions:
    """Where patches belong: which region they are of, and their numbers in it."""

    regions: NDArray[np.int64]  # (n,) region of each patch, ascending
    numbers: NDArray[np.int64]  # (n,) of each patch within its region

    @classmethod
    def of(cls, counts: Sequence[int]) -> PatchRegions:
        """Return the places of ``counts`` patches per region, region after region."""
        regions = np.repeat(np.arange(len(counts)), counts)
        return cls(regions, np.concatenate([np.arange(count) for count in counts]))

    def in_parts(self, patch: NDArray[np.integer], slices: int) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Sort patches by part, within it by number; return them and where each part begins, and the last one ends.

        Parts are gathered by lanes of their own: each is one of so many slices of a region. A patch's number within
        its region decides its slice, so what one laser sends does not depend on the batch's other lasers, whose
        patches may be others.
        """
        part = (self.regions * slices + self.numbers % slices)[patch]
        order = np.lexsort((patch, part))
        n_parts = (int(self.regions[-1]) + 1) * slices
        return patch[order], np.searchsorted(part[order], np.arange(n_parts + 1))


@dataclass(frozen=True, eq=False)
class Curvature:
    """The sphere or cylinder that each patch lies on."""

    centre: mi.Vector3f  # from the patch's centre to that of a sphere, or to a point of a cylinder's axis
    radius: mi.Float  # 0 for flat patches
    axis: mi.Vector3f  # unit axis of a cylinder, 0 for a sphere

    @classmethod
    def of(cls, built: BuiltScene, patches: Patches) -> Curvature | None:
        """Return what patches lie on; None where all are flat."""
        rows = np.zeros((len(built.scene.shapes()), 7))
        for index, shape in enumerate(built.scene.shapes()):
            if shape.class_name() in ROUND_PLUGINS:
                rows[index] = RoundShape.of(index, shape).row
        if not rows.any():
            return None
        rows = rows[patches.shapes]
        centre, axis = mi.Vector3f(to_points(rows[:, :3] - patches.centres)), mi.Vector3f(to_points(rows[:, 4:]))
        return cls(centre, on_device(mi.Float, np.abs(rows[:, 3])), axis)

    def onto_surface(self, points: mi.Vector3f) -> mi.Vector3f:
        """Return points, relative to the patches' centres, brought onto the surface along its normal."""
        outward = self._outward(points)
        distance = dr.norm(outward)
        return dr.select(self.radius > 0, points + outward * ((self.radius - distance) / distance), points)

    def turned(self, along: mi.Vector3f, points: mi.Vector3f) -> mi.Vector3f:
        """Return vectors along the normals of patches turned along the normals at points of them."""
        normal = dr.normalize(self._outward(points))
        return dr.select(self.radius > 0, normal * dr.mulsign(dr.norm(along), dr.dot(normal, along)), along)

    def _outward(self, points: mi.Vector3f) -> mi.Vector3f:
        outward = points - self.centre
        return outward - dr.dot(outward, self.axis) * self.axis


@dataclass(frozen=True, eq=False)
class DevicePatches:
    """Patches on the device, engine units; one lane per patch."""

    places: PatchRegions
    number: mi.UInt32  # within its region: with the start, what decides the points its light is asked for
    start: mi.Vector2u  # of the low-discrepancy sequence of these points
    rounding_residual: mi.Vector3f  # float64 centre minus float32 centre: counts close to the wall
    is_near: bool  # some patch is so near to a laser or sensor point that the remainder counts
    corners: list[mi.Vector3f]  # three, from the centre
    curvature: Curvature | None  # None: all are flat
    members: mi.Vector4f  # from the centre to where shadow rays of clusters end, and 1 for a cluster, else 0
    has_clusters: bool
    areas: mi.Vector3f  # geometric normal times area
    interaction: mi.SurfaceInteraction3f  # at the centres
    reflectance: mi.Spectrum  # of Lambertian patches
    member_normals: mi.Vector3f  # geometric, where shadow rays end
    offset: mi.Vector3f  # ray offset there, see ``off_the_surface``; on curved patches in the middle

    def points(self, index: mi.UInt32) -> mi.Vector3f:
        """Return points of the surface, one per patch, from the centres' float32 positions: where rays end.

        ``index`` chooses a low-discrepancy point of a patch. That of a cluster is its member's, whichever.
        """
        u, v = spread_numbers(self.start, index)
        inside = point_inside(self.corners, u, v)
        if self.curvature is not None:
            inside = self.curvature.onto_surface(inside)
        return self.rounding_residual + dr.select(self.members.w > 0, self.members.xyz, inside)

    def offset_at(self, points: mi.Vector3f) -> mi.Vector3f:
        """Return the ray offset along the normal at ``points``, as ``points`` returns them.

        On a curved patch a ray that grazes it may come from behind its middle's normal.
        """
        return self.offset if self.curvature is None else self.curvature.turned(self.offset, points)

    def surface(self, points: mi.Vector3f) -> Surface:
        """Return the surface at ``points``, as ``points`` returns them: what may hide it from the wall."""
        interaction = self.interaction
        others = dr.select(self.members.w > 0, self.member_normals, mi.Vector3f(interaction.sh_frame.n))
        return Surface(mi.Point3f(interaction.p + points), mi.Vector3f(interaction.n), others)


def upload_patches(
    built: BuiltScene, patches: Patches, places: PatchRegions, seed: int, is_near: bool
) -> DevicePatches:
    """Bring patches to the device, neighbours together, and evaluate their reflectance and shading frames.

    Parameters
    ----------
    built, patches
        The scene and what it was cut into, region after region.
    places
        Region of each patch, and its number there.
    seed
        Of the points that stand for their patches where visibility is asked for. A point at random makes a partly
        hidden patch count by its visible share, on average; one for all sensor points keeps their rays together.
    is_near
        Whether some patch is so near to a laser or sensor point that float32 positions do not do.
    """
    patches = patches.at(np.lexsort((morton_order(patches.centres), places.regions)))
    interaction = surface_at(
        built, patches.centres, patches.normals, patches.shapes, patches.primitives, patches.barycentric
    )
    reflectance = _mean_reflectance(built, patches, normal_reflectance(interaction))
    centre = np.array(interaction.p, np.float64).T
    from_rounded = patches.centres - centre
    rounding_residual = mi.Vector3f(to_points(from_rounded))
    corners = [mi.Vector3f(to_points(patches.corners[:, k] - patches.centres)) for k in range(3)]
    areas = mi.Vector3f(to_points(patches.normals * patches.areas[:, None]))
    curvature = Curvature.of(built, patches)
    offset = off_the_surface(built, patches.members, patches.member_normals, patches.shapes) - patches.members
    is_cluster = on_device(mi.Float, patches.is_cluster)
    members = mi.Vector4f(*to_points(patches.members - patches.centres), is_cluster)
    # a cluster's members have normals of their own: it is lit and seen by their mean
    frame, own = interaction.sh_frame, mi.Frame3f(mi.Normal3f(interaction.n))
    interaction.sh_frame = dr.select(members.w > 0, own, frame)
    number, start = on_device(mi.UInt32, places.numbers), mi.Vector2u(*mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(0)))
    dr.make_opaque(start)
    member_normals = mi.Vector3f(to_points(patches.member_normals))
    offset = mi.Vector3f(to_points(offset))
    dr.eval(interaction, reflectance, rounding_residual, corners, areas, curvature, members, member_normals, offset)
    has_clusters = bool(patches.is_cluster.any())
    return DevicePatches(
        places,
        number,
        start,
        rounding_residual,
        is_near,
        corners,
        curvature,
        members,
        has_clusters,
        areas,
        interaction,
        reflectance,
        member_normals,
        offset,
    )


def surface_at(
    built: BuiltScene,
    positions: Float64,
    normals: Float64,
    shapes: NDArray[np.uint32],
    primitives: NDArray[np.uint32],
    barycentric: Float64,
) -> mi.SurfaceInteraction3f:
    """Return the surface at known points, as a ray from one unit above would find it; no ray is traced.

    Parameters
    ----------
    built
        The scene.
    positions, normals
        (n, 3) points [engine units] and geometric normals.
    shapes, primitives
        (n,) index into the scene's shapes; triangle of a mesh.
    barycentric
        (n, 2) coordinates within the triangle.
    """
    point, normal = to_points(positions), mi.Vector3f(to_points(normals))
    hit = dr.zeros(mi.PreliminaryIntersection3f, len(positions))
    hit.t = dr.full(mi.Float, 1.0, len(positions))
    hit.prim_uv = mi.Point2f(*columns(barycentric))
    hit.prim_index = on_device(mi.UInt32, primitives)
    shape = dr.gather(mi.ShapePtr, built.scene.shapes_dr(), on_device(mi.UInt32, shapes))
    interaction = shape.compute_surface_interaction(mi.Ray3f(point + normal, -normal), hit, mi.RayFlags.All)
    interaction.initialize_sh_frame()
    interaction.shape = shape
    interaction.p = point
    interaction.n = mi.Normal3f(normal)
    interaction.wi = mi.Vector3f(0, 0, 1)
    return interaction


def _mean_reflectance(built: BuiltScene, patches: Patches, reflectance: mi.Spectrum) -> mi.Spectrum:
    """Return the reflectance of patches, averaged over random points of each where some surface has a texture.

    That of the centre alone, ``reflectance``, takes a texture finer than the patches for one of other colours at every
    resolution, and the difference of two resolutions, the stated error, for noise.
    """
    shapes = built.scene.shapes()
    textured = np.array([_has_texture(shape.bsdf()) for shape in shapes])[patches.shapes]
    chosen = np.flatnonzero(textured & ~patches.is_cluster)
    if not len(chosen):
        return reflectance
    some, random = patches.at(chosen), np.random.default_rng(len(patches))
    parts = split_weights(TEXTURE_SPLITS[0 if len(chosen) > FEW_PATCHES else 1])
    total = mi.Spectrum(0)
    for part in parts:
        weights = np.stack(triangle_weights(random.random(len(chosen)), random.random(len(chosen))), axis=1) @ part
        positions = np.einsum("nk,nkx->nx", weights, some.corners)
        barycentric = np.einsum("nk,nkx->nx", weights, some.corner_barycentric)
        total += normal_reflectance(
            surface_at(built, positions, some.normals, some.shapes, some.primitives, barycentric)
        )
        dr.eval(total)
    dr.scatter(reflectance, total / len(parts), on_device(mi.UInt32, chosen))
    return reflectance


def _has_texture(bsdf: mi.BSDF) -> bool:
    return bsdf.class_name() == "SmoothDiffuse" and not is_uniform_diffuse(bsdf)


def normal_reflectance(interaction: mi.SurfaceInteraction3f) -> mi.Spectrum:
    """Return pi times the BSDF along the normal: the reflectance of a Lambertian surface."""
    up = mi.Vector3f(0, 0, 1)
    return interaction.bsdf().eval(mi.BSDFContext(), interaction, up) * dr.pi


def point_inside(corners: list[mi.Vector3f], u: mi.Float, v: mi.Float) -> mi.Vector3f:
    """Return the point of a triangle that two uniform numbers choose, uniform by area."""
    _, at_b, at_c = triangle_weights(u, v, dr.sqrt)
    a, b, c = corners
    return a + (b - a) * at_b + (c - a) * at_c


def spread_numbers(start: mi.Vector2u, index: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return two low-discrepancy numbers in [0, 1) per index."""
    steps = recurrence_steps(2)
    u, v = (mi.Float((start[k] + index * mi.UInt32(steps[k])) >> 8) * 2.0**-24 for k in range(2))
    return u, v


def to_points(values: Float64) -> mi.Point3f:
    """Bring vectors (n, 3) to the device."""
    return mi.Point3f(*columns(values))
