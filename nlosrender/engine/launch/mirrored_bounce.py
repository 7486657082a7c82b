"""The third bounce by way of flat mirrors: one term per laser point, mirror and sensor point, exact."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from nlosrender.engine.launch.flat_mirrors import FlatMirrors
from nlosrender.engine.launch.histogram import DeviceHistogram
from nlosrender.engine.launch.launch_params import LaunchParams


@dr.syntax
def deposit_mirrored_bounce(params: LaunchParams, mirrors: FlatMirrors, histogram: DeviceHistogram) -> None:
    """Deposit, for every lane and each of its lasers, the light that one mirror sends from laser to sensor point.

    As ``deposit_second_bounce``.
    """
    sensor, laser = params.sensors.interaction, mi.UInt32(0)
    while dr.hint(laser < params.n_lasers, exclude=[params, mirrors, histogram, sensor]):
        place = params.lasers.gather(params.first_laser + laser).interaction.p
        number = mi.UInt32(0)
        while dr.hint(number < mirrors.count, exclude=[params, mirrors, histogram, sensor, laser, place]):
            is_near = mirrors.may_reflect(number, sensor.p, place)
            _deposit(params, mirrors, histogram, laser, number, is_near)
            number += 1
        laser += 1


@dr.syntax
def _deposit(
    params: LaunchParams,
    mirrors: FlatMirrors,
    histogram: DeviceHistogram,
    laser: mi.UInt32,
    number: mi.UInt32,
    active: mi.Bool,
) -> None:
    """Deposit what one mirror reflects; packets with no active lane skip the rays."""
    if dr.hint(active, exclude=[params, mirrors, histogram, laser, number]):
        built, sensor = params.built, params.sensors.interaction
        points = params.lasers.gather(params.first_laser + laser)
        found = mirrors.reflected(built, number, sensor, points.interaction, active)
        received = built.wall_bsdf.eval(mi.BSDFContext(), sensor, sensor.to_local(found.direction), found.active)
        lane, bins = dr.arange(mi.UInt32, dr.width(params.sensors.delay_bins)), params.delay_bin(points, found.distance)
        histogram.deposit(lane, laser, mi.UInt32(0), bins, found.value * received, found.active)
