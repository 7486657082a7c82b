"""Open captures with y-tal and store what it makes of them; run by the interpreter of .venv-peers.

Usage: python read_with_y_tal.py FOLDER CAPTURE.hdf5... writes FOLDER/CAPTURE.npz for each. The back-projection is
y-tal's own, at the points of FOLDER/volume.npy, (x, y, z, 3) [m].
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from tal.enums import FileFormat
from tal.io import read_capture
from tal.io.capture_data import NLOSCaptureData, read_hdf5
from tal.io.format import convert_dict
from tal.reconstruct import bp

ARRAYS = ("H", "sensor_xyz", "sensor_grid_xyz", "sensor_grid_normals", "laser_xyz", "laser_grid_xyz")
ARRAYS += ("laser_grid_normals", "delta_t", "t_start", "t_accounts_first_and_last_bounces")
FORMATS = ("H_format", "sensor_grid_format", "laser_grid_format")


def load(path: Path) -> NLOSCaptureData:
    """Return a Z-NLOS file as y-tal's own structure, without its ``read_capture``, which stumbles over such files."""
    capture = NLOSCaptureData()
    for name, value in convert_dict(read_hdf5(str(path)), FileFormat.HDF5_TAL).items():
        setattr(capture, name, value)
    return capture


def failure(function, *arguments) -> str:
    """Return the error a call ends in, or an empty text."""
    try:
        function(*arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def main(folder: Path, paths: list[Path]) -> None:
    """Store what y-tal reads from each capture."""
    volume = np.load(folder / "volume.npy")
    for path in paths:
        capture = load(path)
        found = {name: getattr(capture, name) for name in ARRAYS}
        found |= {name: getattr(capture, name).name for name in FORMATS}
        found |= {f"volume_{name}": value for name, value in capture.scene_info["volume"].items()}
        found["read_capture"] = failure(read_capture, str(path))
        found["misfit"] = failure(reconstruct, capture, volume, found)
        np.savez(folder / f"{path.stem}.npz", **found)


def reconstruct(capture: NLOSCaptureData, volume: np.ndarray, found: dict[str, object]) -> None:
    """Add what y-tal takes the scan for, and its back-projection; fails for a capture whose parts do not fit."""
    found["is_confocal"] = capture.is_confocal()
    found["is_laser_paired_to_sensor"] = capture.is_laser_paired_to_sensor()
    found["back_projection"] = bp.solve(capture, volume, progress=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
