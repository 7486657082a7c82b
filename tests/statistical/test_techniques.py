"""Every technique estimates the same H: with any subset of them the results agree within their noise."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.rendering import Rendering, flat_wall, render

REPLICAS = 32
PLATE = {
    "type": "rectangle",
    "width": 0.8,
    "height": 0.6,
    "center": [0.15, -0.1, 0.5],
    "normal": [0.2, -0.1, -1.0],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
# A side wall, seen by the plate and the relay wall: bounces 4 and 5 go over it and over the relay wall.
SIDE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [-0.6, 0.0, 0.55], "normal": [1.0, 0.1, -0.2]}
BALL = {"type": "sphere", "center": [0.5, 0.3, 0.3], "radius": 0.15, "bsdf": {"type": "diffuse", "reflectance": 0.6}}


def spot_scene(**changes: object) -> dict:
    """A laser spot of 15 cm radius, so that chance finds it; coarse bins."""
    settings: dict = {
        "sensors": (3, 2),
        "bins": (0.4, 0.15, 30),
        "capture": {"laser_spot_radius": 0.15},
        "wall": {"bsdf": {"type": "diffuse", "reflectance": 0.9}},
        "max_bounces": 5,
        "split_bounces": False,
        "spp": 65536,
    }
    return flat_wall(PLATE, SIDE, BALL, **(settings | changes))


@functools.cache
def all_techniques(max_bounces: int) -> Rendering:
    """Both samplings on; the reference of the others."""
    return render(spot_scene(max_bounces=max_bounces, seed=77, spp=262144), replicas=REPLICAS)


@pytest.mark.parametrize("max_bounces", [pytest.param(3, marks=pytest.mark.slow), 5])
@pytest.mark.parametrize(("laser", "hidden"), list(itertools.product([True, False], repeat=2)))
def test_every_subset_of_the_paper_s_techniques_agrees(laser: bool, hidden: bool, max_bounces: int) -> None:
    """Laser sampling x hidden geometry sampling (Royo et al. 2022, the four-way ablation): one H."""
    config = spot_scene(
        laser_sampling=laser, hidden_geometry_sampling=hidden, max_bounces=max_bounces, spp=65536 if laser else 2**20
    )
    result, reference = render(config, replicas=REPLICAS), all_techniques(max_bounces)
    assert_agrees(
        result.total,
        result.total_variance,
        reference.total,
        reference_variance=reference.total_variance,
        replicas=REPLICAS,
        # found by chance, a spot gives few large deposits: joined until they are many enough to be normal
        share=0.05 if laser else 0.15,
    )


@functools.cache
def mixed(scan: str, p_hidden_sampling: float, seed: int) -> Rendering:
    """Bounces 3 to 5 with a share of hidden geometry sampling at wall vertices."""
    config = spot_scene(
        scan=scan, lasers=(1, 2), capture={}, split_bounces=True, bins=(0.3, 0.1, 40), spp=196608, seed=seed
    )
    return render(config, replicas=REPLICAS, p_hidden_sampling=p_hidden_sampling)


@pytest.mark.parametrize("p_hidden_sampling", [0.0, pytest.param(0.3, marks=pytest.mark.slow), 1.0])
@pytest.mark.parametrize("scan", [pytest.param("single", marks=pytest.mark.slow), "exhaustive"])
def test_the_mixture_does_not_change_the_result(scan: str, p_hidden_sampling: float) -> None:
    """Any share of hidden geometry sampling at wall vertices agrees with a half, bounce by bounce."""
    result, reference = mixed(scan, p_hidden_sampling, 0), mixed(scan, 0.5, 5)
    # Bounces 4 and 5 found by chance are few large deposits: joined until they are many enough to be normal.
    for bounce, share in ((3, 0.05), (4, 0.2), (5, 0.2)):
        assert_agrees(
            result.bounce(bounce),
            result.bounce_variance(bounce),
            reference.bounce(bounce),
            reference_variance=reference.bounce_variance(bounce),
            replicas=REPLICAS,
            share=share,
        )


def test_a_wall_with_a_mirror_lobe_keeps_it() -> None:
    """Smooth plastic mirrors a part of the light in one direction, which no point sampled on the plate can meet."""
    large = PLATE | {"width": 1.6, "height": 1.4, "normal": [0.0, 0.0, -1.0], "center": [0.0, 0.0, 0.6]}
    config = flat_wall(
        large,
        sensors=(3, 2),
        bins=(0.8, 0.2, 20),
        wall={"bsdf": {"type": "plastic", "diffuse_reflectance": 0.4}},
        capture={"sensor_position": [0.3, 0.2, 0.5]},
        spp=131072,
    )
    chosen, mixed, by_chance = (
        render(config | {"render": config["render"] | {"seed": seed}}, replicas=REPLICAS, p_hidden_sampling=fraction)
        for seed, fraction in enumerate((None, 0.5, 0.0))
    )
    for result in (chosen, mixed):
        assert_agrees(
            result.total,
            result.total_variance,
            by_chance.total,
            reference_variance=by_chance.total_variance,
            replicas=REPLICAS,
            share=0.05,
        )


CURVED = {
    "sphere": {"type": "sphere", "radius": 0.8, "inside": True},
    "cylinder": {"type": "cylinder", "radius": 0.6, "height": 1.4, "inside": True},
    "ball": {"type": "sphere", "radius": 0.5, "inside": False},
}


@pytest.mark.parametrize("shape", CURVED)
def test_hidden_geometry_before_a_curved_wall_is_found_either_way(shape: str) -> None:
    """Walls that light themselves, and a ball that lights nothing of itself: mixture against BSDF sampling alone."""
    hidden = [BALL | {"center": [0.2, 0.1, -0.1]}, PLATE | {"width": 0.3, "height": 0.2, "center": [-0.1, 0.3, 0.3]}]
    if shape == "ball":
        hidden = [BALL | {"center": [0.2, 0.1, 0.9]}, PLATE | {"center": [-0.3, 0.3, 1.0]}]
    mixed, by_chance = (
        render(
            flat_wall(*hidden, bins=(0.0, 0.2, 30), max_bounces=5, spp=131072, seed=seed)
            | {
                "scene": {
                    "relay_wall": CURVED[shape] | {"bsdf": {"type": "diffuse", "reflectance": 0.6}},
                    "hidden_geometry": hidden,
                },
                "capture": {
                    "scan_type": "single",
                    "sensor_grid": {"nx": 3, "ny": 2, "width": 0.9, "height": 0.7},
                    "laser_point": [0.2, -0.1],
                    "account_first_and_last_bounces": False,
                },
            },
            replicas=REPLICAS,
            p_hidden_sampling=p_hidden_sampling,
        )
        for seed, p_hidden_sampling in enumerate((0.5, 0.0))
    )
    assert (mixed.bounce(2).sum() > 0) == (shape != "ball")
    np.testing.assert_array_equal(mixed.bounce(2), by_chance.bounce(2))
    for bounce in (3, 4, 5):
        assert_agrees(
            mixed.bounce(bounce),
            mixed.bounce_variance(bounce),
            by_chance.bounce(bounce),
            reference_variance=by_chance.bounce_variance(bounce),
            replicas=REPLICAS,
            share=0.05 if bounce == 3 else 0.2,
        )


@pytest.mark.parametrize("max_bounces", [5, None])
def test_russian_roulette_does_not_change_the_result(max_bounces: int | None) -> None:
    """Paths ended by chance are made up for by those that go on."""
    limit = 25 if max_bounces is None else max_bounces  # 0.5^22 of the light is above bounce 25
    with_roulette, without = (
        render(
            spot_scene(russian_roulette=flag, capture={}, max_bounces=max_bounces if flag else limit, seed=seed),
            replicas=REPLICAS,
        )
        for flag, seed in ((True, 1), (False, 2))
    )
    assert_agrees(
        with_roulette.total,
        with_roulette.total_variance,
        without.total,
        reference_variance=without.total_variance,
        replicas=REPLICAS,
        share=0.05,
    )


@pytest.mark.parametrize("max_bounces", [3, 4])
def test_swapping_lasers_and_sensors_transposes_the_capture(max_bounces: int) -> None:
    """Helmholtz reciprocity: H(l, s) = H(s, l), with the devices swapped as well."""
    devices = {"laser_position": [-0.5, 0.3, 0.9], "sensor_position": [0.7, -0.1, 1.3]}
    grids = {"laser_grid": {"nx": 2, "ny": 3, "width": 1.5, "height": 1.2}, "sensor_grid": {"nx": 5, "ny": 4}}
    swapped = {
        "laser_position": devices["sensor_position"],
        "sensor_position": devices["laser_position"],
        "laser_grid": grids["sensor_grid"],
        "sensor_grid": grids["laser_grid"],
    }
    common = {"account_first_and_last_bounces": True}
    one, other = (
        render(
            flat_wall(
                PLATE,
                SIDE,
                scan="exhaustive",
                bins=(1.5, 0.1, 60),
                capture={**capture, **common},
                max_bounces=max_bounces,
                spp=16384,
                seed=seed,
            ),
            replicas=REPLICAS,
        )
        for seed, capture in enumerate((devices | grids, swapped))
    )
    for bounce in range(3, max_bounces + 1):
        assert_agrees(
            one.bounce(bounce),
            one.bounce_variance(bounce),
            other.bounce(bounce).transpose(2, 3, 0, 1, 4),
            reference_variance=other.bounce_variance(bounce).transpose(2, 3, 0, 1, 4),
            replicas=REPLICAS,
            share=0.05,
        )


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("face_normals", [True, False])
def test_both_ways_to_find_a_bunny_agree(bunny: object, scan: str, face_normals: bool) -> None:
    """A mesh of thousands of triangles that hide each other: hidden geometry sampling against BSDF sampling."""
    item = {"type": "mesh", "filename": str(bunny), "translate": [0.1, 0.0, 0.8], "face_normals": face_normals}
    item |= {"rotate_deg": [0.0, 150.0, 0.0]}
    results = [
        render(
            flat_wall(
                item,
                scan=scan,
                sensors=(3, 2),
                lasers=(1, 2),
                bins=(0.8, 0.1, 40),
                hidden_geometry_sampling=flag,
                spp=65536,
                seed=int(flag),
            ),
            replicas=REPLICAS,
        )
        for flag in (True, False)
    ]
    hidden, by_chance = results
    # Hidden geometry sampling misses what float32 cannot tell from the next triangle: 1e-7 of the scene at the edges of
    # triangles of 1e-2, 3 edges: 1e-4.
    assert_agrees(
        hidden.total,
        hidden.total_variance,
        by_chance.total,
        reference_variance=by_chance.total_variance,
        replicas=REPLICAS,
        floor=2e-4,
    )
    assert np.sqrt(by_chance.variance.sum()) < 0.02 * by_chance.mean.sum()
