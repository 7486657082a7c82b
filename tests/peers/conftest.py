"""Small captures of a patch, rendered once."""

from __future__ import annotations

import pytest
from patch_captures import GRIDS, PatchCapture, render_patch


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, PatchCapture]:
    """A capture of every scan type, by its name."""
    folder = tmp_path_factory.mktemp("captures")
    return {name: render_patch(folder / f"{name}.hdf5", name, *grids) for name, grids in GRIDS.items()}
