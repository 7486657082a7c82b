"""Measured responses from files: .csv and .txt, .npy, and HDF5 as y-tal's noise simulation reads it."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from nlosrender.errors import ConfigError
from nlosrender.sensor.response import Float64

KEY, WIDTH_KEY = "sensor.jitter_file", "sensor.jitter_file_bin_ps"
EVENNESS = 1e-3  # of a cell: times in files have few digits
HDF5 = (".hdf5", ".h5")


def read_curve(path: Path, cell_ps: float | None) -> tuple[Float64, float]:
    """Return the counts (cells,) of a measured response and the width of its cells [ps].

    Parameters
    ----------
    path
        .csv or .txt: two columns, time [ps] and counts, with or without a line of names, or one of counts; .npy: counts
        (cells,) or time and counts (cells, 2); .hdf5 or .h5: datasets ``counts`` and ``timebin_width_ps``.
    cell_ps
        Width of a cell where the file does not say.

    Raises
    ------
    ConfigError
        It cannot be read, or its cells have no width, or no single one.
    """
    try:
        table, stored = _table(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError.at(KEY, f"{path} cannot be read: {str(error).partition(chr(10))[0]}.") from error
    if table.ndim == 2 and table.shape[1] == 2 and path.suffix not in HDF5:
        times, counts = table.T
        steps = np.diff(times)
        if len(steps) == 0 or not steps[0] > 0 or np.ptp(steps) > EVENNESS * steps[0] * len(steps):
            raise ConfigError.at(KEY, f"the times of {path} do not ascend in equal steps of ps.")
        stored = float((times[-1] - times[0]) / len(steps))
    else:
        counts = table.ravel()
    width = stored or cell_ps
    if width is None or not (np.isfinite(width) and width > 0):
        raise ConfigError.at(WIDTH_KEY, f"missing: {path} does not say how many ps one of its {counts.size} cells is.")
    return counts, width


def _table(path: Path) -> tuple[Float64, float | None]:
    """Return the numbers of a file and, of HDF5, the width of a cell."""
    if path.suffix in HDF5:
        with h5py.File(path, "r") as file:
            return np.asarray(file["counts"], dtype=np.float64), float(np.asarray(file["timebin_width_ps"]).ravel()[0])
    if path.suffix == ".npy":
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64), None
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and line[0] != "#"]
    rows = [line.replace(";", ",").replace("\t", ",").split(",") for line in lines]
    try:
        float(rows[0][0])
    except ValueError:
        rows = rows[1:]
    return np.array(rows, dtype=np.float64), None
