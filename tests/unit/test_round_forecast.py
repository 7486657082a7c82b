"""How many rounds of VPLs are said to meet a target error (docs/virtual-lights.md, 8)."""

from __future__ import annotations

import math

import pytest

from nlosrender.engine.backend.start import start_backend

start_backend("llvm")
from nlosrender.engine.launch.time_steps import TimeSteps  # noqa: E402
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING  # noqa: E402
from nlosrender.engine.virtual_lights.vpls.round_forecast import RoundForecast  # noqa: E402

SHARED = RoundForecast(DEFAULT_TUNING, 256, 16, 2, shares_subpaths=True, rays_per_vpl=1)
SINGLE = RoundForecast(DEFAULT_TUNING, 4096, 1, 1, shares_subpaths=False, rays_per_vpl=1)


@pytest.mark.parametrize("forecast", [SHARED, SINGLE], ids=["shared", "single"])
@pytest.mark.parametrize("target", [0.5, 0.1, 0.03, 0.01, 0.001])
def test_the_rounds_are_the_fewest_that_meet_the_target(forecast: RoundForecast, target: float) -> None:
    done = 2 * forecast.pilot_units
    rounds = forecast.rounds_needed(0.2, done, target)
    assert forecast.error_after(0.2, done, rounds) <= target * (1 + 1e-9)
    assert rounds == 1 or forecast.error_after(0.2, done, rounds - 1) > target


def test_rounds_of_the_largest_size_average() -> None:
    """Beyond one round of 16 units four times the units halve the error; without light no number is known."""
    assert SHARED.error_after(0.2, 2, 64) == pytest.approx(2 * SHARED.error_after(0.2, 2, 256))
    assert SHARED.error_after(0.2, 2, 8) < SHARED.error_after(0.2, 2, 2) / 2
    assert SHARED.rounds_needed(math.inf, 2, 0.1) == DEFAULT_TUNING.max_rounds


def test_steps_are_taken_that_change_little() -> None:
    """Four times cheaper ones if they change nothing, none that change more than their part of the target."""
    plain = TimeSteps(1, 0.1)
    assert SHARED.split(1000, 0.65, 0.9, [plain, TimeSteps(8, 0.05, 0.001)], 2, 0.03)[1].bins == 8
    assert SHARED.split(1000, 0.65, 0.9, [plain, TimeSteps(8, 0.05, 0.02)], 2, 0.03)[1].bins == 1
