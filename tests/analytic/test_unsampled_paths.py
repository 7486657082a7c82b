"""Light that no technique finds: it is named where it is there, and only there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.rendering import Scene, configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages
from nlosrender.rendering.outcome import missing_light

GREY = {"type": "diffuse", "reflectance": 0.7}
BLACK = {"type": "diffuse", "reflectance": 0.0}
MIRROR = {"type": "conductor"}
POINT = "L D S+ (D|S)* D E"
BEAM = "L S+ (D|S)* D E"
LAMP = "L S+ D (D|S)* E"
PLASTIC_WALL = {"bsdf": {"type": "plastic"}}
BEHIND = {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [0, 0, 1.2], "normal": [0, 0, -1], "bsdf": GREY}


def plate(bsdf: Scene, **place: Any) -> Scene:
    place = {"width": 0.8, "height": 0.6, "center": [0.1, 0, 0.8], "normal": [0, 0, -1]} | place
    return {"type": "rectangle", "bsdf": dict(bsdf), **place}


def found(*hidden: Scene, **settings: Any) -> set[tuple[str, int]]:
    """Notation and first bounce of what the engine of a scene does not sample."""
    config = configured(flat_wall(*hidden, **({"max_bounces": 5} | settings)))
    backend = start_backend("llvm", colored=config.is_colored, polarized=config.render.polarized)
    _, engine, _ = stages.set_up_engine(config, backend)
    return {(paths.notation, paths.first_bounce) for paths in missing_light(engine)}


# the laser at x = 0.3 lights it from the left and below, and is mirrored to the right and upwards
SIDEWAYS = plate(MIRROR, center=[0.8, 0, 0.8], width=0.4, normal=[1, 0, -1])
ASIDE = plate(GREY, center=[2.0, 0, 1.4], width=2.0, height=2.0, normal=[-1, 0, 0])
BALL = {"type": "sphere", "center": [0.1, 0, 0.8], "radius": 0.3, "bsdf": MIRROR}
HALF_MIRROR = {"type": "mask", "opacity": 0.5, "bsdf": MIRROR}  # images are of whole mirrors alone
SPREAD = {
    "mirror": (MIRROR, set()),
    "smooth plastic": ({"type": "plastic"}, set()),
    "a blend": ({"type": "blendbsdf", "weight": 0.5, "a": GREY, "b": MIRROR}, set()),
    "twosided": ({"type": "twosided", "bsdf": MIRROR}, set()),
    "half a mirror": (HALF_MIRROR, {3, 5}),
    "a mirror and half a one": ({"type": "blendbsdf", "weight": 0.5, "a": MIRROR, "b": HALF_MIRROR}, {3, 5}),
    "glass": ({"type": "dielectric"}, {5}),
    "a thin pane": ({"type": "thindielectric"}, {5}),
    "half a mask": ({"type": "mask", "opacity": 0.5, "bsdf": GREY}, {5}),
    "a full mask": ({"type": "mask", "opacity": 1.0, "bsdf": GREY}, set()),
    "a blend of weight 0": ({"type": "blendbsdf", "weight": 0.0, "a": GREY, "b": MIRROR}, set()),
    "rough metal": ({"type": "roughconductor", "alpha": 0.1}, set()),
    "rough plastic": ({"type": "roughplastic"}, set()),
    "retroreflector": ({"type": "retroreflector", "width": 0.1, "albedo": 0.9}, set()),
    "rough glass": ({"type": "roughdielectric"}, set()),
    "Lambertian": (GREY, set()),
}


@pytest.mark.parametrize("kind", SPREAD)
def test_a_laser_point_is_not_found_through_anything_smooth(kind: str) -> None:
    """What a large surface before a plate lets through, to and fro (bounce 5), but what flat mirrors send is found."""
    bsdf, bounces = SPREAD[kind]
    assert found(plate(bsdf, width=3.0, height=3.0), BEHIND) == {(POINT, bounce) for bounce in bounces}


NOTHING_MISSING = {
    "it faces away": ([plate(MIRROR, normal=[0, 0, 1])], {}),
    "it is in the dark": ([plate(MIRROR), plate(BLACK, center=[0.1, 0, 0.4], width=1.6, height=1.6)], {}),
    "its light leaves the scene": ([SIDEWAYS], {}),
    "its light comes too late": ([plate(MIRROR)], {"bins": (0.0, 0.02, 70)}),
    "it takes more bounces": ([SIDEWAYS, ASIDE], {"max_bounces": 3}),
    "the laser has a spot": ([plate(MIRROR)], {"capture": {"laser_spot_radius": 0.02}}),
}


@pytest.mark.parametrize("reason", NOTHING_MISSING)
def test_nothing_is_said_of_mirrors_that_send_no_light(reason: str) -> None:
    """Where the light of a mirror cannot be in the capture, or is sampled, the error is known."""
    hidden, settings = NOTHING_MISSING[reason]
    assert found(*hidden, **settings) == set()


def test_images_are_of_one_flat_mirror() -> None:
    """What a flat mirror sends to a plate is found, but not what it sends to a mirror, and that to the wall."""
    assert found(SIDEWAYS, ASIDE) == set()
    assert found(SIDEWAYS, {**ASIDE, "bsdf": MIRROR}) == {(POINT, 4)}


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_every_scan_tells(scan: str) -> None:
    """A concave mirror shows laser points to sensor points (bounce 3) in any scan, which flat and convex ones may."""
    around = BALL | {"radius": 3.0, "inside": True}
    assert found(around, scan=scan, max_bounces=3, bins=(0.0, 0.1, 100)) == {(POINT, 3)}
    assert found(plate(MIRROR), BALL, scan=scan, max_bounces=3) == set()


@pytest.mark.parametrize("radius", [0.0, 0.02])
def test_a_glossy_wall_mirrors_the_beam_where_no_path_finds_it(radius: float) -> None:
    """The beam's reflection on the wall is a single ray, with a spot, too."""
    capture = {"laser_position": [0.0, -0.2, 0.5], "laser_spot_radius": radius}
    large = plate(GREY, width=3.0, height=3.0)
    assert found(large, wall=PLASTIC_WALL, capture=capture) == {(BEAM, 3)}
    assert found(plate(GREY, center=[-0.8, 0.5, 0.8]), wall=PLASTIC_WALL, capture=capture) == set()


VIEW = """
scene:
  hidden_geometry:
    - {type: rectangle, width: 4.0, height: 4.0, center: [0, 0, 2], normal: [0, 0, -1], bsdf: {type: diffuse}}
    - {type: rectangle, width: 1.0, height: 1.0, center: [1.0, 0, 1.0], normal: [-1, 0, 0], bsdf: {type: BSDF}}
  emitters: [LAMP]
capture:
  scan_type: line_of_sight
  camera: {position: [0, 0, -1], look_at: [0, 0, 1], width: 5, height: 3}
time_axis: {bin_width_opl: 0.05, n_bins: 200}
render: {max_bounces: HIGHEST, spp: 16}
"""
LAMPS = {
    "point": "{type: point, position: [0, 0.3, 1.0], intensity: 1.0}",
    "area": "{type: sphere, center: [0, 0.3, 1.0], radius: 0.1, radiance: 1.0}",
}


@pytest.mark.parametrize(
    ("lamp", "bsdf", "highest", "expected"),
    [
        ("point", "conductor", 3, {(LAMP, 2)}),
        ("point", "conductor", 1, set()),
        ("point", "roughconductor", 3, set()),
        ("area", "conductor", 3, set()),
    ],
)
def test_before_a_camera_lamps_without_extent_are_not_found_in_mirrors(
    lamp: str, bsdf: str, highest: int, expected: set[tuple[str, int]]
) -> None:
    """What a mirror sends from a point lamp to a surface (two interactions) is found by no connection."""
    text = VIEW.replace("LAMP", LAMPS[lamp]).replace("BSDF", bsdf).replace("HIGHEST", str(highest))
    config = configured(text)
    _, engine, _ = stages.set_up_engine(config, start_backend("llvm"))
    assert {(paths.notation, paths.first_bounce) for paths in missing_light(engine)} == expected


def test_what_a_point_finds_is_what_a_spot_finds() -> None:
    """Light of a mirror and a ball is found with a point whichever of the two it meets first, as reciprocity asks."""
    ball = {"type": "sphere", "center": [-0.5, 0.1, 0.5], "radius": 0.25, "bsdf": GREY}
    mirror = plate(MIRROR, width=1.2, height=1.0, center=[0.2, 0, 0.9])
    one, other = np.array([0.3, -0.2]), np.array([-0.1, 0.25])

    def bounces(laser: np.ndarray, sensor: np.ndarray, radius: float, spp: int) -> tuple[np.ndarray, np.ndarray]:
        grid = {"nx": 1, "ny": 1, "width": 4.0, "height": 4.0}
        capture = {"laser_point": (laser - sensor).tolist(), "laser_spot_radius": radius, "sensor_grid": grid}
        wall = {"center": [*sensor.tolist(), 0], "width": 4.0, "height": 4.0}
        scene = flat_wall(ball, mirror, bins=(0.0, 0.05, 200), wall=wall, capture=capture, max_bounces=4, spp=spp)
        result = render(scene)
        return (values[0].sum(axis=(1, 2, 3, 4, 5)) for values in (result.mean, result.variance))  # type: ignore[return-value]

    mean, variance = bounces(one, other, 0.0, 2**16)
    back, back_variance = bounces(other, one, 0.0, 2**16)
    spot, spot_variance = bounces(one, other, 0.15, 2**21)
    # H is curved on a scale of 1 m: the mean over the disc of radius r is within about r^2 / 4 + r^2 / 4 of its centre
    deviation = np.sqrt(variance + spot_variance)
    assert abs(spot[1] - mean[1]) < 5 * deviation[1] + 0.012 * spot[1]
    assert abs(spot[2] - mean[2]) < 5 * deviation[2] + 0.012 * spot[2]
    assert 5 * deviation[2] < 0.3 * mean[2]  # each of the two ways is about half of it
    assert abs(mean[2] - back[2]) < 5 * np.sqrt(variance + back_variance)[2]


def test_through_a_mask_a_spot_alone_finds_what_is_behind() -> None:
    """Half a mask lets a quarter of a plate's light through, to and fro: bounce 5 by a spot, none by a point."""
    large = plate({"type": "mask", "opacity": 0.5, "bsdf": BLACK}, width=6.0, height=6.0)
    settings: dict[str, Any] = {"sensors": (1, 1), "bins": (0.0, 0.1, 200), "max_bounces": 5}
    settings["capture"] = {"laser_point": [0.0, 0.0]}
    point = render(flat_wall(large, BEHIND, **settings, spp=2**14))
    assert point.total.sum() == 0
    settings["capture"] = {"laser_point": [0.0, 0.0], "laser_spot_radius": 0.2}
    spot = render(flat_wall(large, BEHIND, **settings, spp=2**20))
    settings["max_bounces"] = 3
    bare = render(flat_wall(BEHIND, **settings, spp=2**14))
    deviation = math.sqrt(float(spot.total_variance.sum() + bare.total_variance.sum() / 16))
    assert abs(spot.bounce(5).sum() - bare.bounce(3).sum() / 4) < 5 * deviation
    assert deviation < 0.03 * bare.bounce(3).sum()
