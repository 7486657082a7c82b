"""Laws of materials: energy never grows, black is black, and H is linear in what the surfaces reflect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Ledger
from stressed import BOTH, PLATE, noise_of, relative_difference, rendered, scene
from support.rendering import render


def diffuse(reflectance: object) -> dict:
    """Return a Lambertian BSDF."""
    return {"type": "diffuse", "reflectance": reflectance}


@pytest.mark.parametrize("spp", [1024, pytest.param(16384, marks=pytest.mark.stress)])
def test_a_white_furnace_keeps_its_energy(spp: int, ledger: Ledger) -> None:
    """In a closed white sphere H_k = 1 / (4 pi^2 R^2) for every bounce k: nothing is lost, nothing comes on top."""
    radius = 1.5
    config = scene(engine="path", spp=spp, max_bounces=7, bins=(0.0, 0.5, 64), sensors=(3, 2))
    config["scene"] = {"relay_wall": {"type": "sphere", "radius": radius, "bsdf": diffuse(1.0)}}
    config["capture"]["laser_point"] = [0.3, -0.2]
    result = render(config)
    law = "white furnace: energy of bounces 2 to 7 is that of a sphere"
    for bounce in range(2, 8):
        row = result.mean[0, result.bounces.slot(bounce)].sum(axis=-1) + result.outside[0, result.bounces.slot(bounce)]
        deviation = abs(row.mean() * 4 * np.pi**2 * radius**2 - 1)
        # 4 sigma of spp * 6 paths whose weights spread by about 1 around their mean of 1
        ledger.check(law, float(deviation), 4 / np.sqrt(6 * spp))


@pytest.mark.parametrize("engine", BOTH)
def test_black_is_black(engine: str, ledger: Ledger) -> None:
    """Reflectance 0 of the wall or of all hidden surfaces: exactly nothing."""
    for changes in ({"wall": {"bsdf": diffuse(0.0)}}, {"hidden": diffuse(0.0)}):
        plate = {**PLATE, "bsdf": changes.get("hidden", PLATE["bsdf"])}
        result = rendered(plate, engine=engine, wall=changes.get("wall", {}), sensors=(3, 2))
        ledger.check(f"light from black surfaces ({engine})", float(result.mean.sum() + result.outside.sum()), 0.0)


@pytest.mark.parametrize("engine", BOTH)
def test_the_third_bounce_is_linear_in_the_reflectance(engine: str, ledger: Ledger) -> None:
    """H(rho) = rho H(1), down to 1e-6: the same samples, the same patches."""
    settings = {"engine": engine, "max_bounces": 3, "sensors": (3, 2)}
    white = rendered({**PLATE, "bsdf": diffuse(1.0)}, **settings).mean
    for reflectance in (0.5, 1e-3, 1e-6):
        dim = rendered({**PLATE, "bsdf": diffuse(reflectance)}, **settings).mean
        deviation = relative_difference(dim / reflectance, white)
        ledger.check(f"the third bounce is linear in the reflectance ({engine})", deviation, 1e-5)  # float32 weights


@pytest.mark.parametrize("engine", BOTH)
def test_a_texture_of_one_value_is_that_number(engine: str, ledger: Ledger) -> None:
    """A checkerboard with two equal fields."""
    board = {"type": "checkerboard", "color0": 0.7, "color1": 0.7, "to_uv": [{"scale": 4.0}]}
    settings = {"engine": engine, "max_bounces": 3, "sensors": (3, 2)}
    plain, textured = rendered(PLATE, **settings), rendered({**PLATE, "bsdf": diffuse(board)}, **settings, color="grey")
    deviation = relative_difference(textured.mean, plain.mean)
    ledger.check(f"a texture of one value is that number ({engine})", deviation, noise_of(plain, textured))


@pytest.mark.stress
@pytest.mark.parametrize("alpha", [0.5, 0.2, 0.1, 0.05, 0.01])
def test_rough_metals_agree_or_are_handed_over(alpha: float, ledger: Ledger) -> None:
    """Down to a mirror: what the gather renders, the paths confirm; `auto` gives it what it can do only."""
    plate = {**PLATE, "bsdf": {"type": "roughconductor", "alpha": alpha, "distribution": "ggx"}}
    settings = {"max_bounces": 3, "sensors": (3, 2)}
    auto = rendered(plate, engine="virtual_lights", **settings)
    paths = rendered(plate, engine="path", spp=65536, **settings)
    # a lobe of width alpha spans few patches: three times both errors
    allowed = 1.5 * noise_of(auto, paths) + 0.02
    ledger.check(
        f"rough metal, alpha {alpha:g}: gather against paths", relative_difference(auto.mean, paths.mean), allowed
    )


def test_images_with_impossible_values_are_refused(tmp_path: Path) -> None:
    """NaN, negative values and reflectances above 1 in an image are named before they reach a histogram."""
    from nlosrender.errors import ConfigError

    image = tmp_path / "bad.pfm"
    for value in (np.nan, -1.0, 3.0, np.inf):
        image.write_bytes(b"Pf\n2 2\n-1.0\n" + np.array([0.5, value, 0.5, 0.5], "<f4").tobytes())
        texture = {"type": "bitmap", "filename": str(image), "raw": True}
        with pytest.raises(ConfigError, match=r"1 of 4 values of the image, such as .*, are not from 0 to 1"):
            rendered({**PLATE, "bsdf": diffuse(texture)}, engine="path", color="grey")
