"""The reference renderer against closed forms and laws of its own, without any part of nlosrender."""

from __future__ import annotations

import numpy as np
import pytest
from reference.convert import Unsupported, as_task
from reference.renderer import COMPILER, Scene, WallPoint, Window, render

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc) to build the reference renderer with")

DEVICE = np.array([-0.5, 0.0, 0.25])
WALL = {"type": "rectangle", "width": 2.0, "height": 1.6}
SIGMAS = 5.0  # one false alarm in 2 million normal tests; replicas are 16 or more, so tails are a little fatter


def configuration(*hidden, bounces=3, bins=(0.0, 0.05, 160), sensors=(4, 3), laser=(0.3, -0.2), **capture):
    """A wall of 2 x 1.6 m, legs not counted."""
    return {
        "scene": {"relay_wall": WALL, "hidden_geometry": list(hidden)},
        "capture": {"scan_type": "single", "laser_point": list(laser), "account_first_and_last_bounces": False}
        | {"sensor_grid": {"nx": sensors[0], "ny": sensors[1]}, **capture},
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
        "render": {"max_bounces": bounces},
    }


def plate(center=(0.1, 0.05, 0.8), normal=(0.1, 0.2, -1.0), size=(0.8, 0.6), bsdf=None):
    """A rectangle, white unless said."""
    posed = {"type": "rectangle", "center": list(center), "normal": list(normal), "width": size[0], "height": size[1]}
    return posed | {"bsdf": bsdf or {"type": "diffuse", "reflectance": 1.0}}


def third_bounce(task, center, x, y, normal, keep=lambda u, v: np.ones_like(u), n=200):
    """Midpoint rule for the third bounce of a white parallelogram centre +- x +- y: (pair, bin) [J m^-2 sr^-1]."""
    u, v = np.meshgrid(*[(2 * np.arange(n) + 1) / n - 1] * 2)
    points = center + u[..., None] * x + v[..., None] * y
    area = 4 * np.linalg.norm(np.cross(x, y)) / n**2 * keep(u, v)
    result = np.zeros((len(task.pairs), task.window.n_bins))
    for row, (sensor, laser) in zip(result, task.pairs, strict=True):
        value, length = area / np.pi**3, 0.0
        for point in (sensor.position, laser.position):
            way = points - point
            r = np.linalg.norm(way, axis=-1)
            value = value * way[..., 2] / r * np.maximum(-way @ normal, 0) / r / r**2
            length = length + r
        index = np.floor((length - task.window.start) / task.window.width).astype(int).ravel()
        row += np.bincount(index, value.ravel(), minlength=task.window.n_bins)[: task.window.n_bins]
    return result


def assert_same(result, expected, floor):
    """Every pair's sum and the coarse bins' agree within noise and the quadrature's ``floor`` (relative)."""
    for axis in (-1, 0):
        mean, variance, right = (a.sum(axis=axis) for a in (result.mean[1], result.variance[1], expected))
        assert np.all(np.abs(mean - right) <= SIGMAS * np.sqrt(variance) + floor * right.max())


def test_a_white_plate_is_the_integral_over_its_area():
    """The third bounce of one plate in general position, per sensor point and per bin, is a surface integral."""
    task = as_task(configuration(plate()))
    p = np.array(task.scene.primitives[2][1])  # its first triangle starts at a corner: p0, e1, e2 = two edges
    x, y = p[3:6] / 2, (p[6:9] - p[3:6]) / 2
    normal = np.cross(x, y) / np.linalg.norm(np.cross(x, y))
    expected = third_bounce(task, p[:3] + x + y, x, y, normal)
    # bins cut the midpoint rule's cells: 40,000 of them err by about 1e-3 of the largest bin
    assert_same(task.render(20_000, replicas=16), expected, floor=3e-3)


@pytest.mark.parametrize("gap", [1e-3, 1e-5, 1e-7])
def test_what_a_black_sheet_covers_is_dark_however_small_the_gap(gap):
    """Visibility is what a ray meets first, not what lies nearer than a tolerance."""
    board = plate((0, 0, 1.0), (0, 0, -1), (0.6, 0.6))
    poster = plate((0, 0, 1.0 - gap), (0, 0, -1), (0.3, 0.3), {"type": "diffuse", "reflectance": 0.0})
    task = as_task(configuration(board, poster))

    def uncovered(u, v):
        return (np.maximum(np.abs(u), np.abs(v)) > 0.5).astype(float)

    expected = third_bounce(
        task, np.array([0, 0, 1.0]), np.array([0.3, 0, 0]), np.array([0, 0.3, 0]), np.array([0, 0, -1.0]), uncovered
    )
    # a gap of 1 mm shades a rim of at most 1.5 mm around the 1.2 m long edge, seen from up to 60 degrees: 1 %
    assert_same(task.render(20_000, replicas=16), expected, floor=3e-3 + 10 * gap)


def test_surfaces_in_one_place_count_once():
    """Two equal plates in the same place are one plate."""
    one, two = (as_task(configuration(*[plate()] * n)).render(4_000, replicas=16) for n in (1, 2))
    difference = np.abs(one.mean.sum() - two.mean.sum())
    assert difference <= SIGMAS * np.sqrt(one.variance.sum() + two.variance.sum())


def test_a_plane_mirror_shows_the_laser_point_behind_itself():
    """Laser point, mirror, sensor point: the image of the laser point lights what sees it in the mirror."""
    mirror = plate((0.1, 0, 0.8), (0, 0, -1), (0.8, 0.8), {"type": "conductor", "material": "none"})
    task = as_task(configuration(mirror))
    found = task.render(16).mean[1]
    for row, (sensor, laser) in zip(found, task.pairs, strict=True):
        image = laser.position * [1, 1, -1] + [0, 0, 1.6]
        way = image - sensor.position
        middle = sensor.position + way / 2
        distance = np.linalg.norm(way)
        seen = np.all(np.abs(middle[:2] - [0.1, 0]) < 0.4)
        expected = (way[2] / distance) ** 2 / np.pi**2 / distance**2 if seen else 0.0
        assert row.sum() == pytest.approx(expected, rel=1e-9)
        if seen:
            assert row[int(distance / 0.05)] == row.sum()


def test_inside_a_sphere_every_bounce_is_even():
    """In a matt sphere of albedo rho, bounce k is rho^k / (4 pi^2 R^2) at every point: light spreads evenly at once."""
    rho, radius, scene = 0.6, 0.7, Scene()
    scene.sphere((0, 0, 0), radius, scene.material("diffuse", rho), inside=True, hidden=False)
    laser, sensor = (WallPoint(radius * np.array(p), 0, np.zeros(3)) for p in ((0, 0, 1.0), (0.6, 0, 0.8)))
    result = render(scene, [(sensor, laser)], Window(0, 1.0, 60, 6, 5), 40_000, replicas=32)
    expected = rho ** np.arange(2, 7) / (4 * np.pi**2 * radius**2)
    found, sigma = result.mean.sum(axis=(1, 2)), np.sqrt(result.variance.sum(axis=(1, 2)))
    assert np.all(np.abs(found - expected) <= SIGMAS * sigma + 1e-12)


MATT = {"type": "diffuse", "reflectance": 0.8}
MIRROR = {"type": "conductor", "material": "none"}
RECIPROCAL = {
    "ggx": {"type": "roughconductor", "material": "none", "alpha": 0.3, "distribution": "ggx"},
    "beckmann": {"type": "roughconductor", "eta": 0.2, "k": 3.0, "alpha": 0.4, "distribution": "beckmann"},
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.6, "nonlinear": True},
    "blend": {"type": "blendbsdf", "weight": 0.3, "a": MATT, "b": MIRROR},
    "mask": {"type": "mask", "opacity": 0.4, "a": MATT},
    "thin pane": {"type": "thindielectric", "int_ior": 1.5},
    "pane": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
    "two-sided": {"type": "twosided", "a": {"type": "conductor", "eta": 1.2, "k": 2.0}},
}


@pytest.mark.parametrize("name", RECIPROCAL)
def test_laser_and_sensor_may_change_places(name):
    """Helmholtz reciprocity of bounces 3 to 5: paths sample at the sensor's end what they evaluate at the laser's."""
    # one refracting plane has to divide all space: a path that goes round it would take its index along
    pose = ((0, 0, 0.1), (0, 0, -1), (40, 40)) if name == "pane" else ((0.2, 0, 0.6), (0.3, 0.1, -1.0), (0.7, 0.9))
    hidden = (
        plate(*pose, RECIPROCAL[name]),
        plate((-0.5, 0, 0.6), (1.0, 0, -0.5), (0.6, 0.8), MATT),
        plate((0.1, 0, 1.3), (0, 0, -1.0), (1.5, 1.0), MATT),
    )
    results = []
    for laser, sensor in (((0.3, -0.2), (-0.5, 0.2)), ((-0.5, 0.2), (0.3, -0.2))):
        config = configuration(*hidden, bounces=5, bins=(0, 0.5, 20), laser=laser, sensors=(1, 1))
        config["scene"]["relay_wall"] = WALL | {"width": 3.0, "height": 3.0}
        task = as_task(config)
        there = task.pairs[0][0]
        moved = WallPoint(np.array([*sensor, 0.0]), there.primitive, there.device)
        task.pairs[0] = (moved, task.pairs[0][1])
        results.append(task.render(60_000, replicas=32, seed=len(results)))
    one, two = results
    variance = one.variance.sum(-1) + two.variance.sum(-1)
    difference = np.abs(one.mean.sum(-1) - two.mean.sum(-1))
    assert one.mean[3].sum() > 0
    assert np.all(difference <= SIGMAS * np.sqrt(variance) + 1e-12)


def on_axis(*hidden, bounces):
    """Laser and sensor point in the middle of the wall."""
    task = as_task(configuration(*hidden, bounces=bounces, sensors=(1, 1), laser=(0, 0), bins=(0, 20.0, 1)))
    return task.render(32, replicas=2, chain=1).mean[:, 0, 0]


def test_a_ball_mirrors_by_the_mirror_equation():
    """A convex mirror of radius R at distance d has its image at d' with 1/d' = 2/R + 1/d; light spreads from it."""
    radius, d = 0.3, 0.5
    ball = {"type": "sphere", "center": [0, 0, d + radius], "radius": radius, "bsdf": MIRROR}
    image = 1 / (2 / radius + 1 / d)
    expected = (image / d / (d + image)) ** 2 / np.pi**2
    # angles are differentiated over 1e-6 rad
    assert on_axis(ball, bounces=3)[1] == pytest.approx(expected, rel=1e-5)


def test_glass_makes_a_pool_look_shallow():
    """Behind one plane of index n, depth h looks like h/n: a small patch is lit, and seen, from so much nearer."""
    n, air, depth, edge = 1.5, 0.6, 0.3, 0.02
    pane = plate((0, 0, air), (0, 0, -1), (1, 1), {"type": "dielectric", "int_ior": n, "ext_ior": 1.0})
    patch = plate((0, 0, air + depth), (0, 0, -1), (edge, edge))
    task = as_task(configuration(pane, patch, bounces=5, sensors=(1, 1), laser=(0, 0), bins=(0, 0.2, 30)))
    # light of bounce 5 that the pane sends back to the wall is 0.3 m later
    transmitted = 1 - ((n - 1) / (n + 1)) ** 2
    # the patch is matt in glass: of its radiance 1 / n^2 gets into air
    expected = transmitted**2 / n**2 / (air + depth / n) ** 4 / np.pi**3 * edge**2
    result = task.render(1_000_000, replicas=16)
    arrival = int(2 * (air + n * depth) / 0.2)  # 2.1 m: the middle of a bin
    found, sigma = result.mean[3, 0, arrival], np.sqrt(result.variance[3, 0, arrival])
    assert abs(found - expected) <= SIGMAS * sigma + 1e-3 * expected  # cosines of up to (edge / depth)^2 = 4e-3 / 6 off
    assert sigma < 0.1 * expected


def test_the_same_seed_gives_the_same_numbers_on_any_number_of_threads():
    """Random numbers belong to pair and replica."""
    task = as_task(configuration(plate(), bounces=4))
    one, two = (task.render(500, threads=threads) for threads in (1, 3))
    assert np.array_equal(one.mean, two.mean)


def test_what_the_reference_has_no_words_for_is_refused():
    """A comparison must not pass because something was left out."""
    with pytest.raises(Unsupported, match="principled"):
        as_task(configuration(plate(bsdf={"type": "principled"})))
