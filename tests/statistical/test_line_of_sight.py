"""The sum over time of a line-of-sight capture is the steady picture of Mitsuba's own integrators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.agreement import t_limit, worst_t
from support.views import REPLICAS, View, see, steady_reference, view_config

from nlosrender.config.load import load_config

ROOT = Path(__file__).parents[2]
SMALL = ("capture.camera.width=7", "capture.camera.height=5", "time_axis.n_bins=40", "time_axis.bin_width_opl=0.4")
LAMP = {"type": "rectangle", "width": 1.2, "height": 0.9, "center": [0.2, 1.9, 0.3], "normal": [0, -1, 0]}
LAMP |= {"up": [0, 0, 1], "radiance": 3.0, "bsdf": {"type": "diffuse", "reflectance": 0.4}}
FLOOR = {"type": "rectangle", "width": 4, "height": 4, "center": [0, -1, 0], "normal": [0, 1, 0], "up": [0, 0, 1]}
BACK = {"type": "rectangle", "width": 4, "height": 4, "center": [0, 0, -1.5], "normal": [0, 0, 1]}


def assert_is_steady(view: View, spp: int) -> None:
    """Compare every pixel and channel, and the picture as a whole."""
    reference, noise = steady_reference(view, spp)
    steady, variance = view.steady, view.variance.sum(axis=(1, 4))
    reference, noise = reference[: len(steady)], noise[: len(steady)]
    means = [*np.ravel(steady), steady.sum()]
    variances = [*np.ravel(variance + noise), (variance + noise).sum()]
    t, n = worst_t(means, variances, [*np.ravel(reference), reference.sum()], floor=2e-6 * reference.max())
    assert t <= t_limit(n, REPLICAS - 1), f"|t| = {t:.2f} over {n} pixels"


def test_cornell_box() -> None:
    """Lamp seen directly, blocks, colours: every path of a diffuse scene."""
    config = load_config(ROOT / "configs/paper/cornell-box.yaml", [*SMALL, "render.spp=16384", "render.max_bounces=4"])
    assert_is_steady(see(config), 1024)


def test_mirror_and_glass() -> None:
    """Delta lobes find the lamp alone, rough ones share it with emitter sampling."""
    mirror = {"type": "rectangle", "width": 1, "height": 1.5, "center": [-0.9, 0, -0.5], "normal": [1, 0, 1]}
    ball = {"type": "sphere", "center": [0.6, -0.5, 0.3], "radius": 0.45, "bsdf": {"type": "dielectric"}}
    rough = {"type": "sphere", "center": [-0.3, -0.6, 0.6], "radius": 0.3}
    config = view_config(
        FLOOR,
        BACK,
        mirror | {"bsdf": {"type": "conductor", "material": "Al"}},
        ball,
        rough | {"bsdf": {"type": "roughconductor", "material": "Cu", "alpha": 0.2}},
        emitters=[LAMP, {"type": "point", "position": [0, 0.4, 1.2], "intensity": 0.8}],
        spp=32768,
        max_bounces=5,
        color="grey",
    )
    assert_is_steady(see(config), 2048)


def test_spot_in_a_scene_of_another_size() -> None:
    """Engine units are hidden: a spot lights a scene a thousand times smaller as it should."""
    floor = FLOOR | {"width": 0.004, "height": 0.004, "center": [0, -0.001, 0]}
    spot = {"type": "spot", "position": [0.0005, 0.001, 0], "look_at": [0, -0.001, 0], "intensity": 1e-6}
    camera = {"position": [0, 0.002, 0.004], "look_at": [0, -0.001, 0]}
    view = see(view_config(floor, emitters=[spot], camera=camera, spp=16384, bins=(0, 0.001, 20)))
    assert view.engine.built.metres_per_engine_unit < 0.01
    assert_is_steady(view, 1024)


def test_mitsuba_xml() -> None:
    """A scene read from XML is the same scene, camera and film included."""
    scene = ROOT / "scenes" / "glass-and-mirror.xml"
    text = f"scene: {{mitsuba: {scene}}}\ncapture: {{scan_type: line_of_sight}}\n"
    text += "time_axis: {n_bins: 60, bin_width_opl: 0.2}\nrender: {max_bounces: 4, spp: 1024}\n"
    view = see(text)
    assert view.steady.shape == (3, 32, 48)  # the mirror is silver, which has a colour
    reference, noise = steady_reference(view, 64)
    # caustics of glass and mirror are found by chance: blocks of 8 x 8 pixels are near enough to normal
    noise += view.variance.sum(axis=(1, 4))
    blocks = [a.reshape(3, 4, 8, 6, 8).sum(axis=(2, 4)) for a in (view.steady, noise, reference)]
    t, n = worst_t(*blocks)
    assert t <= t_limit(n, REPLICAS - 1), f"|t| = {t:.2f} over {n} blocks"


def test_a_sky_has_no_arrival_time(tmp_path: Path) -> None:
    """Light from infinitely far away belongs to the steady picture, and to no bin."""
    (tmp_path / "sky.xml").write_text(
        '<scene version="3.0.0"><shape type="sphere"/><emitter type="constant"/></scene>', encoding="utf-8"
    )
    view = see(view_config(emitters=[], scene={"mitsuba": "sky.xml"}, spp=1024), folder=tmp_path)
    assert not view.mean.any()
    assert_is_steady(view, 256)


@pytest.mark.slow
def test_interior() -> None:
    """The interior of the paper's configurations."""
    path = ROOT / "configs/paper/interior-mirror.yaml"
    assert_is_steady(see(load_config(path, [*SMALL, "render.spp=262144", "render.max_bounces=4"])), 16384)
