"""One edge may throw a shadow for the laser and hide the same part of a patch from the sensor point."""

from __future__ import annotations

import numpy as np
import pytest
from support.agreement import t_limit
from support.rendering import flat_wall
from support.varied_scenes import Stage

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.8, "center": [0, 0, 0.9], "normal": [0.1, 0, -1]}
SCREEN = {"type": "rectangle", "width": 0.31, "height": 0.23, "center": [0.07, 0.04, 0.5], "normal": [0, 0, 1]}
SEEDS, FINE_SEEDS = range(60), range(8)
COARSE, FINE = 0.2, 0.02


@pytest.mark.parametrize(
    ("scan", "sensors", "lasers"),
    [
        pytest.param("single", {"nx": 1, "ny": 1}, {"laser_point": [0.0, 0.0]}, id="single", marks=pytest.mark.slow),
        pytest.param("exhaustive", {"nx": 1, "ny": 2}, {"laser_grid": {"nx": 1, "ny": 2}}, id="exhaustive"),
    ],
)
def test_shadows_of_one_edge_lose_no_light(scan: str, sensors: dict, lasers: dict) -> None:
    """With laser and sensor point in one place both see the same part s of a patch: it counts s, not s squared.

    Coarse patches, many of them cut by the screen's edge, against fine ones: the mean over seeds has no bias, up to
    the discretisation error, which is taken from the same plate without a screen.
    """
    grids = {"capture": {"scan_type": scan, "sensor_grid": sensors, "account_first_and_last_bounces": False, **lasers}}
    settings = {"scan": scan, "engine": "virtual_lights", "spp": None, "bins": (0.0, 0.5, 10)}
    stage, free = (Stage.of(flat_wall(*hidden, **settings) | grids) for hidden in ((PLATE, SCREEN), (PLATE,)))

    def energies(one: Stage, seed: int, patch_scale: float) -> np.ndarray:
        """Return the energy of every pair of laser and sensor point."""
        return one.seeded(seed).third.gather(one.batch, patch_scale).values.sum(axis=(0, 1, 4)).ravel()

    floor = np.abs(energies(free, 0, COARSE) / energies(free, 0, FINE) - 1).max()
    assert floor < 0.005
    sums = np.array([energies(stage, seed, COARSE) for seed in SEEDS])
    truth = np.mean([energies(stage, seed, FINE) for seed in FINE_SEEDS], axis=0)
    deviation = sums.std(axis=0, ddof=1) / np.sqrt(len(SEEDS))
    assert (deviation < 0.01 * truth).all()
    t = np.maximum(np.abs(sums.mean(axis=0) - truth) - floor * truth, 0) / deviation
    assert (t < t_limit(len(t), len(SEEDS) - 1)).all(), t
