"""Fixtures that several folders of tests share; helper functions are in ``support/``."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

BUNNY = Path(__file__).parents[2] / "shared" / "meshes" / "bunny.ply"


@pytest.fixture
def bunny() -> Path:
    """The Stanford bunny; not part of the project."""
    if not BUNNY.exists():
        pytest.skip(f"{BUNNY} is not there")
    return BUNNY


@pytest.fixture
def backend() -> None:
    """Grey Mitsuba on LLVM, whatever the test before has chosen; what imports Mitsuba may be imported after it."""
    from nlosrender.engine.backend.start import start_backend

    start_backend("llvm")


def pytest_configure() -> None:
    """Make Ctrl-C arrive, also where the suite is run in the background: shells let such commands ignore it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
