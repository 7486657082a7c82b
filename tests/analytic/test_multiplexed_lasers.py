"""Laser spots that one pulse lights at once: light adds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from support.rendering import configured, flat_wall, render

from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import ConfigError, FileError
from nlosrender.files.export.export import export_capture
from nlosrender.files.validation import check_file
from nlosrender.pipeline import render_capture
from nlosrender.rendering import stages

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0.05, 0.7], "normal": [0.2, 0.1, -1]}
FLOOR = {"type": "rectangle", "width": 1, "height": 0.5, "center": [-0.3, -0.7, 0.5], "normal": [0, 1, 0]}
ITEMS = (PLATE, FLOOR | {"up": [0, 0, 1]})
SPOTS, WEIGHTS = [[0.3, -0.2], [-0.5, 0.4], [0.0, 0.1], [0.6, 0.6]], [1, 2, 0.5, 3]
SHARES = np.array(WEIGHTS) / np.sum(WEIGHTS)
LEGS = {"account_first_and_last_bounces": True, "laser_position": [0.4, 0.3, 0.6]}
ROUNDING = 1e-6  # of sums of float32 terms, which laser after laser rounds otherwise


def multiplexed(weights: list[float] | None = WEIGHTS, **keys: Any) -> dict[str, Any]:
    capture = {**LEGS, "laser_spots": SPOTS, "multiplex": True, "laser_spot_weights": weights, "laser_point": None}
    return flat_wall(*ITEMS, sensors=(5, 3), capture=capture, bins=(0.0, 0.02, 400), **keys)


def single(point: list[float], **keys: Any) -> dict[str, Any]:
    return flat_wall(*ITEMS, sensors=(5, 3), capture=LEGS | {"laser_point": point}, bins=(0.0, 0.02, 400), **keys)


def off(found: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_spots_at_once_are_the_weighted_sum_of_single_captures() -> None:
    """One pulse of ``laser_energy`` is shared: H is the mean of single captures, weighted; the paths are the same."""
    together = render(multiplexed()).bounce(3)
    alone = [render(single(point)).bounce(3) for point in SPOTS]
    assert together.shape == alone[0].shape == (1, 1, 3, 5, 400)
    assert off(together, np.tensordot(SHARES, alone, axes=1)) < ROUNDING


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_spots_at_once_are_the_sum_over_an_exhaustive_capture(engine: str) -> None:
    """The lasers of an exhaustive capture with the same paths, or patches and VPLs, added up by their shares."""
    exhaustive = flat_wall(
        *ITEMS, scan="exhaustive", sensors=(5, 3), bins=(0.0, 0.02, 400), engine=engine, max_bounces=5
    )
    exhaustive["capture"] |= {**LEGS, "laser_grid": None, "laser_points": SPOTS}
    found = [_at_fixed_budget(config) for config in (multiplexed(engine=engine, max_bounces=5), exhaustive)]
    together, by_laser = found
    assert together.shape == (1, 4, 1, 15, 400)
    assert together[0, 2:].any()
    expected = np.einsum("l,csltb->cstb", SHARES, by_laser)
    if engine == "path":
        assert off(together[:, :, 0], expected) < ROUNDING
    else:  # VPLs choose contributions by the light of all lasers, and of other numbers of them: the third bounce alone
        assert off(together[:, 1, 0], expected[:, 1]) < ROUNDING


def _at_fixed_budget(config: dict[str, Any]) -> NDArray[np.float64]:
    from nlosrender.engine.interface import Budget

    if config["render"]["engine"] == "virtual_lights":
        config["render"] = {key: value for key, value in config["render"].items() if key != "spp"}
    validated = configured(config)
    backend = start_backend("llvm", colored=False, polarized=False)
    built = stages.load_scene(validated)
    plan, engine = stages.prepare(validated, backend, built, *stages.describe_capture(validated, built.wall, built))
    assert engine.name == config["render"]["engine"]
    budget = Budget(spp=512) if engine.name == "path" else Budget(patch_scale=0.5, rounds=1)
    return engine.render(plan.batches[0], budget).mean


def test_further_bounces_of_spots_at_once_agree_between_the_engines() -> None:
    """Virtual lights against paths, fourth bounce and up: three times the stated errors."""
    budget: dict[str, Any] = {"spp": None, "target_error": 0.1, "max_bounces": 5}
    lights, paths = (render(multiplexed(engine=engine, **budget)) for engine in ("virtual_lights", "path"))
    for bounce in (4, 5):
        one, other = lights.bounce(bounce), paths.bounce(bounce)
        variance = lights.bounce_variance(bounce).sum() + paths.bounce_variance(bounce).sum()
        assert 0 < np.linalg.norm(one - other) < 3 * np.sqrt(variance)


def test_equal_weights_are_no_weights() -> None:
    """Without weights the spots share the pulse equally."""
    assert np.array_equal(render(multiplexed(None)).mean, render(multiplexed([5.0] * 4)).mean)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"multiplex": False}, r"laser_spots: are lit at once.*set multiplex: true.*scan_type: exhaustive"),
        ({"laser_point": [0, 0]}, r"laser_point: stands beside laser_spots"),
        ({"laser_spots": None, "laser_spot_weights": None}, r"multiplex: is for laser_spots, which are missing"),
        ({"laser_spot_weights": [1, 2]}, r"laser_spot_weights: got 2 weights of 4 laser_spots"),
        ({"laser_spot_weights": [0, 0, 0, 0]}, r"laser_spot_weights: got .*, need a list of numbers >= 0, not all 0"),
        ({"laser_spots": [[0, 0], [0, 2]]}, r"laser_spots\.1: got \[0, 2\], off the relay wall"),
        ({"laser_spot_radius": 0.01}, r"laser_spot_radius: got 0\.01, need 0 with laser_spots"),
    ],
)
def test_what_spots_cannot_have_is_refused(changes: dict[str, Any], message: str) -> None:
    """Each mistake has its key and what to do."""
    described = multiplexed()
    described["capture"] |= changes
    with pytest.raises(ConfigError, match=message):
        configured(described)


def test_the_file_has_the_spots_and_refuses_to_pass_for_one_laser_point(tmp_path: Path) -> None:
    """Positions and shares are datasets of their own; what takes one laser point says that there are several."""
    path = tmp_path / "spots.hdf5"
    budget: dict[str, Any] = {"engine": "auto", "spp": None, "target_error": 0.2}
    render_capture(configured(multiplexed(**budget) | {"output": {"path": str(path)}}))
    with h5py.File(path) as file:
        assert file["data"].shape == (1, 400, 6, 3, 5, 1, 1)
        np.testing.assert_allclose(file["laserSpotShares"], SHARES, rtol=1e-6)
        np.testing.assert_allclose(file["laserSpotPositions"][[0, 2], 0].T, SPOTS, atol=1e-7)
        middle = file["laserGridPositions"][[0, 2], 0, 0]
        np.testing.assert_allclose(middle, SHARES @ np.array(SPOTS), atol=1e-7)
        assert file.attrs["laser_spots"].startswith("4 spots, lit at once")
    assert check_file(path).violations == ()
    with pytest.raises(FileError, match=r"spots were lit at once.*reconstruction takes one laser point"):
        reconstruct_capture(path, ReconstructionSettings())
    with pytest.raises(FileError, match=r"spots were lit at once.*format tal takes one laser point"):
        export_capture(path, tmp_path / "out.hdf5", "tal")
