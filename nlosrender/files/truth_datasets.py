"""Ground truth in a capture's own file: further numeric datasets at its root, which every Z-NLOS loader passes over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.files import layout
from nlosrender.files.attributes import set_attributes

SPECS = {spec.name: spec for spec in layout.GROUND_TRUTH}
_NAMED = ("gt_instance", "gt_poses")  # have the items' names beside them


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Datasets of ``layout.GROUND_TRUTH`` by name, in the file's frame, and the names of the hidden items."""

    datasets: Mapping[str, NDArray[Any]]
    items: tuple[str, ...] = ()


NO_TRUTH = GroundTruth({})


def write_ground_truth(file: h5py.File, truth: GroundTruth, filters: Mapping[str, Any]) -> None:
    """Create the datasets of a ground truth in a file that is open for writing, with HDF5 ``filters``."""
    for name, values in truth.datasets.items():
        spec = SPECS[name]
        dataset = file.create_dataset(name, data=np.asarray(values, dtype=spec.dtype), **filters if values.size else {})
        described = {"meaning": spec.meaning} | ({"unit": spec.unit} if spec.unit else {})
        set_attributes(dataset, described | ({"names": list(truth.items)} if name in _NAMED else {}))
