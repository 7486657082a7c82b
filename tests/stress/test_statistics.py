"""Laws of statistics: no bias at a thousandth of the energy, errors as large as they are said to be, fresh noise."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from conftest import Ledger
from stressed import ENGINES, PLATE, scene
from support.quadrature import Setup, grid_points, rectangle_cells, third_bounces
from support.rendering import render

BINS = (0.9, 0.04, 60)
CELLS = rectangle_cells(PLATE["width"], PLATE["height"], PLATE["center"], PLATE["normal"], n=800)
SENSORS, LASER = grid_points(3, 2, 2.0, 1.6), np.array([[[0.3, -0.2, 0.0]]])


@functools.cache
def truth() -> np.ndarray:
    """Return the third bounce by quadrature, (1, 1, 2, 3, bins): cells of 1 mm, off by (h / d)^2 / 24 = 1e-7."""
    return 0.7 * third_bounces(Setup(CELLS, BINS[0] + BINS[1] * np.arange(BINS[2] + 1)), LASER, SENSORS)


@pytest.mark.stress
@pytest.mark.parametrize(("sampling", "fraction"), [(True, 0.1), (True, 0.5), (True, 1.0), (False, None)])
def test_no_mix_of_techniques_is_biased(sampling: bool, fraction: float | None, ledger: Ledger) -> None:
    """The energy of millions of paths is that of quadrature to 0.1 %, whatever the mixture on the wall."""
    spp = 2**23
    config = scene(bins=BINS, sensors=(3, 2), max_bounces=3, spp=spp, hidden_geometry_sampling=sampling)
    result = render(config, **({"p_hidden_sampling": fraction} if fraction is not None else {}))
    energy, expected = float(result.mean.sum()), float(truth().sum())
    noise = float(np.sqrt(result.variance.sum())) / expected
    assert 4 * noise < 2e-3, "too few paths to tell"
    ledger.check("bias of a mixture of techniques, of the energy", abs(energy / expected - 1), 1e-3 + 3 * noise)


@pytest.mark.stress
def test_the_gather_is_as_good_as_it_says(ledger: Ledger) -> None:
    """The true error against quadrature stays below twice the estimate and the goal."""
    expected = truth()
    for target in (0.1, 0.03, 0.01, 0.003):
        config = scene(engine="virtual_lights", bins=BINS, sensors=(3, 2), max_bounces=3, target_error=target)
        result = render(config)
        error = float(np.linalg.norm(result.total - expected) / np.linalg.norm(expected))
        # 800 x 800 cells, each put whole into the bin of its midpoint: 0.1 % per bin
        ledger.check("true error of the gather over its estimate", error / (2 * result.error_estimate + 1e-3), 1.0)
        ledger.check("estimated error of the gather over its goal", result.error_estimate / target, 1.0)


@pytest.mark.parametrize("seeds", [5, pytest.param(100, marks=pytest.mark.stress)])
def test_random_streams_are_independent(seeds: int, ledger: Ledger) -> None:
    """Sensor points side by side see the same scene: with the same random numbers they would have the same noise."""
    grid = {"nx": 3, "ny": 2, "width": 1e-3, "height": 1e-3}
    settings: dict = {"bins": BINS, "capture": {"sensor_grid": grid}, "max_bounces": 3}
    exact = render(scene(**settings, spp=2**18)).total.sum(axis=-1).mean()
    energies = [render(scene(**settings, spp=256, seed=seed)).total.sum(axis=-1).ravel() for seed in range(seeds)]
    noise = np.stack(energies) - exact  # (seed, sensor)
    noise /= np.sqrt((noise**2).mean())
    for law, rows in (("seeds", noise), ("sensor points", noise.T)):
        products = [float(a @ b) for a, b in itertools.combinations(rows, 2)]
        # a sum of products of independent numbers of variance 1, and pairs are uncorrelated with each other
        deviation = abs(sum(products)) / np.sqrt(len(products) * rows.shape[1])
        ledger.check(f"correlation of the noise between {law} [sigma]", deviation, 5.0)


@pytest.mark.stress
@pytest.mark.parametrize("engine", ENGINES)
def test_estimates_converge_on_the_truth(engine: str, ledger: Ledger) -> None:
    """A tenth of the error asked for is a tenth of the error had."""
    goals = ({"spp": 2**8}, {"spp": 2**12}) if engine == "path" else ({"target_error": 0.1}, {"target_error": 0.01})
    errors = []
    for goal in goals:
        result = render(scene(engine=engine, bins=(0.9, 0.2, 12), sensors=(3, 2), max_bounces=3, **goal))
        coarse = truth().reshape(*truth().shape[:-1], 12, 5).sum(axis=-1)
        errors.append(float(np.linalg.norm(result.total - coarse) / np.linalg.norm(coarse)))
    # 16 times the paths: a quarter; a tenth of the goal: a tenth
    ledger.check(f"error left after asking for far less ({engine})", errors[1] / errors[0], 0.5)
