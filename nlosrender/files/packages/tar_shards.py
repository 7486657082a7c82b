"""Tar shards for streaming: of each capture ``key.npz`` (H and ground truth) and ``key.json`` (all that is known)."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.config.dataset_section import DatasetConfig
from nlosrender.files.layout import COUNTS
from nlosrender.files.packages.package import Packing, splits_of
from nlosrender.files.packages.samples import rounding
from nlosrender.files.reading.reader import explained_read, open_hdf5
from nlosrender.files.truth_datasets import SPECS

BOUNCE_AXIS = 2  # of ``data``: (channel, bin, bounce, y, x) and on
# of float16: H is divided by a power of two so that its largest value lies below 2^15, and 2^29 smaller ones keep all
# of their 11 digits
TOP_EXPONENT = 15


def write_shards(packing: Packing, entries: list[dict[str, Any]], progress: Callable[[float], None]) -> None:
    """Write ``SPLIT-000000.tar`` and so on; errors as of ``pack``."""
    dataset = DatasetConfig.model_validate(packing.dataset)
    bins = _lit_bins(packing.source, entries) if dataset.crop else slice(None)
    done = 0
    for split, chosen in splits_of(entries).items():
        shard = _Shard(packing.folder, split, dataset.shard_bytes)
        for entry in chosen:
            packing.shards[entry["index"]] = shard.add(entry["index"], _members(packing, entry, dataset, bins))
            done += 1
            progress(done / len(entries))
        shard.close()


class _Shard:
    """The tar file that is being written; a new one is begun where it would grow beyond a size."""

    def __init__(self, folder: Path, split: str, most: int):
        self._folder, self._split, self._most = folder, split, most
        self._number, self._size = -1, 0
        self._tar: tarfile.TarFile | None = None

    def add(self, index: int, members: dict[str, bytes]) -> str:
        size = sum(len(content) for content in members.values())
        if self._tar is None or self._size + size > self._most:
            self.close()
            self._number, self._size = self._number + 1, 0
            self._name = f"{self._split}-{self._number:06d}.tar"
            self._tar = tarfile.open(self._folder / self._name, "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
        for suffix, content in members.items():
            info = tarfile.TarInfo(f"{index:06d}.{suffix}")  # without times and owners: the same bytes each time
            info.size = len(content)
            self._tar.addfile(info, io.BytesIO(content))
        self._size += size
        return self._name

    def close(self) -> None:
        if self._tar is not None:
            self._tar.close()
            self._tar = None


def _members(packing: Packing, entry: dict[str, Any], dataset: DatasetConfig, bins: slice) -> dict[str, bytes]:
    path = packing.source / entry["file"]
    with open_hdf5(path) as file, explained_read(path):
        light = _light(file["data"])
        arrays = {name: file[name][()] for name in SPECS if name in file}
        if COUNTS in file:
            arrays[COUNTS] = _light(file[COUNTS])
        start, bin_width = float(file["t0"].attrs["exact"]), float(file["deltaT"].attrs["exact"])
        scan_type = str(file.attrs["scan_type"])
    first = bins.start or 0
    light = light[:, bins]
    arrays["H"], scale = _stored(light, dataset.dtype)
    added = rounding(arrays["H"].astype(np.float64) * scale, light)
    told = ("index", "split", "label", "values", "files", "capture_hash", "seconds")
    described = {name: entry[name] for name in told}
    described |= {
        "error_estimate": packing.stated_error(entry, added),
        "unsampled_paths": entry["unsampled_paths"],
        "scan_type": scan_type,
        "axes": "channel bin y x" if light.ndim == 4 else "channel bin y x laser_y laser_x",
        "scale": scale,  # H in J m^-2 sr^-1 is the stored one times this
        "start_opl": start + first * bin_width,
        "bin_width_opl": bin_width,
    }
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return {"json": json.dumps(described, allow_nan=False).encode(), "npz": content.getvalue()}


def _light(data: Any) -> NDArray[np.float32]:
    """Return H (channel, bin, y, x, and lasers where there are) with its bounces summed."""
    return np.sum(data[()], axis=BOUNCE_AXIS, dtype=np.float32)


def _stored(light: NDArray[np.float32], dtype: str) -> tuple[NDArray[Any], float]:
    """Return H as it is stored, and what it has to be multiplied by."""
    largest = float(np.abs(light).max(initial=0))
    if dtype == "float32" or not largest:
        return light.astype(dtype), 1.0
    scale = 2.0 ** (np.frexp(largest)[1] - TOP_EXPONENT)
    return (light / scale).astype(np.float16), float(scale)


def _lit_bins(folder: Path, entries: list[dict[str, Any]]) -> slice:
    """Return the bins from the first to the last that holds light in any capture."""
    first, last = None, 0
    for entry in entries:
        path = folder / entry["file"]
        with open_hdf5(path) as file, explained_read(path):
            light = _light(file["data"])
        lit = np.flatnonzero(light.any(axis=tuple(axis for axis in range(light.ndim) if axis != 1)))
        if len(lit):
            first, last = min(int(lit[0]), int(lit[0]) if first is None else first), max(last, int(lit[-1]) + 1)
    return slice(None) if first is None else slice(first, last)
