"""Polarised line-of-sight captures: Fresnel's and Brewster's closed forms, and Mitsuba's own Stokes vectors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.agreement import t_limit, worst_t
from support.views import REPLICAS, View, see, steady_reference, view_config

from nlosrender.config.load import load_config

ROOT = Path(__file__).parents[2]
INDEX = 1.5
RADIANCE = 2.0
POINT = {"fov_deg": 0.01, "width": 1, "height": 2}  # so narrow that every path has the same angle


def steady_of_plate(angle: float, roll: float = 0.0) -> np.ndarray:
    """Return the Stokes vector (4,) of a lamp mirrored in a dielectric plate, seen at an angle [rad] to its normal.

    The camera is turned about its axis by ``roll`` [rad].
    """
    up, away = np.array([0, np.cos(angle), 0]), np.array([0, 0, np.sin(angle)])
    plate = {"type": "rectangle", "width": 1, "height": 1, "center": [0, 0, 0], "normal": [0, 1, 0], "up": [0, 0, 1]}
    plate |= {"bsdf": {"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0}}
    lamp = {"type": "rectangle", "width": 1, "height": 1, "center": (2 * (up - away)).tolist(), "radiance": RADIANCE}
    lamp |= {"normal": (away - up).tolist(), "up": [1, 0, 0]}
    sideways = np.array([1.0, 0, 0])
    upright = np.cross(up + away, sideways)
    turned = np.cos(roll) * upright + np.sin(roll) * sideways
    camera = POINT | {"position": (4 * (up + away)).tolist(), "look_at": [0, 0, 0], "up": turned.tolist()}
    view = see(view_config(plate, emitters=[lamp], camera=camera, polarized=True, max_bounces=1, spp=2**18))
    return view.steady.mean(axis=(1, 2))


def fresnel(angle: float) -> tuple[float, float]:
    """Return the reflectances across and in the plane of incidence (Fresnel's equations)."""
    inside = np.sqrt(INDEX**2 - np.sin(angle) ** 2)
    s = (np.cos(angle) - inside) / (np.cos(angle) + inside)
    p = (INDEX**2 * np.cos(angle) - inside) / (INDEX**2 * np.cos(angle) + inside)
    return s**2, p**2


@pytest.mark.parametrize("angle", [0.4, np.arctan(INDEX), 1.2])
def test_a_dielectric_plate(angle: float) -> None:
    """I = (Rs + Rp) / 2 L, Q = (Rs - Rp) / 2 L: at Brewster's angle everything is polarised along the plate."""
    s, p = fresnel(angle)
    stokes = steady_of_plate(angle)
    # reflection or transmission is a choice: binomial, 5 sigma of 2^19 paths
    tolerance = 5 * np.sqrt((s + p) / 2 / 2**19) * RADIANCE
    assert stokes[0] == pytest.approx(RADIANCE * (s + p) / 2, abs=tolerance)
    assert stokes[1] / stokes[0] == pytest.approx((s - p) / (s + p), abs=1e-3)  # every path has this ratio
    assert stokes[2:] == pytest.approx(0, abs=1e-3 * stokes[0])
    if angle == np.arctan(INDEX):
        assert stokes[1] == pytest.approx(stokes[0], rel=1e-4)


def test_a_turned_camera() -> None:
    """A camera turned by an angle turns Q and U by twice that angle."""
    s, p = fresnel(1.2)
    turned = steady_of_plate(1.2, roll=0.3)
    degree = (s - p) / (s + p)
    assert turned[1] / turned[0] == pytest.approx(degree * np.cos(0.6), abs=1e-3)
    assert abs(turned[2]) / turned[0] == pytest.approx(degree * np.sin(0.6), abs=1e-3)


def assert_is_mitsubas(view: View, spp: int) -> None:
    """Compare every component of every pixel with Mitsuba's ``stokes`` integrator."""
    reference, noise = steady_reference(view, spp)
    variance = view.variance.sum(axis=(1, 4)) + noise
    # components that are exactly zero, and noise of one path that moved them by nothing, state nothing
    t, n = worst_t(view.steady, variance, reference, floor=1e-5 * reference[0].max())
    assert n > view.steady[0].size
    assert t <= t_limit(n, REPLICAS - 1), f"|t| = {t:.2f} over {n} components"


def metal_and_glass(**render: Any) -> dict[str, Any]:
    """A scene in which nearly all light is polarised, seen at a wide angle."""
    floor = {"type": "rectangle", "width": 6, "height": 6, "center": [0, -1, 0], "normal": [0, 1, 0], "up": [0, 0, 1]}
    floor |= {"bsdf": {"type": "roughconductor", "material": "Cu", "alpha": 0.2}}
    ball = {"type": "sphere", "center": [0.3, 0, 0.3], "radius": 0.7, "bsdf": {"type": "dielectric", "int_ior": 1.6}}
    back = {"type": "rectangle", "width": 6, "height": 6, "center": [0, 0, -1.5], "normal": [0, 0, 1], "radiance": 1.0}
    back |= {"bsdf": {"type": "diffuse", "reflectance": 0.5}}
    side = {"type": "rectangle", "width": 3, "height": 3, "center": [-2, 0.5, 0], "normal": [1, 0, 0.3], "radiance": 3}
    camera = {"position": [0.3, 1, 2.5], "fov_deg": 70}
    lamps = [back, side]
    return view_config(floor, ball, emitters=lamps, camera=camera, **({"polarized": True, "max_bounces": 4} | render))


def test_metal_and_glass() -> None:
    """All four components, off the picture's axis, too."""
    assert_is_mitsubas(see(metal_and_glass(spp=32768)), 2048)


def test_polarised_cornell_box() -> None:
    """Glass, gold and a thin bubble in a box of matt walls."""
    small = ["capture.camera.width=9", "capture.camera.height=7", "time_axis.n_bins=40", "time_axis.bin_width_opl=0.4"]
    path = ROOT / "configs/paper/polarised-cornell-box.yaml"
    assert_is_mitsubas(see(load_config(path, [*small, "render.spp=8192", "render.max_bounces=3"])), 512)


def test_no_light_is_more_than_polarised() -> None:
    """Q^2 + U^2 + V^2 <= I^2 in every bin: it holds for every path, so for every sum of paths."""
    view = see(metal_and_glass(spp=256))
    stokes = view.mean.sum(axis=1)
    assert (np.linalg.norm(stokes[1:], axis=0) > 0.3 * stokes[0]).any()
    assert (np.linalg.norm(stokes[1:], axis=0) <= stokes[0] * (1 + 1e-4) + 1e-9).all()  # float32 Mueller matrices


def test_matt_surfaces_depolarise() -> None:
    """A matt scene has Q = U = V = 0 exactly, and the intensity of the unpolarised render, path by path."""
    wall = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 0], "normal": [0.2, 0, 1]}
    block = {"type": "box", "center": [0, 0, 0.3], "size": [0.5, 0.4, 0.3], "bsdf": {"type": "diffuse"}}
    lamp = {"type": "sphere", "center": [-0.5, 0.4, 0.8], "radius": 0.2, "radiance": 2.0}
    polarised = see(view_config(wall, block, emitters=[lamp], polarized=True))
    grey = see(view_config(wall, block, emitters=[lamp], color="grey"))
    assert not polarised.mean[1:].any()
    assert polarised.mean[0] == pytest.approx(grey.mean[0], rel=1e-4, abs=1e-6)
