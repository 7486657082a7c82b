"""Fixtures that several folders of tests share; helper functions are in ``support/``."""

from __future__ import annotations

import gc
import signal
from collections.abc import Iterator
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


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect tests without the garbage collector, which took two fifths of the time, and leave it what comes later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
