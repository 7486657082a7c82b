"""Axes of ``data`` in a file by any writer: colour and laser axes may be missing, the order reversed.

MATLAB and h5py show a file's axes in opposite orders. Most files have them so that MATLAB sees (x, y, ..., bounce, t,
channel); those whose attribute ``data order`` is ``row-major`` have them so that h5py does, in every dataset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path

import h5py
import numpy as np

from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.reading.stored_points import dataset_in, same_points, small_numbers

BY_RANK = {
    4: layout.CONFOCAL_AXES[1:],
    5: layout.CONFOCAL_AXES,
    6: layout.PAIR_AXES[1:],
    7: layout.PAIR_AXES,
}  # without a channel, 4 and 6


@dataclass(frozen=True)
class StoredAxes:
    """The axes of ``data`` as h5py shows them."""

    names: tuple[str, ...]  # in-memory names, in the file's order
    row_major: bool  # whether every dataset of the file has its axes in reverse order
    sizes: Mapping[str, int]  # length of every in-memory axis; 1 where the file has no such axis
    confocal: bool  # laser and sensor points are the same; else there are laser axes, or there is one laser point


def stored_axes(file: h5py.File, path: Path, samples: h5py.Dataset, attributes: Mapping[str, object]) -> StoredAxes:
    """Find out what the axes of ``data``, of a rank in ``BY_RANK``, are.

    Raises
    ------
    FileError
        The file contradicts itself.
    """
    names = BY_RANK[samples.ndim]
    row_major = _is_row_major(file, path, samples, attributes)
    if row_major:
        names = names[::-1]
    sizes = dict.fromkeys(layout.MEMORY_AXES, 1) | dict(zip(names, samples.shape, strict=True))
    confocal = samples.ndim <= len(layout.CONFOCAL_AXES) and not _is_single(file, path, sizes)
    return StoredAxes(names, row_major, sizes, confocal)


def _is_row_major(file: h5py.File, path: Path, samples: h5py.Dataset, attributes: Mapping[str, object]) -> bool:
    order = attributes.get("data order")
    if isinstance(order, list) and order:
        order = order[0]
    if order in ("row-major", "column-major"):
        return order == "row-major"
    n_bins = small_numbers(file, path, "t")
    if n_bins is None or len(n_bins) != 1:
        return False
    # it does not say: the number of bins tells, unless both orders suit it
    at = BY_RANK[samples.ndim].index("bin")
    return samples.shape[at] != n_bins[0] == samples.shape[::-1][at]


def _is_single(file: h5py.File, path: Path, sizes: Mapping[str, int]) -> bool:
    """Return whether data without laser axes are of one laser point."""
    flag = small_numbers(file, path, "isConfocal")
    lasers = dataset_in(file, path, "laserGridPositions")
    n_lasers = None if lasers is None else (lasers.size or 0) // layout.THREE
    n_sensors = prod(sizes[axis] for axis in ("sensor_y", "sensor_x"))
    if flag is None or any(flag):
        return flag is None and n_lasers == 1 < n_sensors
    if n_lasers in (None, 1):
        return True
    if n_lasers == n_sensors and same_points(file, path, "cameraGridPositions", "laserGridPositions"):
        return False  # a confocal capture whose flag was forgotten
    raise FileError(
        f"{path}: isConfocal is 0 and there are {n_lasers} laser points, but data has no laser axes: its shape is "
        f"{tuple(sizes[axis] for axis in layout.CONFOCAL_AXES)} ({' '.join(layout.CONFOCAL_AXES)}). Store it with "
        f"{len(layout.PAIR_AXES)} axes ({' '.join(layout.PAIR_AXES)})."
    )


def in_memory_order(stored: np.ndarray, names: tuple[str, ...], wanted: tuple[str, ...]) -> np.ndarray:
    """Transpose what was read from axes ``names`` into the order ``wanted``; axes that are missing get length 1."""
    missing = [axis for axis in wanted if axis not in names]
    present = [*missing, *(axis for axis in names if axis in wanted)]
    stored = stored.reshape((1,) * len(missing) + stored.shape)
    return stored.transpose([present.index(axis) for axis in wanted])
