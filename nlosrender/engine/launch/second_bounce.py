"""The second bounce, laser point straight to sensor point: one term per pair, exact; zero on a planar wall."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.ray_offsets import connection_segment, ray_offset_at
from nlosrender.scene.build import BuiltScene, SceneWithoutWall

COINCIDENT = 1e-6  # engine units; a confocal pair has no path between its points


@dr.syntax
def deposit_second_bounce(params: LaunchParams, histogram: DeviceHistogram, active: mi.Bool | bool = True) -> None:
    """Deposit, for every active lane and each of its lasers, the light that goes from laser point to sensor point.

    It goes to the histogram's first slot. Values are per J of pulse and (engine unit)^2, as in ``trace_paths``.
    """
    built, sensor = params.built, params.sensors.interaction
    context = mi.BSDFContext()
    laser = mi.UInt32(0)
    while dr.hint(laser < params.n_lasers, exclude=[params, histogram, built, sensor, active]):
        points = params.lasers.gather(params.first_laser + laser)
        lit = points.interaction
        to_laser = lit.p - sensor.p
        distance = dr.norm(to_laser)
        apart = (distance > COINCIDENT) & active
        if dr.hint(isinstance(built, SceneWithoutWall), mode="scalar"):
            apart &= ~on_one_plane(built, sensor, lit.n, to_laser)
        direction = to_laser / dr.maximum(distance, COINCIDENT)
        received = built.bsdf_at(sensor).eval(context, sensor, sensor.to_local(direction), apart)
        emitted = built.bsdf_at(lit).eval(context, lit, lit.to_local(-direction), apart)
        value = points.shared(received * emitted) / dr.square(dr.maximum(distance, COINCIDENT))
        is_lit = apart & dr.any(value > 0)
        is_lit &= ~built.scene.ray_test(
            connection_segment(built, sensor, direction, lit), coherent=False, active=is_lit
        )
        bins = params.delay_bin(points, distance)
        histogram.deposit(params.row_of_lane, laser, mi.UInt32(0), bins, value, is_lit)
        laser += 1


def on_one_plane(
    built: BuiltScene, point: mi.SurfaceInteraction3f, normal: mi.Normal3f, to_other: mi.Vector3f
) -> mi.Bool:
    """Return whether points lie in each other's tangent plane, as far as float32 knows: no light goes between them.

    ``normal``: unit, of the other point, which is ``to_other`` away.

    On a tilted plane their cosines are not 0 exactly, and the light of a point very close has no bound.
    """
    height = dr.maximum(dr.abs(dr.dot(point.n, to_other)), dr.abs(dr.dot(normal, to_other)))
    return height < ray_offset_at(built, point.p, point.shape)
