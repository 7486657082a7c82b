"""Round mirrors: spheres and cylinders seen from outside send the light of a point on by way of one point of theirs.

In the plane of the centre and the two points, and of a cylinder in the plane across its axis, that point is where the
angles of incidence and reflection are equal (Alhazen's problem), which Newton's method finds; a convex mirror has one.
The mirror spreads the light: docs/virtual-lights.md, 11.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.flat_mirrors import (
    Reflection,
    components_of,
    delta_lobes,
    has_known_lobes,
    lobe_weight,
)
from nlosrender.engine.launch.mirror_index import MirrorIndex
from nlosrender.engine.launch.ray_offsets import offset_origin
from nlosrender.scene.build import BuiltScene
from nlosrender.scene.loading.number_of_shape import NO_NUMBER, NumberOfShape
from nlosrender.scene.loading.round_surfaces import ROUND_PLUGINS, RoundSurface

# Newton steps. Of 200,000 pairs of points 0.01 to 100 radii above the mirror the angle is good to 1e-2 after 4, 2e-4
# after 5, 5e-7 after 6, and 4e-7, the rounding of float32, after 8 and more.
STEPS = 7


@dataclass(frozen=True, eq=False)
class RoundMirrors:
    """The convex sides of the spheres and cylinders of a scene that have delta reflection lobes."""

    index: MirrorIndex
    packed: mi.Float  # eight a mirror: centre, radius; unit axis (0 of a sphere), length
    lobes: mi.UInt32  # of each mirror: bits of the delta reflection components on its outside
    components: tuple[int, ...]  # that any of them has
    numbers: NumberOfShape  # the mirror that each shape is

    @classmethod
    def of(cls, built: BuiltScene) -> RoundMirrors | None:
        """Return the round mirrors of a scene; None where there are none."""
        shapes = [shape for shape in built.scene.shapes() if _outer_lobes(shape)]
        if not shapes:
            return None
        rows = np.zeros((len(shapes), 8))
        for row, surface in zip(rows, map(RoundSurface.of, shapes), strict=True):
            length = float(np.linalg.norm(surface.axis))
            row[:3], row[3], row[7] = surface.centre, surface.radius, length
            row[4:7] = surface.axis / max(length, 1e-30)
        bits = np.array([_outer_lobes(shape) for shape in shapes], np.uint32)
        mirrors = cls(
            MirrorIndex.of_all(len(shapes)),
            on_device(mi.Float, rows.ravel().astype(np.float32)),
            on_device(mi.UInt32, bits),
            components_of(int(np.bitwise_or.reduce(bits))),
            NumberOfShape.of(shapes, range(len(shapes))),
        )
        dr.eval(mirrors.packed, mirrors.lobes)
        return mirrors

    def is_met(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether rays met the convex side of a mirror."""
        number = self.numbers.at(si, active)
        active = active & (number != NO_NUMBER)
        surface = _Surface.of(self, number, active)
        return active & (dr.dot(surface.across(si.p), si.to_world(si.wi)) > 0)

    def may_reflect(self, number: mi.UInt32, point: mi.Point3f, laser: mi.Point3f) -> mi.Bool:
        """Return whether mirrors, were cylinders endless, reflect the light of a laser point to a point."""
        surface = _Surface.of(self, number, mi.Bool(True))
        a, b = surface.across(point), surface.across(laser)
        far_a, far_b = dr.norm(a), dr.norm(b)
        sin_a, sin_b = surface.radius / far_a, surface.radius / far_b
        is_outside = dr.maximum(sin_a, sin_b) < 1
        # between them is less than both horizons: cos(angle) > cos(acos(sin_a) + acos(sin_b))
        horizon = sin_a * sin_b - dr.safe_sqrt(1 - dr.square(sin_a)) * dr.safe_sqrt(1 - dr.square(sin_b))
        return is_outside & (dr.dot(a, b) > horizon * far_a * far_b)

    def reflected(
        self,
        built: BuiltScene,
        number: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        lit: mi.Point3f,
        start: mi.Point3f,
        active: mi.Bool,
    ) -> Reflection:
        """Connect points by way of mirrors; as ``FlatMirrors.reflected``."""
        surface = _Surface.of(self, number, active)
        place, normal, inside = surface.reflection(si.p, lit)
        to_mirror, from_lit = place - si.p, place - lit
        near, far = dr.norm(to_mirror), dr.norm(from_lit)
        direction, from_lit = to_mirror / near, from_lit / far
        cosine = -dr.dot(normal, direction)
        active &= inside & (cosine > 0) & (dr.dot(normal, from_lit) < 0)
        ray = mi.Ray3f(offset_origin(built, si, direction), direction)
        hit = built.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        active &= self.numbers.at(hit, active) == number
        lobes = dr.gather(mi.UInt32, self.lobes, number, active)
        weight = lobe_weight(hit, lobes, self.components, active)
        active &= dr.any(weight > 0)
        end = offset_origin(built, hit, -from_lit)
        segment = mi.Ray3f(start, end - start, mi.Float(1), mi.Float(0), [])
        active &= ~built.scene.ray_test(segment, coherent=False, active=active)
        spread = surface.spread(normal, direction, cosine, near, far)
        return Reflection(direction, from_lit, near + far, weight / spread, active)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Spheres and cylinders, one per lane."""

    centre: mi.Point3f
    radius: mi.Float
    axis: mi.Vector3f
    length: mi.Float

    @classmethod
    def of(cls, mirrors: RoundMirrors, number: mi.UInt32, active: mi.Bool) -> _Surface:
        one, two = (dr.gather(mi.Vector4f, mirrors.packed, number * 2 + row, active) for row in range(2))
        return cls(mi.Point3f(one.x, one.y, one.z), one.w, mi.Vector3f(two.x, two.y, two.z), two.w)

    def across(self, point: mi.Point3f) -> mi.Vector3f:
        """Return vectors from the centre to points, or across from the axis."""
        away = point - self.centre
        return away - dr.dot(away, self.axis) * self.axis

    @dr.syntax
    def reflection(self, point: mi.Point3f, lit: mi.Point3f) -> tuple[mi.Point3f, mi.Normal3f, mi.Bool]:
        """Return where the angles are equal, the outer normal there, and whether a cylinder reaches so far."""
        a, b, radius = self.across(point), self.across(lit), self.radius
        far_a, far_b = dr.norm(a), dr.norm(b)
        up = a / far_a
        side = b - dr.dot(b, up) * up
        total = dr.atan2(dr.norm(side), dr.dot(b, up))
        side = side * dr.rcp(dr.maximum(dr.norm(side), dr.smallest(mi.Float)))
        high_a, high_b = far_a - radius, far_b - radius
        angle, step = total * high_a / (high_a + high_b), mi.UInt32(0)
        while dr.hint(step < STEPS, exclude=[far_a, far_b, high_a, high_b, radius, total]):
            one, slope_a = _incidence(angle, far_a, high_a, radius)
            other, slope_b = _incidence(total - angle, far_b, high_b, radius)
            angle = dr.clip(angle - (one - other) / (slope_a + slope_b), 0, total)
            step += 1
        sine, cosine = dr.sincos(angle)
        normal = cosine * up + sine * side
        place = self.centre + radius * normal
        way_a, way_b = dr.norm(a - radius * normal), dr.norm(b - radius * normal)
        from_a, from_b = dr.dot(point - self.centre, self.axis), dr.dot(lit - self.centre, self.axis)
        along = (from_a * way_b + from_b * way_a) / (way_a + way_b)
        inside = (self.length == 0) | ((along > 0) & (along < self.length))
        return place + along * self.axis, mi.Normal3f(normal), inside

    def spread(
        self, normal: mi.Normal3f, direction: mi.Vector3f, cosine: mi.Float, near: mi.Float, far: mi.Float
    ) -> mi.Float:
        """Return the area across the rays that a mirror spreads a unit solid angle to [(engine unit)^2]."""
        way, bend = near + far, 2 * near * far / self.radius
        tangent = dr.square(dr.dot(dr.cross(self.axis, normal), direction))  # 0 of a sphere
        of_cylinder = way * (way + bend * cosine * (1 + tangent / dr.square(cosine)))
        of_sphere = (way + bend / cosine) * (way + bend * cosine)
        return dr.select(self.length == 0, of_sphere, of_cylinder)


def _incidence(angle: mi.Float, far: mi.Float, high: mi.Float, radius: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return the angle of incidence, at ``angle`` around the centre, of light from ``far``, and its derivative."""
    low = 2 * dr.square(dr.sin(angle / 2))  # 1 - cos, without cancellation
    incidence = dr.atan2(far * dr.sin(angle), high - far * low)
    return incidence, far * (high + radius * low) / (dr.square(high) + 2 * far * radius * low)


def _outer_lobes(shape: mi.Shape) -> int:
    """Return bits of the delta reflection components on the outside of a sphere or cylinder; 0 of other shapes."""
    if mi.is_polarized or shape.class_name() not in ROUND_PLUGINS or not has_known_lobes(shape.bsdf()):
        return 0
    return delta_lobes(shape.bsdf())[1 if shape.has_flipped_normals() else 0]
