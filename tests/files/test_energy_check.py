"""``info --check`` holds the samples against the energies that the render summed up in float64."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import validate_file, write_part


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("scale", [1e-38, 1.0, 1e30])
def test_rounding_to_float32_is_no_violation(
    tmp_path: Path, header_of: Callable, block_of: Callable, scan_type: str, scale: float
) -> None:
    """Samples of 53 bits that are stored with 24 of them, denormal ones too, agree with their float64 sums."""
    header = header_of(scan_type)
    block = block_of(header).astype(np.float64) ** 3 * scale
    # a square of 1e60 does not fit float32: the variance is as large as the samples
    write_part(tmp_path / "a.hdf5", header, np.sqrt(scale) * block / scale)
    assert validate_file(tmp_path / "a.hdf5") == []
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"][()].any()


@pytest.mark.parametrize("share", [3e-7, 0.5, -0.5])
def test_a_changed_sample_is_found(tmp_path: Path, header_of: Callable, block_of: Callable, share: float) -> None:
    """A sample that is off by more than 2^-23 = 1.2e-7 of its bounce's energy is a violation that names the bounce."""
    header = header_of("single")
    path = tmp_path / "a.hdf5"
    block = block_of(header)
    write_part(path, header, block)
    energy = float(block[:, 1].sum(dtype=np.float64))
    with h5py.File(path, "r+") as file:
        # float32 steps at this size are far below the change: the sample is at most 1, the energy about 100
        file["data"][0, 3, 1, 2, 3, 0, 0] += share * energy
    (found,) = validate_file(path)
    assert found.startswith("data: bounce 3 adds up to ")
    assert "but the render summed up" in found


def test_light_where_the_render_left_none_is_found(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A bounce that the file does not claim to hold has to be dark."""
    path = tmp_path / "a.hdf5"
    write_part(path, header_of("single"), block_of(header_of("single")))
    with h5py.File(path, "r+") as file:
        file["data"][0, 3, 5, 2, 3, 0, 0] = 1e-9
    assert validate_file(path) == ["data: holds light at bounce index 5, where the render left none"]


@pytest.mark.parametrize("stated", ['{"2": 1.0}', '{"2": "x", "3": null}', '{"2": NaN, "3": NaN}'])
def test_damaged_energies_are_no_traceback(
    tmp_path: Path, header_of: Callable, block_of: Callable, stated: str
) -> None:
    """An attribute that is no list of energies is a violation, too."""
    path = tmp_path / "a.hdf5"
    write_part(path, header_of("single"), block_of(header_of("single")))
    with h5py.File(path, "r+") as file:
        file.attrs["energy"] = stated
    assert validate_file(path) != []
