"""Checks a file against the Z-NLOS layout as strictly as the strictest of its loaders.

A file by another writer may deviate and still be read right: a violation is what makes it unreadable, all else is a
deviation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from nlosrender.capture.bounces import FILE_BOUNCES, LINE_OF_SIGHT, THIRD_BOUNCE
from nlosrender.capture.bounces import FIRST_BOUNCE as FIRST
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import get_attributes, json_object
from nlosrender.files.reading.reader import StoredCapture, explained_read, open_hdf5
from nlosrender.files.reading.scan import read_scan
from nlosrender.files.reading.stored_axes import BY_RANK, stored_axes
from nlosrender.files.reading.stored_header import samples_of
from nlosrender.files.reading.stored_points import dataset_in, small_numbers, stored_points

CLASSES = {layout.FLOAT: h5py.h5t.FLOAT, layout.INTEGER: h5py.h5t.INTEGER}
WORDS = {h5py.h5t.FLOAT: "floating point", h5py.h5t.INTEGER: "integer"}
NORMAL_TOLERANCE = 1e-5  # three float32 components: 1e-7, with room for other writers' float32 arithmetic
PLANE_TOLERANCE = 1e-5  # m, a wall a few metres wide in float32
SHARE_TOLERANCE = 1e-4  # of a sum: shares of a thousand spots, each rounded to float32
# Energies are sums of float64 samples, which the file holds rounded to float32: by at most half a unit in the last of
# 24 digits, or of the smallest denormal number. Twice that leaves room for the float64 sums themselves.
ENERGY_TOLERANCE = 2.0**-23
SMALLEST_FLOAT32 = 2.0**-149


@dataclass(frozen=True)
class FileCheck:
    """What a file is, after all of it has been read."""

    is_ours: bool  # whether this program wrote it, as it says; then every deviation from the layout is a violation
    violations: tuple[str, ...]  # what makes the file wrong, or impossible to read right
    deviations: tuple[str, ...]  # how a readable file by another writer differs from ours; other loaders may mind


def check_file(path: str | Path) -> FileCheck:
    """Check a file against the layout, and one by another writer for what is needed to read it right.

    Reads all samples, chunk by chunk; chunks that were never written are skipped.

    Raises
    ------
    FileError
        The file cannot be read at all: missing, damaged, without samples.
    """
    path = Path(path)
    with open_hdf5(path) as file, explained_read(path):
        samples = samples_of(file, path)
        attributes = get_attributes(file)
        found = _layout(file, path, samples)
        damaged: list[str] = []
        parts = _finite_parts(samples, layout.DATA, damaged)
        energies = wrong_energies(samples, parts, attributes, get_attributes(samples))
        deque(parts, maxlen=0)  # to the end, also where no energies are stated
        damaged = damaged or energies
        if dataset_in(file, path, layout.VARIANCE) is not None:
            variance = samples_of(file, path, layout.VARIANCE)
            if variance.shape != samples.shape:
                damaged.append(f"variance: shape {variance.shape}, need that of data, {samples.shape}")
            deque(_finite_parts(variance, layout.VARIANCE, damaged), maxlen=0)
        if attributes.get("engine") == layout.ROOT_TEXT["engine"]:
            return FileCheck(True, (*found, *damaged), ())
        unreadable = [text for text in _unreadable(file, path) if text not in found]
        return FileCheck(False, (*unreadable, *damaged), tuple(found))


def _layout(file: h5py.File, path: Path, samples: h5py.Dataset) -> list[str]:
    """Return how a file deviates from the layout, its samples aside."""
    names, axis_sizes, confocal = _axes(file, path, samples)
    sizes = layout.grid_sizes(axis_sizes, confocal)
    missing = layout.missing_datasets(file)
    found = [f"{name}: missing" for name in missing]
    if names != layout.file_axes(confocal):
        found.append(f"data: axes {' '.join(names)}, need {' '.join(layout.file_axes(confocal))}")
    found += _samples(samples, sizes)
    for spec in layout.DATASETS:
        if spec.name not in missing:
            found += _dataset(dataset_in(file, path, spec.name), spec, sizes)
    found += _ground_truth(file, path)
    if not found:  # values mean something only where types and shapes are right
        found += _values(file, path, sizes, confocal) + _points(file, path, sizes, confocal)
        found += _lit_and_seen(file, path)
    return found + _attributes(file, samples)


def _axes(file: h5py.File, path: Path, samples: h5py.Dataset) -> tuple[tuple[str, ...], Mapping[str, int], bool]:
    """Return names and lengths of the axes of ``data``, and whether the capture is confocal."""
    try:
        axes = stored_axes(file, path, samples, get_attributes(file))
    except FileError:  # it contradicts itself: ``_unreadable`` says how
        names = BY_RANK[samples.ndim]
        sizes = dict.fromkeys(layout.MEMORY_AXES, 1) | dict(zip(names, samples.shape, strict=True))
        return names, sizes, samples.ndim <= len(layout.CONFOCAL_AXES)
    return axes.names, axes.sizes, axes.confocal


def _unreadable(file: h5py.File, path: Path) -> list[str]:
    """Return what keeps a file by another writer from being read right."""
    try:
        capture = StoredCapture(file, path)
        if capture.header.scan_type != LINE_OF_SIGHT:
            read_scan(capture)
    except FileError as error:
        return [str(error).removeprefix(f"{path}: ")]
    header, found = capture.header, []
    n_bins = small_numbers(file, path, "t")
    if n_bins is not None and n_bins != (header.n_bins,):
        found.append(f"t: {_listed(n_bins)}, but data has {header.n_bins} bins")
    if header.third_index is None:
        stored = header.data_attributes.get("third_bounce")
        found.append(
            f"attribute 'third_bounce' of data: {stored}, need an index from 0 to {header.sizes['bounce'] - 1}"
        )
    return found


def _samples(samples: h5py.Dataset, sizes: Mapping[str, int]) -> list[str]:
    found = _number(samples, layout.DATA, layout.FLOAT)
    if sizes["bounce"] != FILE_BOUNCES:
        found.append(f"data: bounce axis of length {sizes['bounce']}, need {FILE_BOUNCES}")
    if sizes["channel"] not in (1, 3, 4):
        found.append(f"data: {sizes['channel']} channels, need 1, 3 or 4")
    return found


def _dataset(dataset: h5py.Dataset | None, spec: layout.DatasetSpec, sizes: Mapping[str, int]) -> list[str]:
    if dataset is None:
        return [f"{spec.name}: is not a dataset"]
    found = _number(dataset, spec.name, spec.dtype)
    need = layout.resolve_shape(spec, sizes)
    if dataset.shape != need:
        found.append(f"{spec.name}: shape {dataset.shape}, need {need}")
    elif not found and not np.isfinite(dataset[()]).all():
        found.append(f"{spec.name}: holds a value that is not finite")
    return found


def _ground_truth(file: h5py.File, path: Path) -> Iterator[str]:
    """Yield what is wrong with the ground truth, where there is some: classes, ranks, and grids that differ."""
    sizes: dict[str | int, int] = {layout.THREE: layout.THREE, 2: 2, 4: 4}
    for spec in layout.GROUND_TRUTH:
        if spec.name not in file:
            continue
        dataset = dataset_in(file, path, spec.name)
        if dataset is None:
            yield f"{spec.name}: is not a dataset"
            continue
        yield from _number(dataset, spec.name, spec.dtype)
        need = tuple(sizes.setdefault(axis, length) for axis, length in zip(spec.shape, dataset.shape, strict=False))
        if dataset.ndim != len(spec.shape) or dataset.shape != need:
            axes = ", ".join(map(str, spec.shape))
            yield f"{spec.name}: shape {dataset.shape}, need ({axes}), alike in all ground truth"


def _number(dataset: h5py.Dataset, name: str, dtype: str) -> list[str]:
    kind, size = CLASSES[dtype], np.dtype(dtype).itemsize
    stored = dataset.id.get_type()
    if stored.get_class() == kind and stored.get_size() == size:
        return []
    return [f"{name}: {dataset.dtype}, need {8 * size}-bit {WORDS[kind]}"]


def _values(file: h5py.File, path: Path, sizes: Mapping[str, int], confocal: bool) -> list[str]:
    """Check the small datasets against the shape of ``data``."""
    expected: dict[str, tuple[float, ...]] = {
        "t": (sizes["bin"],),
        "isConfocal": (int(confocal),),
        "cameraGridPoints": (sizes["sensor_x"], sizes["sensor_y"]),
        "laserGridPoints": (sizes["laser_x"], sizes["laser_y"]),
    }
    found = []
    for name, need in expected.items():
        values = small_numbers(file, path, name)
        if values != tuple(float(number) for number in need):
            found.append(f"{name}: {_listed(values)}, but the shape of data says {_listed(need)}")
    if file["deltaT"][()] <= 0:
        found.append(f"deltaT: {file['deltaT'][()]}, need a length > 0")
    for name in ("hiddenVolumeSize", "cameraGridSize", "laserGridSize"):
        if np.any(file[name][()] < 0):
            found.append(f"{name}: a negative length")
    return found


def _points(file: h5py.File, path: Path, sizes: Mapping[str, int], confocal: bool) -> list[str]:
    found = []
    grids = {
        name: stored_points(file, path, name, sizes) for name in layout.SPECS if name.endswith(("itions", "ormals"))
    }
    attributes = get_attributes(file)
    has_camera = layout.EMPTY_POINTS in attributes
    for name in ("cameraGridNormals", "laserGridNormals"):
        lengths = np.linalg.norm(grids[name], axis=-1)
        if has_camera and name == "cameraGridNormals" and (lengths == 0).sum() != attributes[layout.EMPTY_POINTS]:
            found.append(f"{name}: {(lengths == 0).sum()} are zero, {layout.EMPTY_POINTS} says otherwise")
        if (np.abs(lengths - 1) > NORMAL_TOLERANCE)[(lengths > 0) | (not has_camera)].any():
            found.append(f"{name}: not unit normals")
    for name in ("Positions", "Normals"):
        if confocal and not np.array_equal(grids[f"cameraGrid{name}"], grids[f"laserGrid{name}"]):
            found.append(f"laserGrid{name}: differs from cameraGrid{name} although the capture is confocal")
    lists = str(attributes.get(layout.POINT_LISTS, "")).split()
    for name, axis in (("sensor", "sensor_y"), ("laser", "laser_y")):
        if name in lists and sizes[axis] != 1:
            found.append(
                f"attribute {layout.POINT_LISTS!r}: {name} points are a list, but there are {sizes[axis]} rows"
            )
    if attributes.get("frame") == "znlos" and attributes.get("planar_wall") == 1:
        for name in ("cameraGrid", "laserGrid"):
            points, normals = grids[f"{name}Positions"], grids[f"{name}Normals"]
            if np.abs(points[..., 1]).max() > PLANE_TOLERANCE:
                found.append(f"{name}Positions: a planar wall lies in Y = 0 in the Z-NLOS frame")
            if not np.allclose(normals[normals.any(axis=-1)], (0, -1, 0), atol=NORMAL_TOLERANCE):
                found.append(f"{name}Normals: a planar wall faces (0, -1, 0) in the Z-NLOS frame")
            if has_camera or name.removesuffix("Grid").replace("camera", "sensor") in lists:
                continue
            if (np.diff(points[..., 2], axis=0) <= 0).any() or (np.diff(points[..., 0], axis=1) <= 0).any():
                found.append(f"{name}Positions: rows must ascend in Z and columns in X")
    return found


def _lit_and_seen(file: h5py.File, path: Path) -> Iterator[str]:
    """Yield what is wrong with spots, flash and footprint, where a capture has them."""
    attributes = get_attributes(file)
    try:
        spots = StoredCapture(file, path).laser_spots
    except FileError as error:
        yield str(error).removeprefix(f"{path}: ")
    else:
        if spots is not None and not np.isfinite(spots[0]).all():
            yield f"{layout.SPOT_POSITIONS}: holds a value that is not finite"
        if spots is not None and not (spots[1].min() > 0 and abs(spots[1].sum() - 1) <= SHARE_TOLERANCE):
            yield f"{layout.SPOT_SHARES}: need shares above 0 that add up to 1"
    for name in (layout.FLASH, layout.FOOTPRINT):
        if not isinstance(words := attributes.get(name, ""), str):
            yield f"attribute {name!r}: {words}, need text"
    area = attributes.get(layout.FOOTPRINT_AREA)
    needs_area = layout.FOOTPRINT in attributes and layout.EMPTY_POINTS not in attributes  # pixels have none
    if needs_area and not (isinstance(area, (int, float)) and 0 < area < math.inf):
        yield f"attribute {layout.FOOTPRINT_AREA!r}: {'missing' if area is None else area}, need an area > 0 [m^2]"


def _attributes(file: h5py.File, samples: h5py.Dataset) -> list[str]:
    attributes, data_attributes = get_attributes(file), get_attributes(samples)
    found = [
        f"attribute {name!r}: {attributes.get(name, 'missing')}, need {text!r}"
        for name, text in layout.ROOT_TEXT.items()
        if attributes.get(name) != text
    ]
    is_view = attributes.get("scan_type") == LINE_OF_SIGHT  # whose bounces are counted otherwise
    if not is_view and data_attributes.get("third_bounce") != THIRD_BOUNCE - FIRST:
        stored = data_attributes.get("third_bounce", "missing")
        found.append(f"attribute 'third_bounce' of data: {stored}, need {THIRD_BOUNCE - FIRST}")
    if samples.shape[0] > 1 and "channels" not in attributes:
        found.append("attribute 'channels': missing, need the names of the channels")
    return found


def _finite_parts(
    samples: h5py.Dataset, name: str, damaged: list[str]
) -> Iterator[tuple[tuple[slice, ...], np.ndarray]]:
    """Yield (place, samples) of all that is stored, up to the first part that holds a value that is not finite."""
    for part in _stored_parts(samples):
        values = samples[part]
        if not np.isfinite(values).all():
            first = np.argwhere(~np.isfinite(values))[0]
            at = tuple(int(index + axis.start) for index, axis in zip(first, part, strict=True))
            damaged.append(f"{name}: {values[tuple(first)]} at index {at}")
            return
        yield part, values


def _stored_parts(samples: h5py.Dataset) -> list[tuple[slice, ...]]:
    """Return the parts of a dataset that take space: its chunks, or for one without chunks its bins one by one."""
    if samples.chunks is None:
        whole = [slice(0, length) for length in samples.shape]
        if not samples.id.get_storage_size():  # allocated, never written
            return []
        return [(whole[0], slice(index, index + 1), *whole[2:]) for index in range(samples.shape[1])]
    offsets: list[tuple[int, ...]] = []
    samples.id.chunk_iter(lambda chunk: offsets.append(chunk.chunk_offset))
    return [
        tuple(
            slice(start, min(start + step, length))
            for start, step, length in zip(offset, samples.chunks, samples.shape, strict=True)
        )
        for offset in offsets
    ]


def _listed(values: tuple[float, ...] | None) -> str:
    return " x ".join(f"{value:g}" for value in values or ())


def wrong_energies(
    samples: h5py.Dataset,
    parts: Iterable[tuple[tuple[slice, ...], np.ndarray]],
    attributes: Mapping[str, object],
    data_attributes: Mapping[str, object],
) -> list[str]:
    """Return in which bounces the samples do not add up to the attribute ``energy``.

    Parameters
    ----------
    samples, parts
        Dataset ``data``; all samples in it that take space, once each, with their place.
    attributes, data_attributes
        Of the file and of ``data``; a file that states no energies is not judged.
    """
    stated = json_object(attributes.get("energy"))
    indices = data_attributes.get("bounce_indices")
    if not stated or not isinstance(indices, list):
        return []
    if len(stated) != len(indices):
        return [f"attribute 'energy': {len(stated)} bounces, but bounce_indices of data has {len(indices)}"]
    axis = layout.file_axes(samples.ndim == len(layout.CONFOCAL_AXES)).index("bounce")
    total, magnitude = np.zeros((2, samples.shape[axis]))
    # of Stokes components the intensity, as in the render
    intensity_only = attributes.get("channels") == layout.STOKES
    for part, stored in parts:
        if intensity_only and part[0].start > 0:
            continue
        values = (stored[:1] if intensity_only else stored).astype(np.float64)
        others = tuple(index for index in range(values.ndim) if index != axis)
        total[part[axis]] += values.sum(axis=others)
        magnitude[part[axis]] += np.abs(values).sum(axis=others)
    count = samples.size / samples.shape[axis]
    found = []
    for index, (name, energy) in zip(indices, stated.items(), strict=True):
        known = isinstance(index, int) and 0 <= index < len(total) and isinstance(energy, (int, float))
        if (
            not known
            or not abs(total[index] - energy) <= ENERGY_TOLERANCE * magnitude[index] + count * SMALLEST_FLOAT32
        ):
            sums = f"{total[index]:.9g}" if known else "nothing"
            found.append(f"data: bounce {name} adds up to {sums}, but the render summed up {energy} (attribute energy)")
    for index in sorted(set(range(len(total))) - set(indices)):
        if magnitude[index] > 0 or math.isnan(magnitude[index]):
            found.append(f"data: holds light at bounce index {index}, where the render left none")
    return found
