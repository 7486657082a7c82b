"""Ground truth in a capture's own file: further numeric datasets at its root, which every Z-NLOS loader passes over."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.files import layout
from nlosrender.files.attributes import set_attributes
from nlosrender.files.reading.reader import explained_read, open_hdf5

SPECS = {spec.name: spec for spec in layout.GROUND_TRUTH}
_NAMED = ("gt_instance", "gt_poses")  # have the items' names beside them


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Datasets of ``layout.GROUND_TRUTH`` by name, in the file's frame, and the names of the hidden items."""

    datasets: Mapping[str, NDArray[Any]]
    items: tuple[str, ...] = ()


CLASSES = {layout.FLOAT: np.float64, layout.INTEGER: np.int64}
NO_TRUTH = GroundTruth({})


def write_ground_truth(file: h5py.File, truth: GroundTruth, filters: Mapping[str, Any]) -> None:
    """Create the datasets of a ground truth in a file that is open for writing, with HDF5 ``filters``."""
    for name, values in truth.datasets.items():
        spec = SPECS[name]
        dataset = file.create_dataset(name, data=np.asarray(values, dtype=spec.dtype), **filters if values.size else {})
        described = {"meaning": spec.meaning} | ({"unit": spec.unit} if spec.unit else {})
        set_attributes(dataset, described | ({"names": list(truth.items)} if name in _NAMED else {}))


def read_ground_truth(path: str | Path, names: Iterable[str] = tuple(SPECS)) -> dict[str, NDArray[Any]]:
    """Return those of the named datasets that a capture has, as float64 or int64.

    Raises
    ------
    FileError
        The file cannot be read.
    """
    path = Path(path)
    with open_hdf5(path) as file, explained_read(path):
        return {name: file[name][()].astype(CLASSES[SPECS[name].dtype]) for name in names if name in file}
