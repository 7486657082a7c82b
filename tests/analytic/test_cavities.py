"""Closed cavities, where every bounce is known: white-furnace laws of time-resolved interreflection.

Inside a sphere of radius R, cos cos / d^2 = 1 / (4 R^2) for every pair of points. So the light of a diffuse sphere
(albedo rho) spreads evenly at each bounce: H_k = (rho / pi)^k (4 pi R^2)^(k - 2) (1 / (4 R^2))^(k - 1)
= rho^k / (4 pi^2 R^2) for every pair, and a chord to an even point has length l with density l / (2 R^2) on [0, 2 R],
independent of the chords before it.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.agreement import assert_agrees, t_limit
from support.quadrature import Array, Setup, binned, grid_points, sphere_cells, third_bounces
from support.rendering import flat_wall, render

RADIUS, ALBEDO = 0.7, 0.6
REPLICAS = 16


def sphere_room(**changes: object) -> dict:
    """A diffuse sphere as relay wall, lit and measured from within, off the origin."""
    config = flat_wall(**changes)
    config["scene"]["relay_wall"] = {
        "type": "sphere",
        "center": [1.0, -2.0, 3.0],
        "radius": RADIUS,
        "inside": True,
        "bsdf": {"type": "diffuse", "reflectance": ALBEDO},
    }
    return config


def sphere_points(nx: int, ny: int) -> Array:
    """The sensor grid of the whole sphere: uniform in longitude from +z towards +x, and in height y: (ny, nx, 3)."""
    longitude = (((np.arange(nx) + 0.5) / nx - 0.5) * 2 * np.pi)[None, :]
    height = ((2 * np.arange(ny) + 1) / ny - 1)[:, None]
    across = np.sqrt(1 - height**2)
    coordinates = np.broadcast_arrays(across * np.sin(longitude), height, across * np.cos(longitude))
    return RADIUS * np.stack(coordinates, axis=-1)


def laser_on_sphere(x: float, y: float) -> Array:
    """The point at wall coordinates x = R longitude, y = height."""
    across = np.sqrt(RADIUS**2 - y**2)
    return np.array([across * np.sin(x / RADIUS), y, across * np.cos(x / RADIUS)])


def bounce_energy(k: int) -> float:
    return ALBEDO**k / (4 * np.pi**2 * RADIUS**2)


def third_bounce_in_a_sphere(x: float, y: float, edges: Array, n: int) -> Array:
    """Quadrature of the third bounce from the laser point (x, y) to each of 5 x 3 sensor points, (15, bins)."""
    laser, cells = laser_on_sphere(x, y), sphere_cells([0, 0, 0], RADIUS, n)
    share = np.full(len(cells.points), bounce_energy(3) / len(cells.points))
    first = np.linalg.norm(cells.points - laser, axis=-1)
    rows = [
        binned(share, first + np.linalg.norm(cells.points - sensor, axis=-1), edges)
        for sensor in sphere_points(5, 3).reshape(-1, 3)
    ]
    return np.array(rows)


def test_the_second_bounce_in_a_sphere_is_one_exact_bin() -> None:
    """H_2 = rho^2 / (4 pi^2 R^2) for every pair, in the bin of the chord, without noise."""
    config = sphere_room(scan="exhaustive", sensors=(5, 3), bins=(0.0, 0.047, 40), max_bounces=2)
    config["capture"]["laser_grid"] = {"nx": 2, "ny": 4}
    result = render(config)
    second = result.bounce(2)
    # float32: three products of cosines and a distance, each good to 1e-7 of the sphere's size
    np.testing.assert_allclose(second.sum(axis=-1), bounce_energy(2), rtol=1e-5)
    lasers, sensors = sphere_points(2, 4)[:, :, None, None], sphere_points(5, 3)[None, None]
    chord = np.linalg.norm(lasers - sensors, axis=-1)
    np.testing.assert_array_equal(second.argmax(axis=-1), np.floor(chord / 0.047))
    assert (second > 0).sum() == chord.size
    assert result.variance.sum() == 0


def test_a_ball_blocks_exactly_the_chords_that_meet_it() -> None:
    """The second bounce is there or not: by the distance of the chord from the ball's centre."""
    ball = {"type": "sphere", "center": [1.1, -2.0, 3.1], "radius": 0.3}
    config = sphere_room(scan="exhaustive", sensors=(5, 4), bins=(0.0, 2.0, 1), max_bounces=2)
    config["scene"]["hidden_geometry"] = [ball]
    config["capture"]["laser_grid"] = {"nx": 2, "ny": 3}
    second = render(config).bounce(2)[..., 0]
    lasers, sensors = sphere_points(2, 3)[:, :, None, None], sphere_points(5, 4)[None, None]
    chord = sensors - lasers
    to_ball = np.array([0.1, 0.0, 0.1]) - lasers
    along = (to_ball * chord).sum(axis=-1, keepdims=True) / (chord**2).sum(axis=-1, keepdims=True)
    clear = np.linalg.norm(to_ball - along * chord, axis=-1) > 0.3
    assert 0.1 < clear.mean() < 0.9
    np.testing.assert_allclose(second, np.where(clear, bounce_energy(2), 0), rtol=1e-5)


def test_a_confocal_pair_has_no_second_bounce_and_every_other_one() -> None:
    """A point sees itself along no chord; its third bounce has the energy of any other pair."""
    result = render(sphere_room(scan="confocal", bins=(0.0, 0.1, 60), spp=8192, max_bounces=3), replicas=REPLICAS)
    assert result.bounce(2).sum() == 0
    # all connections have the same weight: no noise but float32
    np.testing.assert_allclose(result.bounce(3).sum(axis=-1), bounce_energy(3), rtol=1e-5)


@pytest.mark.parametrize("russian_roulette", [True, False])
def test_every_bounce_of_a_sphere_has_its_energy(russian_roulette: bool) -> None:
    """H_k = rho^k / (4 pi^2 R^2): each bounce is rho times the one before, for every pair of points.

    One bin holds everything, so the variance is that of the energy. Every path carries the same: without roulette there
    is no noise at all.
    """
    config = sphere_room(bins=(0.0, 50.0, 1), spp=16384, max_bounces=6, russian_roulette=russian_roulette)
    result = render(config, replicas=REPLICAS)
    assert result.outside.sum() == 0
    for k in (2, 3, 4, 5, 6):
        energies, variance = result.bounce(k)[..., 0], result.bounce_variance(k)[..., 0]
        # float32: a product of up to six weights, each good to 1e-6
        noise = t_limit(4 * energies.size, REPLICAS - 1) * np.sqrt(variance)
        assert (np.abs(energies - bounce_energy(k)) < noise + 1e-5 * bounce_energy(k)).all()
        assert noise.max() < (0.2 if russian_roulette else 1e-5) * bounce_energy(k)


GREY = {"type": "diffuse", "reflectance": ALBEDO}
SAME = {"type": "blendbsdf", "weight": 0.3, "first": GREY, "second": GREY}  # not known to be Lambertian


@pytest.mark.parametrize(
    ("scan", "bsdf"),
    [
        ("single", GREY),
        ("confocal", SAME),
        *(
            pytest.param(*more, marks=pytest.mark.slow)
            for more in (("confocal", GREY), ("exhaustive", GREY), ("single", SAME))
        ),
    ],
)
def test_virtual_lights_give_every_bounce_of_a_sphere_its_energy(scan: str, bsdf: dict) -> None:
    """The wall's own patches and VPLs on the wall: H_k = rho^k / (4 pi^2 R^2) with nothing else in the sphere.

    In a sphere every pair of cells exchanges the same, so that the third bounce has no discretisation error at all.
    Bounces above come from VPLs that all sensor points share: their errors go together, and the mean has them in full.
    """
    config = sphere_room(scan=scan, bins=(0.0, 50.0, 1), spp=None, target_error=0.02, max_bounces=5)
    config["render"]["engine"] = "virtual_lights"
    config["scene"]["relay_wall"]["bsdf"] = bsdf
    if scan == "exhaustive":
        config["capture"]["laser_grid"] = {"nx": 2, "ny": 4}
    result = render(config)
    # float32: areas of spherical triangles, four cosines and distances, each good to 1e-7; of other BSDFs three places
    # of each patch have cosines of their own, and 0.65 of the target error is left to the third bounce
    if bsdf is GREY:
        np.testing.assert_allclose(result.bounce(3), bounce_energy(3), rtol=1e-5)
    assert np.sqrt(np.mean((result.bounce(3) / bounce_energy(3) - 1) ** 2)) < 0.65 * 0.02
    if scan != "confocal":
        np.testing.assert_allclose(result.bounce(2), bounce_energy(2), rtol=1e-5)
    for k in (4, 5):
        sigma = float(np.sqrt(result.bounce_variance(k)).mean())
        replicas = result.plan.replicas
        assert abs(result.bounce(k).mean() - bounce_energy(k)) < t_limit(2, replicas - 1) * sigma
        assert sigma < 0.1 * bounce_energy(k)


@pytest.mark.parametrize("russian_roulette", [True, False])
def test_all_bounces_of_a_sphere_sum_to_the_geometric_series(russian_roulette: bool) -> None:
    """Without a limit: sum over k of rho^k / (4 pi^2 R^2) = rho^2 / (1 - rho) / (4 pi^2 R^2); no path is cut off."""
    config = sphere_room(
        bins=(0.0, 10.0, 1),
        spp=8192,
        max_bounces=None if russian_roulette else 20,
        russian_roulette=russian_roulette,
        split_bounces=False,
    )
    result = render(config, replicas=REPLICAS)
    total = result.mean[..., 0] + result.outside
    expected = bounce_energy(2) * (1 if russian_roulette else 1 - ALBEDO**19) / (1 - ALBEDO)
    sigma = np.sqrt(result.variance.sum()) / total.size
    assert abs(total.mean() - expected) < t_limit(1, REPLICAS - 1) * sigma + 1e-4 * expected
    assert sigma < 2e-3 * expected


def test_the_third_bounce_of_a_pair_in_a_sphere_is_that_of_quadrature() -> None:
    """Per bin: the even point between the two has |l - x| + |x - s| distributed as over equal-area cells."""
    config = sphere_room(bins=(0.0, 0.1, 40), spp=65536, max_bounces=3, capture={"laser_point": [0.4, 0.3]})
    result = render(config, replicas=REPLICAS)
    reference = third_bounce_in_a_sphere(0.4, 0.3, 0.1 * np.arange(41), 500).reshape(result.total.shape)
    assert_agrees(result.bounce(3), result.bounce_variance(3), reference, replicas=REPLICAS, floor=2e-3)


def test_the_third_bounce_of_virtual_lights_in_a_sphere_is_that_of_quadrature() -> None:
    """Per bin, to the error asked for of all bounces, of a wall that is cut into elements itself."""
    config = sphere_room(bins=(0.0, 0.1, 40), spp=None, target_error=0.01, max_bounces=3)
    config["render"]["engine"] = "virtual_lights"
    config["capture"]["laser_point"] = [0.4, 0.3]
    result = render(config)
    third = result.bounce(3)
    reference = third_bounce_in_a_sphere(0.4, 0.3, 0.1 * np.arange(41), 1000).reshape(third.shape)
    # the error asked for, of all the light there is, and that of quadrature in 1000 x 1000 cells: 4 mm of bins of 10 cm
    light = np.linalg.norm(result.total - third + reference)
    assert np.linalg.norm(third - reference) < 0.01 * light + 0.01 * np.linalg.norm(reference)


def test_arrival_times_in_a_sphere_are_sums_of_chords() -> None:
    """Averaged over evenly spread sensor points, bounce k arrives after k - 1 independent chords l / (2 R^2)."""
    width, n_bins = 0.2, 40
    result = render(
        sphere_room(
            sensors=(20, 16), bins=(0.0, width, n_bins), spp=4096, max_bounces=5, capture={"laser_point": [0.4, 0.3]}
        ),
        replicas=REPLICAS,
    )
    n = 1000  # steps per bin
    step = width / n
    length = (np.arange(round(2 * RADIUS / step)) + 0.5) * step
    chord = length / (2 * RADIUS**2) * step
    density = chord
    # 320 sensor points stand for the sphere: each bin of the last chord is a band of it that holds about 320 * 0.2 *
    # l / (2 R^2) = 60 points, of which two rims miscount sqrt(60) / 2: 5 % of the band's weight for k = 2, and three
    # times less after every further chord, which averages over all bands.
    for k, floor in ((3, 0.02), (4, 0.007), (5, 0.003)):
        density = np.convolve(density, chord)
        opl = (np.arange(len(density)) + 0.5 * (k - 1)) * step
        reference = bounce_energy(k) * binned(density, opl, width * np.arange(n_bins + 1))
        mean = result.bounce(k).mean(axis=(0, 1, 2, 3))
        variance = result.bounce_variance(k).sum(axis=(0, 1, 2, 3)) / 320**2
        assert_agrees(mean[None], variance[None], reference[None], replicas=REPLICAS, floor=floor)


@pytest.mark.parametrize("p_hidden_sampling", [0.0, 0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_small_wall_in_a_large_sphere(p_hidden_sampling: float) -> None:
    """Wherever the wall is, all its light meets the sphere: H_k = rho_w^2 rho^(k-2) / (4 pi^2 R^2) for k >= 4.

    H_4 = (rho_w / pi)^2 (rho / pi)^2 F (1 / (4 R^2)) F with F = integral of cos cos / d^2 over the sphere = pi. The
    wall itself is in the way of a share 2 A / (4 pi R^2) = 3e-4 of the sphere's chords (Cauchy), and of its own light.
    The third bounce depends on the place: quadrature.
    """
    radius, rho, rho_wall, center = 1.2, 0.5, 0.8, [0.2, 0.1, 0.7]
    config = flat_wall(
        {
            "type": "sphere",
            "center": center,
            "radius": radius,
            "inside": True,
            "bsdf": {"type": "diffuse", "reflectance": rho},
        },
        wall={"width": 0.06, "height": 0.05, "bsdf": {"type": "diffuse", "reflectance": rho_wall}},
        capture={"laser_point": [0.01, -0.02]},
        bins=(0.0, 0.2, 60),
        max_bounces=6,
        spp=32768,
    )
    result = render(config, replicas=REPLICAS, p_hidden_sampling=p_hidden_sampling)
    setup = Setup(sphere_cells(center, radius, inside=True), 0.2 * np.arange(61), rho=rho, rho_wall=rho_wall)
    reference = third_bounces(setup, np.array([[[0.01, -0.02, 0.0]]]), grid_points(5, 3, 0.06, 0.05))
    assert_agrees(result.bounce(3), result.bounce_variance(3), reference, replicas=REPLICAS, floor=2e-3)
    for k in (4, 5, 6):
        expected = rho_wall**2 * rho ** (k - 2) / (4 * np.pi**2 * radius**2)
        energies = result.bounce(k).sum(axis=-1)
        sigma = np.sqrt(result.bounce_variance(k).sum()) / energies.size
        assert abs(energies.mean() - expected) < t_limit(3, REPLICAS - 1) * sigma + (k - 2) * 6e-4 * expected
        assert sigma < 0.01 * expected


def test_a_closed_room_has_the_energy_of_radiosity() -> None:
    """All bounces of a diffuse 2 m cube, albedo 0.5, against a radiosity solution in 6 x 18 x 18 patches."""
    rho, laser, sensors = 0.5, np.array([0.3, -0.2, 0.0]), grid_points(4, 3, 2.0, 2.0)
    grey = {"type": "diffuse", "reflectance": rho}
    config = flat_wall(
        {"type": "room", "size": [2.0, 2.0, 2.0], "bsdf": grey},
        wall={"height": 2.0, "bsdf": grey},
        sensors=(4, 3),
        bins=(0.0, 1.0, 60),
        max_bounces=None,
        split_bounces=False,
        spp=32768,
    )
    result = render(config, replicas=REPLICAS)
    energies = (result.mean.sum(axis=-1) + result.outside)[0, 0, 0, 0]
    references = [room_radiosity(n, rho, laser, sensors) for n in (9, 18)]
    # second order in the patches: the finer solution is off by about a third of the change
    floor = np.abs(references[1] - references[0]).max() / references[1].mean()
    assert floor < 0.03
    sigma = np.sqrt(result.variance.sum()) / energies.size
    limit = t_limit(1, REPLICAS - 1)
    # bins of one room share samples that land in one or the other: the summed variance is an upper bound
    assert abs(energies.mean() - references[1].mean()) < limit * sigma + 0.5 * floor * references[1].mean()
    assert limit * sigma < 0.01 * energies.mean()


def room_radiosity(n: int, rho: float, laser: Array, sensors: Array) -> Array:
    """H summed over all bounces at sensor points on the floor of a diffuse cube [-1, 1]^2 x [0, 2]."""
    middle = np.array([0.0, 0.0, 1.0])
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            grid = grid_points(n, n, 2.0, 2.0).reshape(-1, 3)
            points = np.roll(grid, axis + 1, axis=-1)  # its z = 0 goes to axis ``axis``
            points[:, axis] = sign
            sides.append((points + middle, np.broadcast_to(-sign * np.eye(3)[axis], points.shape)))
    points, normals = (np.concatenate(parts) for parts in zip(*sides, strict=True))
    area = 4.0 / n**2

    def kernel(a: Array, a_normals: Array) -> Array:
        way = points[None] - a[:, None]
        r2 = np.maximum((way**2).sum(axis=-1), 1e-12)
        cosines = np.einsum("ijk,ik->ij", way, a_normals) * -np.einsum("ijk,jk->ij", way, normals)
        return np.maximum(cosines, 0) / r2**2

    up = np.array([[0.0, 0.0, 1.0]])
    form = kernel(points, normals) * area / np.pi
    form /= form.sum(axis=1, keepdims=True)  # closure: everything that leaves a patch arrives in the cube
    direct = rho * (rho / np.pi) * kernel(laser[None], up)[0]
    radiosity = np.linalg.solve(np.eye(len(points)) - rho * form, direct)
    flat = sensors.reshape(-1, 3)
    gathered = kernel(flat, np.broadcast_to(up, flat.shape)) @ radiosity * area
    return (rho / np.pi * gathered / np.pi).reshape(sensors.shape[:2])
