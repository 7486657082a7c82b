"""Shared by all tests; being here also puts ``rendering``, ``quadrature`` and ``agreement`` on the import path."""

from __future__ import annotations

from pathlib import Path

import pytest

BUNNY = Path(__file__).parents[2] / "shared" / "meshes" / "bunny.ply"


@pytest.fixture
def bunny() -> Path:
    """The Stanford bunny; not part of the project."""
    if not BUNNY.exists():
        pytest.skip(f"{BUNNY} is not there")
    return BUNNY
