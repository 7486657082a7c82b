"""The stated error of a capture's energy is the scatter of the energy over seeds, whoever shares VPLs or paths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.rendering import Scene, configured, flat_wall

from nlosrender import pipeline

GREY = {"type": "diffuse", "reflectance": 0.5}
ROOM = {"type": "room", "size": [2.0, 1.6, 2.0], "bsdf": GREY}
BALL = {"type": "sphere", "center": [0.2, 0, 0.8], "radius": 0.3, "bsdf": GREY}
# a plate that sensor points see and the laser does not, lit by one round the corner: few subpaths bring all the light
CORNER = (
    {"type": "rectangle", "width": 0.8, "height": 1.5, "center": [0.2, 0, 0.5], "normal": [1, 0, 0],
     "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}}},
    {"type": "rectangle", "width": 1.5, "height": 1.5, "center": [-0.5, 0, 1.2], "normal": [0, 0, -1], "bsdf": GREY},
    {"type": "rectangle", "width": 1.5, "height": 1.5, "center": [1.2, 0, 1.0], "normal": [-1, 0, 0], "bsdf": GREY},
)  # fmt: skip
SEEDS = 24  # the scatter itself is known to 1 / sqrt(2 * 23) = 15 %

CASES: dict[str, tuple[tuple[Scene, ...], dict[str, Any]]] = {
    "VPLs": ((ROOM, BALL), {"engine": "virtual_lights", "spp": None, "target_error": 0.1}),
    "VPLs of one round": (
        (ROOM, BALL),
        {"engine": "virtual_lights", "spp": None, "target_error": 0.3, "sensors": (12, 9)},
    ),
    "VPLs round a corner": (CORNER, {"engine": "virtual_lights", "spp": None, "target_error": 0.05}),
    "paths": ((ROOM, BALL), {"spp": 256}),
    "paths that lasers share": ((ROOM, BALL), {"spp": 256, "scan": "exhaustive", "lasers": (3, 2)}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_energy_scatters_over_seeds_as_stated(tmp_path: Path, case: str) -> None:
    """Of each bounce above the third, and of paths the third, too: within a factor of two, as a root mean square."""
    hidden, settings = CASES[case]
    energies, errors = [], []
    for seed in range(SEEDS):
        scene = flat_wall(*hidden, **({"max_bounces": 5, "sensors": (6, 4), "bins": (0.0, 0.1, 130)} | settings))
        changes = [f"render.seed={seed}", f"output.path={tmp_path / 'a.hdf5'}"]
        report = pipeline.render_capture(configured(scene, changes), resume=False)
        energies.append([report.energy[bounce] for bounce in ("3", "4", "5")])
        errors.append([report.energy_error_per_bounce[bounce] for bounce in ("3", "4", "5")])
    scatter, stated = np.std(energies, axis=0, ddof=1), np.sqrt(np.mean(np.square(errors), axis=0))
    first = 0 if "paths" in case else 1  # the third bounce of virtual lights has an error without scatter
    ratio = stated[first:] / scatter[first:]
    assert (ratio > 1 / 2).all(), ratio
    assert (ratio < 2).all(), ratio
