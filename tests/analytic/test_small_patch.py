"""One small patch is a point: its third bounce is one number in one bin, known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from support.quadrature import Array, Frame, grid_points, unit
from support.rendering import flat_wall, render

SIZE = 0.004  # m
# (a) Points within float32 rounding, about 1e-7, of the patch's edges are missed: 4 * 1e-7 / 0.002 engine units = 2e-4,
# more at grazing angles, which the scenes avoid.
# (b) A patch of 4 mm at 0.5 m is no point: (0.004 / 0.5)^2 / 12 times small factors = 5e-5. (c) 512 low-discrepancy
# points on a smooth integrand that varies by 1 %: 1e-5.
TOLERANCE = 5e-4


def closed_form(laser: Array, sensor: Array, center: Array, normal: Array, wall_normal: Array) -> tuple[Array, Array]:
    """Value for albedos 1 and 1 J, and path length of a patch; points (..., 3) broadcast."""
    first, second = center - laser, center - sensor
    r1, r2 = np.linalg.norm(first, axis=-1), np.linalg.norm(second, axis=-1)
    cosines = (first @ wall_normal) * (-first @ normal) * (-second @ normal) * (second @ wall_normal)
    return np.where(cosines > 0, cosines, 0) / (r1 * r2) ** 4 / np.pi**3 * SIZE**2, r1 + r2


def patch(center: Array, normal: Array, rho: float = 1.0) -> dict:
    return {
        "type": "rectangle",
        "width": SIZE,
        "height": SIZE,
        "center": center.tolist(),
        "normal": normal.tolist(),
        "bsdf": {"type": "diffuse", "reflectance": rho},
    }


def check(histogram: Array, value: Array, opl: Array, start: float, width: float) -> None:
    """All energy is in the bin of the path length; where that is not near an edge, in this bin alone."""
    n_bins = histogram.shape[-1]
    np.testing.assert_allclose(histogram.sum(axis=-1), value, rtol=TOLERANCE)
    place = (opl - start) / width
    # a point of the patch is up to SIZE / sqrt(2) from its centre, which each half of the path changes by
    clear = np.abs(place - np.rint(place)) * width > 1.5 * SIZE
    assert clear.mean() > 0.3
    bins = np.clip(np.floor(place).astype(int), 0, n_bins - 1)
    lit = np.take_along_axis(histogram, bins[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(lit[clear], value[clear], rtol=TOLERANCE)


TILTS = {"facing": [0.0, 0.0, -1.0], "tilted": [0.5, -0.3, -1.0]}


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_patch_has_the_value_and_the_bin_of_the_closed_form(scan: str, tilt: str) -> None:
    """H = (1/pi)^3 cos cos cos cos dA / (r1^2 r2^2) rho_l rho_x rho_s E, at r1 + r2, for every scan type."""
    center, normal = np.array([-0.35, 0.15, 0.55]), unit(np.array(TILTS[tilt]))
    config = flat_wall(
        patch(center, normal, 0.6),
        scan=scan,
        wall={"bsdf": {"type": "diffuse", "reflectance": 0.8}},
        capture={"laser_energy": 2.5},
        bins=(0.4, 0.06, 60),
        spp=1024,
    )
    result = render(config)
    sensors = grid_points(5, 3, 2.0, 1.6)[None, None]
    lasers = {
        "single": np.array([0.3, -0.2, 0.0]).reshape(1, 1, 1, 1, 3),
        "confocal": sensors,
        "exhaustive": grid_points(2, 3, 1.5, 1.2)[:, :, None, None],
    }[scan]
    value, opl = closed_form(lasers, sensors, center, normal, np.array([0.0, 0.0, 1.0]))
    check(result.total, value * 0.6 * 0.8**2 * 2.5, opl, 0.4, 0.06)


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_legs_add_to_the_path_length_and_nothing_else(scan: str) -> None:
    """With legs the path length is |L - l| + r1 + r2 + |s - S|, the value the same."""
    center, normal = np.array([0.25, 0.1, 0.7]), np.array([0.0, 0.0, -1.0])
    devices = {"laser_position": [-0.5, 0.3, 0.9], "sensor_position": [0.7, -0.1, 1.3]}
    config = flat_wall(
        patch(center, normal),
        scan=scan,
        capture={**devices, "account_first_and_last_bounces": True},
        bins=(-0.5, 0.06, 120),
    )
    result = render(config)
    sensors = grid_points(5, 3, 2.0, 1.6)[None, None]
    lasers = {
        "single": np.array([0.3, -0.2, 0.0]).reshape(1, 1, 1, 1, 3),
        "confocal": sensors,
        "exhaustive": grid_points(2, 3, 1.5, 1.2)[:, :, None, None],
    }[scan]
    value, opl = closed_form(lasers, sensors, center, normal, np.array([0.0, 0.0, 1.0]))
    legs = np.linalg.norm(lasers - devices["laser_position"], axis=-1)
    legs = legs + np.linalg.norm(sensors - devices["sensor_position"], axis=-1)
    check(result.total, value, opl + legs, -0.5, 0.06)


def test_a_wall_in_any_pose_gives_the_closed_form_in_scene_coordinates() -> None:
    """Rotating and moving the wall changes only where its points are."""
    place = {"center": [3.0, -2.0, 5.0], "normal": [0.3, -1.0, 0.4], "up": [0.2, 0.5, 1.0]}
    frame = Frame.of(place["normal"], place["up"])
    center = np.array(place["center"]) + 0.6 * frame.normal + 0.3 * frame.x - 0.2 * frame.y
    normal = unit(-frame.normal + 0.2 * frame.x)
    config = flat_wall(patch(center, normal), scan="exhaustive", wall=place, bins=(0.0, 0.06, 80))
    result = render(config)
    sensors = grid_points(5, 3, 2.0, 1.6, place["center"], frame)[None, None]
    lasers = grid_points(2, 3, 1.5, 1.2, place["center"], frame)[:, :, None, None]
    value, opl = closed_form(lasers, sensors, center, normal, frame.normal)
    check(result.total, value, opl, 0.0, 0.06)


def test_oblique_connections_to_the_laser_are_not_cut_off() -> None:
    """A patch lit at 80 degrees from the wall's normal has its closed form: the wall does not shadow its own points."""
    center, normal = np.array([-0.9, 0.0, 0.3]), unit(np.array([1.0, 0.0, -1.0]))
    config = flat_wall(patch(center, normal), capture={"laser_point": [0.8, 0.0]}, bins=(0.0, 0.06, 100))
    result = render(config)
    value, opl = closed_form(
        np.array([0.8, 0.0, 0.0]), grid_points(5, 3, 2.0, 1.6)[None, None], center, normal, np.array([0.0, 0.0, 1.0])
    )
    check(result.total, value, opl, 0.0, 0.06)


def test_a_patch_turned_away_or_behind_the_wall_returns_nothing() -> None:
    """A one-sided patch seen from behind is black, and so is whatever lies behind the wall."""
    away = patch(np.array([0.1, 0.2, 0.6]), np.array([0.0, 0.0, 1.0]))
    behind = patch(np.array([0.1, 0.2, -0.6]), np.array([0.0, 0.0, 1.0]))
    for hidden in (away, behind):
        result = render(flat_wall(hidden))
        assert result.total.sum() == 0
        assert result.outside.sum() == 0
