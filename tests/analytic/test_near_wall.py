"""Surfaces almost on the wall: what a confocal point sees depends on angles alone, so H falls as 1 / h^2."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from support.rendering import Rendering, configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

POINT = (0.05, 0.05, 0.0)  # one of the four sensor points
WALKS = {"engine": "path", "max_bounces": 5, "spp": 65536}
TILTED = {"normal": [0.2, 0, -1]}


def plate(height: float, **pose: Any) -> dict[str, Any]:
    """A plate of 1 m whose centre stands over ``POINT``."""
    center = [POINT[0], POINT[1], height]
    return {"type": "rectangle", "width": 1.0, "height": 1.0, "center": center, "normal": [0, 0, -1], **pose}


def ball(height: float) -> dict[str, Any]:
    """A ball of 0.3 m whose nearest point stands over ``POINT``."""
    return {"type": "sphere", "radius": 0.3, "center": [POINT[0], POINT[1], 0.3 + height]}


def scene(item: dict[str, Any]) -> dict[str, Any]:
    """A confocal capture of 2 x 2 points 0.1 m apart."""
    grid = {"sensor_grid": {"nx": 2, "ny": 2, "width": 0.2, "height": 0.2}}
    return flat_wall(item, scan="confocal", sensors=(2, 2), bins=(0.0, 0.05, 80), capture=grid, spp=16384)


def warnings_of(config: dict[str, Any]) -> tuple[str, ...]:
    """Return what the scene's geometry is warned of."""
    backend = start_backend("llvm")
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    validated = configured(config)
    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    _, engine = stages.prepare(validated, backend, built, capture, time_axis)
    return scene_warnings(engine)


def energy(result: Rendering, height: float) -> float:
    """Return H of ``POINT`` over that of an endless parallel plate, 1 / (3 pi^2 h^2): see ``test_singularities``."""
    return float(result.total[0, 0, 1, 1].sum()) * 3 * np.pi**2 * height**2


@pytest.mark.parametrize("height", [1e-4, 1e-5, 1e-6, 1e-7, 1e-9])
def test_a_parallel_plate_has_its_closed_form(height: float) -> None:
    """H = 1 / (3 pi^2 h^2), however near: positions are told apart by the way from the wall, not by coordinates."""
    result = render(scene(plate(height)))
    # three standard errors of 16384 low-discrepancy paths are 0.3 %
    assert abs(energy(result, height) - 1) < 5e-3
    assert 0 < result.error_estimate < 5e-3


def test_light_between_the_wall_and_a_plate_close_to_it_goes_to_and_fro() -> None:
    """Bounce 5 goes from plate to wall and back: H_5 h^2 is the same for all h while the plate looks endless."""
    near, far = (render({**scene(plate(h)), "render": {**WALKS}}) for h in (1e-5, 1e-2))
    energies = [r.bounce(5).sum() * h**2 for r, h in ((near, 1e-5), (far, 1e-2))]
    # five standard errors of either; none in common, since positions in float32 lead to other paths
    noise = [np.sqrt(r.bounce_variance(5).sum()) * h**2 for r, h in ((near, 1e-5), (far, 1e-2))]
    assert energies[1] > 0
    assert abs(energies[0] - energies[1]) < 5 * np.hypot(*noise) + 0.01 * energies[1]
    assert np.hypot(*noise) < 0.05 * energies[1]


@pytest.mark.parametrize(
    ("item", "height", "tolerance"),
    # positions are good to 3e-8 of the wall's 2 m, which enters twice
    [(plate(1e-5, **TILTED), 1e-5, 0.01), (plate(1e-6, **TILTED), 1e-6, 0.03), (ball(1e-6), 1e-6, 0.05)],
    ids=["tilted", "tilted, nearer", "ball"],
)
def test_tilted_and_round_surfaces_are_right_to_float32(item: dict[str, Any], height: float, tolerance: float) -> None:
    """The same surface a thousand times farther away, where float32 does not matter, gives the same H h^2."""
    far = {**item, "center": [*item["center"][:2], item["center"][2] + 999 * height]}
    near, reference = energy(render(scene(item)), height), energy(render(scene(far)), 1000 * height)
    assert abs(near / reference - 1) < tolerance


@pytest.mark.parametrize(
    ("item", "is_known"), [(plate(1e-5), True), (plate(1e-7), False), (ball(1e-7), False)], ids=str
)
def test_heights_that_float32_does_not_know_are_said(item: dict[str, Any], is_known: bool) -> None:
    """The warning names height and place; nothing is said of a surface 1e-5 m away, nor is it taken for hidden."""
    said = warnings_of(scene(item))
    if is_known:
        assert said == ()
    else:
        place = r"lies \S+ m before the wall at \(-?0.05, -?0.05, 0\)"
        assert any(re.search(place, text) for text in said), said


@pytest.mark.parametrize(("height", "is_rare"), [(1e-3, True), (0.2, False)])
def test_light_that_hardly_a_path_finds_is_said(height: float, is_rare: bool) -> None:
    """A plate 1 mm before the laser point: half of H comes from there, and no path gets to it."""
    said = warnings_of(flat_wall(plate(height), spp=64))
    rare = [text for text in said if "before the laser point (0.3, -0.2, 0) m: only one path in" in text]
    assert bool(rare) == is_rare


def test_a_blind_almost_on_the_laser_point_stops_all_light() -> None:
    """What lies 1e-6 m before the laser point hides everything from it, and is itself hidden from the sensor points."""
    blind = {
        **plate(1e-6),
        "center": [0.3, -0.2, 1e-6],
        "width": 0.01,
        "height": 0.01,
        "bsdf": {"type": "diffuse", "reflectance": 0},
    }
    open_scene = flat_wall(plate(0.5), spp=1024)
    lit, dark = render(open_scene), render(flat_wall(plate(0.5), blind, spp=1024))
    assert lit.total.sum() > 0
    assert dark.total.sum() == 0


@pytest.mark.parametrize(("gap", "is_lost"), [(1e-6, True), (1e-5, True), (1e-4, False)])
def test_what_lies_within_the_ray_offset_of_a_curved_wall_is_said(gap: float, is_lost: bool) -> None:
    """Points of a sphere are not known exactly, so that rays leave it at an offset, and surfaces below it are lost."""
    item = {**plate(0.8 + gap), "center": [0.0, 0.0, 0.8 + gap], "width": 0.2, "height": 0.2}
    config = flat_wall(item, scan="confocal", sensors=(1, 1), spp=64)
    config["scene"]["relay_wall"] = {"type": "sphere", "radius": 0.8, "inside": False}
    said = warnings_of(config)
    assert any("on a curved wall, light within" in text for text in said) == is_lost
