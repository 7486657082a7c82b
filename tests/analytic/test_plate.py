"""A plate in front of the wall against float64 quadrature, bin by bin."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.quadrature import (
    Setup,
    box_cells,
    clear_of_rectangle,
    confocal_third_bounces,
    grid_points,
    midpoints,
    rectangle_cells,
    third_bounce,
    third_bounces,
)
from support.rendering import flat_wall, render

REPLICAS = 32
# 400 x 400 cells of 2 mm, each put whole into the bin of its midpoint: an iso-delay strip of a 4 cm bin is about 10
# cells wide and 400 long, so its two edges misplace sqrt(2 * 400 / 12) of 4000 cells: 0.2 %.
QUADRATURE = 2e-3

PLATE = {
    "type": "rectangle",
    "width": 0.8,
    "height": 0.6,
    "center": [0.15, -0.1, 0.6],
    "normal": [0.2, -0.1, -1.0],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
CELLS = rectangle_cells(0.8, 0.6, PLATE["center"], PLATE["normal"])
BINS = (0.9, 0.04, 60)
EDGES = 0.9 + 0.04 * np.arange(61)
LASER = np.array([[[0.3, -0.2, 0.0]]])
SENSORS = grid_points(5, 3, 2.0, 1.6)


@functools.cache
def white_plate(scan: str) -> np.ndarray:
    """Quadrature of the plate with all albedos 1 and 1 J; exhaustive: 2 x 1 lasers."""
    setup = Setup(CELLS, EDGES)
    if scan == "confocal":
        return confocal_third_bounces(setup, SENSORS)
    return third_bounces(setup, LASER if scan == "single" else grid_points(2, 1, 1.5, 1.2), SENSORS)


@pytest.mark.parametrize("hidden_geometry_sampling", [True, False])
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_every_bin_is_that_of_quadrature(scan: str, hidden_geometry_sampling: bool) -> None:
    """H per bin of a tilted plate, wall albedo 0.9, 3 J, for every scan type and both ways to find the plate."""
    config = flat_wall(
        PLATE,
        scan=scan,
        lasers=(2, 1),
        wall={"bsdf": {"type": "diffuse", "reflectance": 0.9}},
        capture={"laser_energy": 3.0},
        bins=BINS,
        spp=16384 if hidden_geometry_sampling else 65536,
        hidden_geometry_sampling=hidden_geometry_sampling,
    )
    result = render(config, replicas=REPLICAS)
    reference = 3.0 * 0.9**2 * 0.7 * white_plate(scan)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_fractional_legs_shift_by_their_exact_length() -> None:
    """Legs that are no whole number of bins, against quadrature with them."""
    laser_position, sensor_position = np.array([-0.5, 0.0, 0.25]), np.array([0.4, 0.3, 1.1])
    config = flat_wall(
        PLATE,
        capture={
            "account_first_and_last_bounces": True,
            "laser_position": laser_position.tolist(),
            "sensor_position": sensor_position.tolist(),
        },
        bins=(1.5, 0.04, 100),
        spp=16384,
    )
    result = render(config, replicas=REPLICAS)
    edges = 1.5 + 0.04 * np.arange(101)
    laser_leg = float(np.linalg.norm(LASER[0, 0] - laser_position))
    rows = []
    for sensor in SENSORS.reshape(-1, 3):
        leg = float(np.linalg.norm(sensor - sensor_position))
        rows.append(
            third_bounce(Setup(CELLS, edges, rho=0.7, laser_leg=laser_leg, sensor_leg=leg), LASER[0, 0], sensor)
        )
    reference = np.array(rows).reshape(result.total.shape)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_legs_of_whole_bins_move_every_histogram_by_these_bins() -> None:
    """Sensor and laser 3-4-5 triangles away from their points: 1.25 m and 0.75 m of 1/16 m bins, the same samples."""
    sensor_point, laser_point = [0.0, 0.0, 0.0], [0.3, -0.2, 0.0]
    devices = {
        "laser_position": [laser_point[0] + 0.45, laser_point[1], 0.6],  # 0.75 m
        "sensor_position": [sensor_point[0], 0.75, 1.0],  # 1.25 m
    }
    without, with_legs = (
        render(
            flat_wall(
                PLATE,
                sensors=(1, 1),
                bins=(0.0, 0.0625, 80),
                capture={**devices, "account_first_and_last_bounces": counted},
            )
        )
        for counted in (False, True)
    )
    shift = 12 + 20
    # Legs are added in bins: whole bins leave the same float32 sums behind up to rounding of 0.75 / 0.0625 in float64,
    # which may move a sample that lies within 1e-7 of an edge; with 1024 samples none does.
    np.testing.assert_allclose(with_legs.total[..., shift:], without.total[..., :-shift], rtol=1e-12)
    assert with_legs.total[..., :shift].sum() == 0
    assert without.total[..., -shift:].sum() == 0


def test_a_box_shows_its_front_and_its_visible_sides() -> None:
    """A convex box is the sum of its sides, each with its own cosines: nothing hides anything else."""
    center, size = [0.3, 0.2, 0.7], [0.4, 0.3, 0.2]
    config = flat_wall({"type": "box", "center": center, "size": size}, bins=BINS, spp=32768)
    result = render(config, replicas=REPLICAS)
    reference = third_bounces(Setup(box_cells(center, size), EDGES), LASER, SENSORS)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


@pytest.mark.parametrize("hidden_geometry_sampling", [True, False])
def test_an_occluder_removes_what_visibility_says(hidden_geometry_sampling: bool) -> None:
    """A black rectangle before the plate hides it from laser and sensor as computed by intersecting segments."""
    occluder = {"center": [0.1, -0.05, 0.35], "normal": [0.1, 0.2, -1.0], "width": 0.25, "height": 0.2}
    black = {"type": "rectangle", **occluder, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    config = flat_wall(black, PLATE, bins=BINS, spp=65536, hidden_geometry_sampling=hidden_geometry_sampling)
    result = render(config, replicas=REPLICAS)
    hidden = clear_of_rectangle(**occluder)
    with_occluder = third_bounces(Setup(CELLS, EDGES, rho=0.7, visible=hidden), LASER, SENSORS)
    without = 0.7 * white_plate("single")
    assert with_occluder.sum() < 0.85 * without.sum()  # the occluder matters
    assert_agrees(result.total, result.total_variance, with_occluder, replicas=REPLICAS, floor=QUADRATURE)


@pytest.mark.parametrize("laser_sampling", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_laser_spot_is_the_average_over_its_disc(laser_sampling: bool) -> None:
    """H of a spot of 8 cm radius is the mean of H over laser points spread evenly over the disc."""
    radius = 0.08
    config = flat_wall(
        PLATE,
        sensors=(3, 2),
        capture={"laser_spot_radius": radius},
        bins=(0.8, 0.08, 30),
        spp=131072 if not laser_sampling else 32768,
        laser_sampling=laser_sampling,
    )
    result = render(config, replicas=REPLICAS)
    edges = 0.8 + 0.08 * np.arange(31)
    cells = rectangle_cells(0.8, 0.6, PLATE["center"], PLATE["normal"], n=120)
    setup = Setup(cells, edges, rho=0.7)
    # rings of equal area times angles: 12 x 16 points of the disc
    r, angle = np.meshgrid(radius * np.sqrt(midpoints(12)), 2 * np.pi * midpoints(16))
    spot = LASER[0, 0] + np.stack([r * np.cos(angle), r * np.sin(angle), 0 * r], axis=-1)
    sensors = grid_points(3, 2, 2.0, 1.6)
    reference = third_bounces(setup, spot, sensors).mean(axis=(0, 1), keepdims=True)
    # 192 discs points, shifted against the cells, average the cells' binning error away
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_a_plate_close_to_the_wall_is_that_of_quadrature() -> None:
    """1 cm from a 2 m wall: rays that start 1e-5 above the surface must not change the cosines of grazing paths."""
    near = {"width": 0.5, "height": 0.5, "center": [0.0, 0.0, 0.01], "normal": [0.0, 0.0, -1.0]}
    config = flat_wall({"type": "rectangle", **near}, sensors=(3, 2), bins=(0.0, 10.0, 1), spp=2**20)
    result = render(config, replicas=REPLICAS, p_hidden_sampling=1.0)
    cells = rectangle_cells(0.5, 0.5, near["center"], near["normal"], n=1000)  # 0.5 mm: (0.05)^2 / 24 of the integrand
    reference = third_bounces(Setup(cells, np.array([0.0, 10.0])), LASER, grid_points(3, 2, 2.0, 1.6))
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=1e-4)
    assert np.sqrt(result.variance.sum()) < 3e-3 * reference.sum()


@pytest.mark.parametrize("laser_sampling", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_what_a_spot_loses_over_the_wall_s_edge_is_lost(laser_sampling: bool) -> None:
    """A spot half on the wall lights it with half its energy, whichever way it is found."""
    plate = PLATE | {"center": [0.7, 0.0, 0.5], "normal": [0.0, 0.0, -1.0]}
    radius, laser = 0.1, np.array([1.0, 0.1, 0.0])
    config = flat_wall(
        plate,
        sensors=(3, 2),
        bins=(0.0, 10.0, 1),
        capture={"laser_spot_radius": radius, "laser_point": laser[:2].tolist()},
        laser_sampling=laser_sampling,
        spp=262144,
    )
    result = render(config, replicas=REPLICAS)
    cells = rectangle_cells(0.8, 0.6, plate["center"], plate["normal"], n=100)
    r, angle = np.meshgrid(radius * np.sqrt(midpoints(12)), np.pi * (0.5 + midpoints(16)))  # the half with x < 1
    spot = laser + np.stack([r * np.cos(angle), r * np.sin(angle), 0 * r], axis=-1)
    setup = Setup(cells, np.array([0.0, 10.0]), rho=0.7, energy=0.5)
    reference = third_bounces(setup, spot, grid_points(3, 2, 2.0, 1.6)).mean(axis=(0, 1), keepdims=True)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=1e-3)
