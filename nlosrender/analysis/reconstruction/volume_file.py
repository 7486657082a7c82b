"""A reconstruction as an HDF5 file: the volume, the coordinates of its voxels, and how it was made."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.analysis.reconstruction.reconstruct import Reconstruction
from nlosrender.files.atomic_write import replacing
from nlosrender.files.attributes import set_attributes
from nlosrender.files.file_kinds import VOLUME
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.provenance import package_versions
from nlosrender.interruption import uninterrupted

AXES = ("z", "y", "x")  # of the volume, as h5py shows it
MEANING = {
    "volume": "reconstructed hidden scene, arbitrary unit, >= 0",
    "x": "voxel centres along the relay wall's x axis",
    "y": "voxel centres along the relay wall's y axis",
    "z": "voxel centres along the relay wall's normal; the wall is at 0",
    "silhouette": "share of each front pixel that the true hidden geometry covers",
}


def write_volume(
    reconstruction: Reconstruction,
    path: str | Path,
    silhouette: np.ndarray | None = None,
    attributes: dict[str, object] | None = None,
) -> Path:
    """Write a reconstruction as HDF5, in place of an older one; the file appears whole or not at all; return ``path``.

    ``silhouette`` is the true front view (y, x), ``attributes`` are further ones, such as a score.

    Raises
    ------
    FileError
        The file cannot be written, or is the capture itself.
    """
    grid = reconstruction.grid
    with replacing(path, VOLUME, [reconstruction.source]) as partial, uninterrupted(), HDF5Writer(partial) as hdf5:
        file = hdf5.file
        for name in AXES:
            file.create_dataset(name, data=getattr(grid, name))
            set_attributes(file[name], {"meaning": MEANING[name], "unit": "m"})
        options = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        volume = file.create_dataset("volume", data=reconstruction.volume, **options)
        set_attributes(volume, {"meaning": MEANING["volume"], "axes": " ".join(AXES)})
        if silhouette is not None:
            file.create_dataset("silhouette", data=silhouette.astype(np.float32), **options)
            set_attributes(file["silhouette"], {"meaning": MEANING["silhouette"], "axes": "y x"})
        set_attributes(file, _attributes(reconstruction) | (attributes or {}))
    return Path(path)


def _attributes(reconstruction: Reconstruction) -> dict[str, object]:
    attributes: dict[str, object] = {
        "method": reconstruction.method,
        "wavelength": reconstruction.wavelength,
        "cycles": reconstruction.cycles,
        "bounces": np.asarray(reconstruction.bounces),
        "voxel_size": reconstruction.grid.voxel_size,
        "frame": "the relay wall's: x and y along it, z its normal, its centre the origin; lengths in m",
        "wall_to_file": reconstruction.wall_to_file,
        "source": str(reconstruction.source),
        "source_config_hash": reconstruction.source_attributes.get("config_hash", "unknown"),
        "seconds": reconstruction.seconds,
        "versions": package_versions(),
    }
    if reconstruction.wall_to_scene is not None:
        attributes["wall_to_scene"] = reconstruction.wall_to_scene
    return attributes
