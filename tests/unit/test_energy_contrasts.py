"""The error of a capture's energy, whatever sensor points, lasers and parts of the capture have in common."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nlosrender.engine.backend import start as backend

backend.start_backend("llvm")  # Mitsuba starts before the engine modules are imported

from nlosrender.engine.launch.energy_contrasts import (  # noqa: E402
    CONTRASTS,
    RoundContrasts,
    contrasts_of_deviation,
    contrasts_of_points,
)

DRAWS = 40  # of 32 contrasts: a standard error of 1 / sqrt(2 * 32 * 40) = 2 %, or 1 / sqrt(2 * pairs * 40)
TOLERANCE = 0.12
GRID = (10, 5)
SENSORS = np.arange(50)
PLACES = np.stack([SENSORS % GRID[0] / GRID[0], SENSORS // GRID[0] / GRID[1]], axis=-1)


def histogram(energies: NDArray[np.float64]) -> Any:
    """What contrasts read of a histogram, whose energies are (replica, sensor, laser, slot, channel)."""
    replicas, sensors, lasers, slots, channels = energies.shape
    shape = SimpleNamespace(replicas=replicas, sensors=sensors, lasers=lasers, slots=slots, channels=channels)
    return SimpleNamespace(shape=shape, energies=lambda: energies)


def of_points(energies: NDArray[np.float64], sensors: NDArray[np.int64]) -> NDArray[np.float64]:
    return contrasts_of_points(histogram(energies), sensors, 1 / len(energies), range(-1, 1))


def stated(contrasts: list[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.square(contrasts))))


@pytest.mark.parametrize("replicas", [2, 3, 8])
def test_lasers_that_share_paths_are_added_before_they_are_squared(replicas: int) -> None:
    """Three lasers see the same path of deviation 1: of 50 points' mean over R replicas, 3 sqrt(50 / R)."""
    random = np.random.default_rng(replicas)
    draws = []
    for _ in range(DRAWS):
        of_path = random.normal(7.0, 1.0, (replicas, 50, 1, 1, 1))
        draws.append(of_points(np.repeat(of_path, 3, axis=2), SENSORS)[:, 0, 1])
    assert stated(draws) == pytest.approx(3 * np.sqrt(50 / replicas), rel=TOLERANCE)


def test_contrasts_of_parts_add_up_to_the_whole() -> None:
    """Cut along sensors and lasers, in any order: what parts share is kept; slots that are not sampled are exact."""
    energies = np.random.default_rng(1).normal(size=(4, 50, 3, 1, 2))
    whole = of_points(energies, SENSORS)
    assert whole.shape == (CONTRASTS, 2, 2)
    assert not whole[:, :, 0].any()
    parts = [
        of_points(energies[:, points][:, :, lasers], SENSORS[points])
        for points in (slice(30, 50), slice(0, 30))
        for lasers in (slice(0, 1), slice(1, 3))
    ]
    np.testing.assert_allclose(sum(parts), whole, rtol=0, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("rounds", [12, 100])
def test_sensor_points_that_share_walks_have_the_error_of_their_walks(rounds: int) -> None:
    """All 50 points see the same deviation of 1 per round and replica: 50 / sqrt(2 rounds), not sqrt(50) of it."""
    random = np.random.default_rng(rounds)
    draws = []
    for _ in range(DRAWS):
        energies = np.zeros((2, 50, 1, 1, 1))
        contrasts = RoundContrasts(histogram(energies), PLACES)
        for done in range(1, rounds + 1):
            energies += random.normal(5.0, 1.0, (2, 1, 1, 1, 1))
            contrasts.add(done, done == rounds)
        draws.append(contrasts.result(1 / (2 * rounds), range(1))[:, 0, 0])
    # 12 pairs or more a draw: a standard error of 1 / sqrt(2 * 12 * 40) = 3 %
    assert stated(draws) == pytest.approx(50 / np.sqrt(2 * rounds), rel=TOLERANCE)


def test_one_round_states_no_error_that_cancels_by_chance() -> None:
    """Errors of one sign left and of the other right on the wall add up to nothing in one draw, not in all."""
    deviation = np.where(SENSORS % GRID[0] < GRID[0] / 2, 1.0, -1.0).reshape(1, 1, 50, 1)
    assert abs(deviation.sum()) == 0
    assert stated([contrasts_of_deviation(deviation, PLACES)]) > 0.25 * np.abs(deviation).sum()
    same = np.ones((1, 1, 50, 1))
    assert 1 <= stated([contrasts_of_deviation(same, PLACES)]) / same.sum() < np.sqrt(3)
