"""Round mirrors: what spheres and cylinders reflect, against Fermat's principle and rays by numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize
from support.agreement import assert_agrees
from support.rendering import Scene, flat_wall, render
from support.varied_scenes import Stage, plate

Array = NDArray[np.float64]
MIRROR: Scene = {"type": "conductor"}
ROUND: dict[str, Scene] = {
    "sphere": {"type": "sphere", "center": [0.15, -0.1, 0.7], "radius": 0.3, "bsdf": MIRROR},
    "cylinder": {"type": "cylinder", "center": [0.1, 0.05, 0.6], "axis": [0.8, 0.3, 0.4], "radius": 0.2, "height": 0.9}
    | {"bsdf": MIRROR},
}


def axis_of(shape: Scene) -> Array:
    """Return the unit axis of a cylinder; 0 of a sphere."""
    axis = np.array(shape.get("axis", [0.0, 0.0, 0.0]), dtype=np.float64)
    return axis / max(float(np.linalg.norm(axis)), 1e-30)


def normals(shape: Scene, points: Array) -> Array:
    """Return unit normals (n, 3) at points of a surface."""
    away = points - np.array(shape["center"])
    away = away - (away @ axis_of(shape))[..., None] * axis_of(shape)
    return away / np.linalg.norm(away, axis=-1, keepdims=True)


def traced(shape: Scene, start: Array, directions: Array, length: float) -> tuple[Array, Array]:
    """Return where reflected rays (n, 3) are, ``length`` after they were sent, and where they were reflected."""
    axis, away = axis_of(shape), start - np.array(shape["center"])
    across, along = (vector - (vector @ axis)[..., None] * axis for vector in (away, directions))
    a, b, c = (along**2).sum(-1), along @ across, across @ across - shape["radius"] ** 2
    distance = (-b - np.sqrt(b**2 - a * c)) / a
    points = start + distance[:, None] * directions
    normal = normals(shape, points)
    turned = directions - 2 * (directions * normal).sum(-1)[:, None] * normal
    return points + (length - distance)[:, None] * turned, points


def image_light(shape: Scene, laser: Array, sensor: Array) -> tuple[float, float]:
    """Return H and the length of the way by the shortest way by the mirror, of rays that are spread as rays are."""
    axis, centre = axis_of(shape), np.array(shape["center"])
    up = np.cross(axis, [0.3, 0.5, -0.7]) if axis.any() else np.array([1.0, 0.0, 0.0])
    up /= np.linalg.norm(up)
    other, third = np.cross(axis, up) if axis.any() else np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])

    def place(free: Array) -> Array:
        if axis.any():
            return centre + shape["radius"] * (np.cos(free[0]) * up + np.sin(free[0]) * other) + free[1] * axis
        x, y, z = np.sin(free[1]) * np.cos(free[0]), np.sin(free[1]) * np.sin(free[0]), np.cos(free[1])
        return centre + shape["radius"] * (x * up + y * other + z * third)

    def way(free: Array) -> float:
        return float(np.linalg.norm(place(free) - laser) + np.linalg.norm(place(free) - sensor))

    grid = [np.array([a, b]) for a in np.linspace(-3, 3, 20) for b in np.linspace(-1, 1 if axis.any() else 3, 21)]
    found = optimize.minimize(way, min(grid, key=way), method="BFGS", options={"gtol": 1e-11})
    point, length = place(found.x), float(found.fun)
    normal = normals(shape, point[None])[0]
    beyond = axis.any() and abs((point - centre) @ axis) > shape["height"] / 2
    if beyond or min((sensor - point) @ normal, (laser - point) @ normal) < 0:
        return 0.0, length
    direction = (point - sensor) / np.linalg.norm(point - sensor)
    one = np.cross(direction, normal + np.array([0.1, 0.2, 0.3]))
    one /= np.linalg.norm(one)
    sides, step = np.stack([one, np.cross(direction, one)]), 1e-4
    ends = [traced(shape, sensor, direction + sign * step * sides, length)[0] for sign in (1, -1)]
    spread = np.linalg.norm(np.cross(*((ends[0] - ends[1]) / (2 * step))))
    cosines = direction[2] * (point - laser)[2] / np.linalg.norm(point - laser)
    return cosines / (np.pi**2 * float(spread)), length


@pytest.mark.parametrize("kind", ROUND)
def test_a_round_mirror_spreads_the_light_of_an_image(kind: str) -> None:
    """Time and strength of the third bounce are those of the shortest way, and of the spread of rays about it."""
    shape = ROUND[kind]
    settings: dict[str, Any] = {"bins": (0.5, 0.05, 60), "sensors": (4, 3), "engine": "path", "spp": 16}
    stage = Stage.of(flat_wall(shape, **settings))
    light = dict(stage.engine.device.exact_light(stage.batch))[3][0, 0, 0]
    capture, axis = stage.engine.capture, stage.engine.time_axis
    laser = capture.laser_grid.positions.reshape(3)
    expected = np.zeros_like(light)
    for row, sensor in zip(expected, capture.sensor_grid.positions.reshape(-1, 3), strict=True):
        value, length = image_light(shape, laser, sensor)
        row[int((length - axis.start_opl) / axis.bin_width_opl)] += value
    assert (expected.any(axis=-1)).sum() >= (12 if kind == "sphere" else 4)
    # Fermat's point is good to 1e-7, differences of rays to 1e-6
    assert np.abs(light - expected).max() < 1e-5 * expected.max()


def test_a_far_laser_has_its_image_at_half_the_radius() -> None:
    """On the axis 1/s' = 1/s + 2/R, the mirror equation: the light is that of an image so much nearer and smaller."""
    radius, distance = 0.4, 1.3
    ball = {"type": "sphere", "center": [0.0, 0.0, distance + radius], "radius": radius, "bsdf": MIRROR}
    capture = {"laser_point": [0.0, 0.0], "sensor_grid": {"nx": 1, "ny": 1}}
    stage = Stage.of(flat_wall(ball, capture=capture, bins=(2.5, 0.05, 10), engine="path", spp=16))
    light = dict(stage.engine.device.exact_light(stage.batch))[3].sum()
    behind = 1 / (1 / distance + 2 / radius)
    magnified = behind / distance
    expected = (magnified / (np.pi * (distance + behind))) ** 2
    assert np.isclose(light, expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ROUND)
def test_bounces_of_a_spot_are_those_found_by_chance(kind: str) -> None:
    """Bounces 3 to 5 of a spot agree with BSDF sampling alone, whose rays find the spot by way of the mirror."""
    lit = plate((-0.6, 0.0, 0.6), (1.0, 0.1, -0.2), (0.6, 0.8), 0.8)
    settings: dict[str, Any] = {"sensors": (3, 2), "bins": (0.0, 0.1, 60), "max_bounces": 5}
    config = flat_wall(ROUND[kind], lit, capture={"laser_spot_radius": 0.3}, wall={"bsdf": lit["bsdf"]}, **settings)
    by_images = render(config | {"render": config["render"] | {"spp": 2**17}}, replicas=16)
    by_chance = render(config | {"render": config["render"] | {"spp": 2**23}}, replicas=16, laser_sampling=False)
    for bounce in (3, 4, 5):
        one, other = (
            (result.bounce(bounce)[0, 0], result.bounce_variance(bounce)[0, 0]) for result in (by_images, by_chance)
        )
        assert_agrees(*one, other[0], replicas=16, reference_variance=other[1], share=0.3)
        deviation = np.sqrt(one[1].sum() + other[1].sum())
        assert deviation < 0.05 * other[0].sum()
