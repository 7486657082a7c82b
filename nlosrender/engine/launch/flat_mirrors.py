"""Flat mirrors: facets with a delta reflection lobe send the light of a laser point on as if it came from its image.

Facets that lie in one plane and share edges are one mirror. For a mirror, a point s and a laser point l the point of
reflection is where the segment from s to the image of l meets the plane; a ray decides whether a facet of the mirror
is there and seen, so that an edge counts once (docs/virtual-lights.md, 11).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.facing_triangles import facing_triangles
from nlosrender.engine.launch.mirror_index import LitSphere, MirrorIndex
from nlosrender.engine.launch.ray_offsets import offset_origin, ray_offset
from nlosrender.scene.build import BuiltScene, wall_box
from nlosrender.scene.loading.number_of_shape import NO_NUMBER, NumberOfShape
from nlosrender.scene.pose import Float64

FLAT_PLUGINS = ("Rectangle", "Disk")
COPLANAR = 1e-5  # radians between neighbouring facets of one mirror: float32 vertices tilt those of a plane by less
# What float32 rounds a point of reflection by, over 1 + the largest coordinate [engine units]: the quick test goes so
# far beyond a mirror's edges. Points so near to an edge between two mirrors may count for both, or for none.
ROUNDING = 3e-7
MIN_HEIGHT = 1e-7  # engine units: points nearer to a mirror's plane lie in it as far as float32 knows
NUDGE = 5e-7  # as ROUNDING: how far beside a point on an edge a ray is sent; a plate's edges are met at a tenth of it
TRIES = 6  # rays at most: about the point at angles of 1 to 5 radians, which are along one edge and no other
ROWS = 3  # of four numbers each, aligned loads: what the quick test reads of a mirror


def components_of(bits: int) -> tuple[int, ...]:
    """Return the numbers of the BSDF components whose bits are set, lowest first."""
    return tuple(k for k in range(32) if bits >> k & 1)


@dataclass(frozen=True, eq=False)
class PlainMirror:
    """An untextured mirror that is a triangle or a full rectangle: bounds replace the ray that looks for a facet."""

    limit: float  # of either coordinate
    front: float  # 1, or -1 where the plane's normal points to the back
    bsdf: mi.BSDF
    lobes: tuple[int, int]  # components, as bits, of front and back

    @classmethod
    def of(cls, shape: mi.Shape, triangles: Float64, around: Float64) -> PlainMirror | None:
        """Return a mirror of ``triangles`` (n, 3, 3) with a triangle (3, 3) around it; None: it is not plain."""
        parts = mi.traverse(shape.bsdf()).hierarchy
        has_picture = any(isinstance(part, mi.Texture) and part.is_spatially_varying() for part in parts)
        sizes = np.linalg.norm(np.cross(*np.moveaxis(np.diff(triangles, axis=1), 1, 0)), axis=1)
        normal = np.cross(around[1] - around[0], around[2] - around[0])
        share = sizes.sum() / np.linalg.norm(normal)
        limit = 1.0 if len(triangles) == 1 else 0.5
        if has_picture or shape.class_name() == "Disk" or abs(share - limit) > COPLANAR:
            return None
        outer = np.ravel(shape.sample_position(0.0, mi.Point2f(0.5)).n)
        return cls(limit, float(np.sign(normal @ outer)), shape.bsdf(), delta_lobes(shape.bsdf()))

    def share(self, cosine: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Return the share of light that is reflected, by the cosine of incidence, negative on the plane's back."""
        si, result = dr.zeros(mi.SurfaceInteraction3f), mi.Spectrum(0)
        cosine = cosine * self.front
        si.wi = mi.Vector3f(dr.safe_sqrt(1 - dr.square(cosine)), 0, cosine)
        for bits, is_side in zip(self.lobes, (cosine > 0, cosine < 0), strict=True):
            for component in components_of(bits):
                context = mi.BSDFContext()
                context.component = component
                _, value = self.bsdf.sample(context, si, 0.5, mi.Point2f(0.5), active & is_side)
                result += dr.select(is_side, value, 0)
        return result


@dataclass(frozen=True, eq=False)
class FlatMirrors:
    """The flat mirrors of a scene on the device."""

    n_mirrors: int
    index: MirrorIndex
    # 12 a mirror: its plane (n, d) with n . x + d = 0, and two coordinates in it, affine maps (w, w0) of points: the
    # mirror lies where both are at least 0, and their sum is at most 1
    packed: mi.Float
    lobes: mi.UInt32  # two a mirror: bits of the delta reflection components of its BSDF on the front and on the back
    components: tuple[int, ...]  # that any of them has
    first_facet: NumberOfShape  # where the facets of a shape begin in ``mirror_of``
    mirror_of: mi.UInt32  # mirror of each facet; NO_NUMBER for those that no point of the wall sees
    plain: PlainMirror | None  # of the only one

    def is_alone(self, built: BuiltScene) -> bool:
        """Return whether a flat mirror without diffuse part has the only delta lobes: no path meets two in a row."""
        lobes = [shape.bsdf().flags() for shape in built.scene.shapes()]
        smooth = [flags for flags in lobes if flags & mi.BSDFFlags.Delta]
        is_whole = len(smooth) == 1 and not smooth[0] & (
            mi.BSDFFlags.Smooth | mi.BSDFFlags.Null | mi.BSDFFlags.DeltaTransmission
        )
        return is_whole and self.n_mirrors == 1 and not (np.array(self.mirror_of) == NO_NUMBER).any()

    def shows_wall(self, built: BuiltScene) -> bool:
        """Return whether part of a planar wall may see the wall in the only mirror: its image lies before the wall."""
        plane = np.array(self.packed, np.float64)[:4]
        heights = wall_box(built.wall) / built.metres_per_engine_unit @ plane[:3] + plane[3]
        return built.wall.is_planar and bool((heights * plane[2] < -MIN_HEIGHT).any())

    def images(self, points: Float64) -> Float64:
        """Return the images of points (n, 3) in the only mirror."""
        plane = np.array(self.packed, np.float64)[:4]
        return points - 2 * (points @ plane[:3] + plane[3])[:, None] * plane[:3]

    @classmethod
    def of(cls, built: BuiltScene, lasers: LitSphere | None) -> FlatMirrors:
        """Return the flat mirrors of a scene, indexed for light of ``lasers``; with polarised light there are none."""
        corners, facets, lobes = [np.zeros((0, 3, 3))], [np.zeros(0, np.uint32)], [np.zeros((0, 2), np.uint32)]
        shapes = [shape for shape in built.scene.shapes() if has_flat_mirrors(shape)]
        first_facet: list[int] = []
        n_mirrors = n_facets = 0
        plain = None
        for shape in shapes:
            triangles, primitives = _facets(built, shape)
            mirror, bounds = _mirrors_of(triangles)
            mirror_of = np.full(shape.face_count() if shape.is_mesh() else 1, NO_NUMBER, np.uint32)
            mirror_of[primitives] = mirror + n_mirrors
            first_facet.append(n_facets)
            corners.append(bounds)
            facets.append(mirror_of)
            lobes.append(np.tile(np.array(delta_lobes(shape.bsdf()), np.uint32), (len(bounds), 1)))
            n_mirrors, n_facets = n_mirrors + len(bounds), n_facets + len(mirror_of)
            plain = PlainMirror.of(shape, triangles, bounds[0]) if n_mirrors == len(bounds) == 1 else None
        bits, around = np.concatenate(lobes), np.concatenate(corners)
        mirrors = cls(
            n_mirrors,
            MirrorIndex.of(built, lasers, around),
            on_device(mi.Float, np.ravel(_packed(around)).astype(np.float32)),
            on_device(mi.UInt32, np.ravel(bits)),
            components_of(int(np.bitwise_or.reduce(bits, axis=None))),
            NumberOfShape.of(shapes, first_facet),
            on_device(mi.UInt32, np.concatenate(facets)),
            plain,
        )
        dr.eval(mirrors.packed, mirrors.lobes, mirrors.mirror_of)
        return mirrors

    def number_at(self, si: mi.SurfaceInteraction3f | mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.UInt32:
        """Return the number of the mirror that a ray met; NO_NUMBER where it met none."""
        if not self.n_mirrors:
            return mi.UInt32(NO_NUMBER)
        first = self.first_facet.at(si, active)
        known = first != NO_NUMBER
        return dr.select(known, dr.gather(mi.UInt32, self.mirror_of, first + si.prim_index, known), NO_NUMBER)

    def is_met(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether rays met a mirror."""
        return self.number_at(si, active) != NO_NUMBER

    def may_reflect(self, number: mi.UInt32, point: mi.Point3f, laser: mi.Point3f) -> mi.Bool:
        """Return whether the point of reflection lies within the bounds of mirrors; visibility is not tested.

        The bounds of a mirror of many facets are a triangle around it, those of a single facet are exact.
        """
        plane, one, other = (dr.gather(mi.Vector4f, self.packed, number * ROWS + row) for row in range(ROWS))
        height, above = _affine(plane, point), _affine(plane, laser)
        is_before = dr.minimum(height * dr.sign(above), dr.abs(above)) > MIN_HEIGHT
        height, above = dr.abs(height), dr.abs(above)
        # the point of reflection divides the distance between the feet in the ratio of the heights
        u = above * _affine(one, point) + height * _affine(one, laser)
        v = above * _affine(other, point) + height * _affine(other, laser)
        is_inside = (u >= 0) & (v >= 0) & (u + v <= height + above)
        if self.plain is not None:
            is_inside &= dr.maximum(u, v) <= self.plain.limit * (height + above)
        return is_before & is_inside

    def share(
        self, built: BuiltScene, si: mi.SurfaceInteraction3f, lit: mi.Point3f, start: mi.Point3f, active: mi.Bool
    ) -> mi.Spectrum:
        """Return the share of light that the only mirror sends on between points; as for ``reflected``."""
        number = mi.UInt32(0)
        active = active & self.may_reflect(number, si.p, lit)
        if self.plain is None:
            found = self.reflected(built, number, si, lit, start, active)
            return dr.select(found.active, found.value * dr.square(found.distance), 0)
        plane = dr.gather(mi.Vector4f, self.packed, number)
        normal, height, above = mi.Normal3f(plane.x, plane.y, plane.z), _affine(plane, si.p), _affine(plane, lit)
        to_image = lit - si.p - (2 * above) * normal
        place = si.p + to_image * (height / (height + above))
        # ends before the mirror, which it would meet else
        place += normal * dr.mulsign(ray_offset(built) * (1 + dr.max(dr.abs(place))), height)
        for origin in (offset_origin(built, si, to_image), start):
            way = mi.Ray3f(origin, place - origin, mi.Float(1), mi.Float(0), [])
            active &= ~built.scene.ray_test(way, coherent=False, active=active)
        cosine = -dr.dot(to_image, normal) * dr.rsqrt(dr.squared_norm(to_image))
        return dr.select(active, self.plain.share(cosine, active), 0)

    def reflected(
        self,
        built: BuiltScene,
        number: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        lit: mi.Point3f,
        start: mi.Point3f,
        active: mi.Bool,
    ) -> Reflection:
        """Connect points ``si`` to points ``lit`` by way of mirrors, where ``may_reflect`` says they can be connected.

        ``start``: where rays from the latter begin.
        """
        plane = dr.gather(mi.Vector4f, self.packed, number * ROWS, active)
        normal, height, above = mi.Normal3f(plane.x, plane.y, plane.z), _affine(plane, si.p), _affine(plane, lit)
        to_image = lit - si.p - (2 * above) * normal
        distance = dr.norm(to_image)
        direction = to_image / distance
        hit, active = self._met(built, number, si, direction, distance * height / (height + above), normal, active)
        hit.p = si.p + to_image * (height / (height + above))
        from_laser = direction - (2 * dr.dot(direction, normal)) * normal
        side = dr.select(mi.Frame3f.cos_theta(hit.wi) > 0, 0, 1)
        lobes = dr.gather(mi.UInt32, self.lobes, number * 2 + mi.UInt32(side), active)
        weight = lobe_weight(hit, lobes, self.components, active)
        active &= dr.any(weight > 0)
        segment = mi.Ray3f(start, offset_origin(built, hit, from_laser) - start, mi.Float(1), mi.Float(0), [])
        active &= ~built.scene.ray_test(segment, coherent=False, active=active)
        return Reflection(direction, -from_laser, distance, weight / dr.square(distance), active)

    @dr.syntax
    def _met(
        self,
        built: BuiltScene,
        number: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        direction: mi.Vector3f,
        distance: mi.Float,
        normal: mi.Normal3f,
        active: mi.Bool,
    ) -> tuple[mi.SurfaceInteraction3f, mi.Bool]:
        """Return the facet of a mirror in a direction and at a distance from points, and whether they see one there.

        Rays slip through between triangles: those that meet no facet are sent beside the point, too.
        """
        origin, frame = offset_origin(built, si, direction), mi.Frame3f(normal)
        nudge = NUDGE * (1 + dr.max(dr.abs(si.p)) + distance)
        ray, facet = mi.Ray3f(origin, direction), dr.zeros(mi.PreliminaryIntersection3f)
        is_met, tried = mi.Bool(False), mi.UInt32(0)
        while dr.hint(
            active & ~is_met & (tried < TRIES),
            exclude=[self, built, number, origin, direction, distance, frame, nudge],
        ):
            sine, cosine = dr.sincos(mi.Float(tried))
            beside = dr.select(tried == 0, 0, nudge) * (cosine * frame.s + sine * frame.t)
            ray.d = dr.normalize(direction * distance + beside)
            facet = built.scene.ray_intersect_preliminary(ray, coherent=False, active=active & ~is_met)
            is_met = self.number_at(facet, active) == number
            tried += 1
        active &= is_met
        return facet.compute_surface_interaction(ray, mi.RayFlags.All, active), active


@dataclass(frozen=True, eq=False)
class Reflection:
    """Connection of a point to a lit one by way of a mirror."""

    direction: mi.Vector3f  # from the point to the mirror
    from_lit: mi.Vector3f  # from the lit point to the mirror
    distance: mi.Float  # by way of the mirror [engine units]
    value: mi.Spectrum  # weight of the delta lobe over the distance squared
    active: mi.Bool  # whether nothing hides it


def image_in(mirror: FlatMirrors | None, point: mi.Point3f) -> mi.Point3f:
    """Return the images of points in a scene's only mirror, or the points themselves if it is None."""
    if mirror is None:
        return point
    plane = dr.gather(mi.Vector4f, mirror.packed, mi.UInt32(0))
    return point - (2 * _affine(plane, point)) * mi.Vector3f(plane.x, plane.y, plane.z)


def turned_in(mirror: FlatMirrors | None, vector: mi.Vector3f) -> mi.Vector3f:
    """Return the images of vectors, as ``image_in``."""
    if mirror is None:
        return vector
    plane = dr.gather(mi.Vector4f, mirror.packed, mi.UInt32(0))
    normal = mi.Vector3f(plane.x, plane.y, plane.z)
    return vector - (2 * dr.dot(vector, normal)) * normal


def lobe_weight(
    hit: mi.SurfaceInteraction3f, lobes: mi.UInt32, components: tuple[int, ...], active: mi.Bool
) -> mi.Spectrum:
    """Return the weight of those delta reflection ``components`` whose bits ``lobes`` has."""
    weight = mi.Spectrum(0)
    for component in components:
        context = mi.BSDFContext()
        context.component = component
        has_lobe = active & ((lobes >> component & 1) == 1)
        bs, value = hit.bsdf().sample(context, hit, 0.5, mi.Point2f(0.5), has_lobe)
        weight += dr.select(has_lobe & mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection), value, 0)
    return weight


def has_flat_mirrors(shape: mi.Shape) -> bool:
    """Return whether a shape has flat facets with delta reflection lobes, all of them about the facets' normals."""
    if mi.is_polarized:
        return False
    is_flat = not shape.has_vertex_normals() if shape.is_mesh() else shape.class_name() in FLAT_PLUGINS
    return is_flat and any(delta_lobes(shape.bsdf())) and has_known_lobes(shape.bsdf())


def has_known_lobes(bsdf: mi.BSDF) -> bool:
    """Return whether ``delta_lobes`` has all delta reflection components of a BSDF."""
    parts = _parts(bsdf)
    if not parts or bsdf.class_name() in ("TwoSidedBRDF", "BlendBSDF"):
        return all(map(has_known_lobes, parts))
    return not bool(bsdf.flags() & mi.BSDFFlags.DeltaReflection)


def _parts(bsdf: mi.BSDF) -> list[mi.BSDF]:
    parts = [part for part, (holder, _) in mi.traverse(bsdf).hierarchy.items() if holder is bsdf]
    return [part for part in parts if isinstance(part, mi.BSDF)]


def delta_lobes(bsdf: mi.BSDF) -> tuple[int, int]:
    """Return bits of the components that are delta reflection about the shading normal, on the front and on the back.

    Sampling a component by itself has the lobe's own weight as its result, in BSDFs that hold no other, in blends of
    these, and in ``twosided``, where a component belongs to one side. Not in masks; bump maps turn the normal.
    """
    parts = _parts(bsdf)
    if not parts:
        is_mirror = (bool(bsdf.flags(k) & mi.BSDFFlags.DeltaReflection) for k in range(bsdf.component_count()))
        own = sum(1 << k for k, mirrors in enumerate(is_mirror) if mirrors)
        return own, own
    front, back = delta_lobes(parts[0])
    if bsdf.class_name() == "TwoSidedBRDF":  # its back is the front of a BSDF
        return front, delta_lobes(parts[1])[0] << parts[0].component_count() if len(parts) > 1 else front
    if bsdf.class_name() != "BlendBSDF":
        return 0, 0
    shift = parts[0].component_count()
    other = delta_lobes(parts[-1])  # two that are equal are one object
    return front | other[0] << shift, back | other[1] << shift


def _facets(built: BuiltScene, shape: mi.Shape) -> tuple[Float64, NDArray[np.uint32]]:
    """Return triangles (n, 3, 3) of a shape, and its facet that each belongs to, as rays number them.

    Of a mesh those that some point of the wall may see; of a rectangle or disk two that cover it.
    """
    if shape.is_mesh():
        return facing_triangles(built, shape)
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ to_world[:3, :3].T + to_world[:3, 3]
    return square[[[0, 1, 2], [0, 2, 3]]], np.zeros(2, np.uint32)


def _affine(row: mi.Vector4f, point: mi.Point3f) -> mi.Float:
    return dr.fma(row.x, point.x, dr.fma(row.y, point.y, dr.fma(row.z, point.z, row.w)))


def _mirrors_of(triangles: Float64) -> tuple[NDArray[np.intp], Float64]:
    """Return the mirror (n,) of each triangle (n, 3, 3), and a triangle (m, 3, 3) around each mirror, in its plane."""
    if not len(triangles):
        return np.zeros(0, np.intp), triangles
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    _, vertex = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    edges = np.sort(vertex.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    one, other = order[:-1][same] // 3, order[1:][same] // 3
    turned = np.linalg.norm(normals[one] - normals[other], axis=1)
    one, other = one[turned < COPLANAR], other[turned < COPLANAR]
    links = sparse.coo_matrix((np.ones(len(one)), (one, other)), shape=(len(triangles), len(triangles)))
    n_mirrors, mirror = sparse.csgraph.connected_components(links, directed=False)
    around = np.zeros((n_mirrors, 3, 3))
    around[mirror] = triangles
    several = np.bincount(mirror, minlength=n_mirrors)[mirror] > 1
    if several.any():
        order = np.flatnonzero(several)[np.argsort(mirror[several], kind="stable")]
        numbers, first = np.unique(mirror[order], return_index=True)
        around[numbers] = _triangles_around(triangles[order], areas[order], first)
    return mirror, around


def _triangles_around(triangles: Float64, areas: Float64, first: NDArray[np.intp]) -> Float64:
    """Return triangles (m, 3, 3) around mirrors of several triangles (n, 3, 3), which begin at ``first`` (m,).

    Half of each is the rectangle around the mirror along an edge of its first triangle, the smallest of three.
    """
    mirror = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(triangles))))
    weights = np.linalg.norm(areas, axis=1)[:, None]
    normals = np.add.reduceat(areas, first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middle = np.add.reduceat(triangles.mean(axis=1) * weights, first) / np.add.reduceat(weights, first)
    places = triangles - middle[mirror, None]
    best, smallest = np.empty((len(first), 3, 3)), np.full(len(first), np.inf)
    for k in range(3):
        along = triangles[first, k] - triangles[first, k - 1]
        along -= np.einsum("mx,mx->m", along, normals)[:, None] * normals
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        axes = along, np.cross(normals, along)
        spans = [np.einsum("nkx,nx->nk", places, axis[mirror]) for axis in axes]
        low = [np.minimum.reduceat(span.min(axis=1), first)[:, None] for span in spans]
        size = [
            np.maximum.reduceat(span.max(axis=1), first)[:, None] - start
            for span, start in zip(spans, low, strict=True)
        ]
        corner = middle + low[0] * axes[0] + low[1] * axes[1]
        area = (size[0] * size[1])[:, 0]
        found = np.stack([corner, corner + 2 * size[0] * axes[0], corner + 2 * size[1] * axes[1]], axis=1)
        best[area < smallest], smallest = found[area < smallest], np.minimum(area, smallest)
    return best


def _packed(triangles: Float64) -> Float64:
    """Return planes and coordinates (n, 3, 4) of the triangles (n, 3, 3) around mirrors, with margins."""
    corner, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    dual = np.swapaxes(np.linalg.pinv(edges), 1, 2)  # (n, 2, 3): d_i . e_j = 1 where i = j, else 0
    reach = 1 + np.abs(triangles).max(axis=(1, 2), initial=0.0)
    steepest = np.linalg.norm(np.concatenate([dual, dual.sum(axis=1, keepdims=True)], axis=1), axis=2)
    margins = ROUNDING * reach[:, None] * steepest  # of both coordinates, and of their sum
    scale = 1 + margins.sum(axis=1)
    rows = np.empty((len(triangles), ROWS, 4))
    rows[:, 0, :3], rows[:, 0, 3] = normals, -np.einsum("nx,nx->n", normals, corner)
    rows[:, 1:, :3] = dual / scale[:, None, None]
    rows[:, 1:, 3] = (margins[:, :2] - np.einsum("nkx,nx->nk", dual, corner)) / scale[:, None]
    return rows
