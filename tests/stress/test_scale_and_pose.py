"""Laws of units and poses: H scales by exact powers, and does not know where the scene stands."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Ledger
from stressed import BOTH, PLATE, WITH_LEGS, Array, placed, relative_difference, scene
from support.rendering import render

SIDE = {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [-0.5, 0.0, 0.5], "normal": [1.0, 0.2, -0.1]}


def turned(seed: int) -> Array:
    """Return a random rotation (3, 3)."""
    basis, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return basis * np.sign(np.linalg.det(basis))


@pytest.mark.parametrize("engine", BOTH)
def test_other_units_are_the_same_scene(engine: str, ledger: Ledger) -> None:
    """Lengths times f: H times f^-2, in the same bins; to the last bit where f is a power of two."""
    config = scene(PLATE, SIDE, engine=engine, capture=WITH_LEGS)
    plain = render(config).mean
    for factor in (1e-3, 2.0**-10, 1e3):
        deviation = relative_difference(render(placed(config, factor)).mean * factor**2, plain)
        # float32: a position is off by 6e-8 of the scene, a bin is 1/64 of it, some ten roundings
        ledger.check(f"H times f^-2 in a scene of lengths times f ({engine})", deviation, 1e-5)


@pytest.mark.parametrize("engine", BOTH)
def test_a_scene_may_stand_anywhere(engine: str, ledger: Ledger) -> None:
    """Moved by 1e4 m and turned at random: float64 geometry loses 1e4 m * 1e-16 = 1e-12 m, float32 sees none of it."""
    config = scene(PLATE, SIDE, engine=engine, capture=WITH_LEGS)
    plain = render(config).mean
    for seed in range(3):
        origin = 1e4 * np.random.default_rng(seed).normal(size=3)
        deviation = relative_difference(render(placed(config, 1.0, turned(seed), origin)).mean, plain)
        ledger.check(f"the same H after a move by 1e4 m and any rotation ({engine})", deviation, 1e-5)
