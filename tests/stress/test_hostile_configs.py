"""Whatever someone writes into a configuration: a message and exit code 3, or a render; never anything else."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from conftest import Ledger
from containment import Containment
from hostile_configs import damaged_configs
from hypothesis import HealthCheck, given, settings

from nlosrender.config.load import parse_config
from nlosrender.errors import ConfigError

SETTINGS = settings(
    deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck), print_blob=False
)
SLOWEST = 5.0  # s for one judgement of a config; the machine may be busy
LONGEST_RENDER = 5.0  # s, as `plan` estimates it


@settings(SETTINGS, max_examples=100)
@given(text=damaged_configs())
def test_damaged_configs_are_judged(text: str, ledger: Ledger) -> None:
    """A config is valid, or every problem has a message; within seconds."""
    begun, messages = time.process_time(), ["valid"]
    try:
        parse_config(text, "fuzz.yaml", Path("/nonexistent"))
    except ConfigError as error:
        messages = [problem.message for problem in error.issues]
    assert time.process_time() - begun < SLOWEST
    assert messages
    assert all(messages)
    ledger.count("damaged configs, parsed", refused=messages != ["valid"], fault="")


@pytest.mark.stress
@settings(SETTINGS, max_examples=1500)
@given(text=damaged_configs())
def test_damaged_configs_are_refused_or_rendered(
    text: str, contained: Containment, ledger: Ledger, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The commands `validate`, `plan` and `render` survive them all, within 4 GiB and a minute each."""
    folder = tmp_path_factory.getbasetemp()
    path = folder / "fuzz.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    for command in ("validate", "plan", "render"):
        extra = {"plan": ["--json"], "render": ["-o", folder / "fuzz.hdf5"]}.get(command, [])
        outcome = contained.run(command, path, *extra)
        ledger.count(f"damaged configs, {command}", refused=outcome.exit_code not in (0, None), fault=outcome.fault)
        assert not outcome.fault, f"{command}: {outcome.fault}\n{outcome.trace}\n{text}"
        if outcome.exit_code:
            assert outcome.exit_code in ((3,) if command == "validate" else (1, 3))
            return
        if command == "plan" and (_seconds(outcome.message) or 0.0) > LONGEST_RENDER:
            return  # a long render is no hang


def _seconds(message: str) -> float | None:
    try:
        return float(json.loads(message.splitlines()[0])["seconds_estimate"])
    except (ValueError, TypeError, KeyError, IndexError):
        return None
