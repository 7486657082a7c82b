"""Small datasets, and grids of points and normals, in files by any writer."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from pathlib import Path

import h5py
import numpy as np

from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.layout import Float64

Numbers = tuple[float, ...]

NOT_ZNLOS = "Is this a Z-NLOS capture, as `nlosrender render` writes it?"
FLATNESS = 1e-4  # distance from the plane over the grid's extent: float32 positions of a scene far from its origin
SAME_POINT = 1e-5  # of the largest coordinate


def dataset_in(file: h5py.File, path: Path, name: str) -> h5py.Dataset | None:
    """Return the dataset ``name`` at the root of a file, or None when there is none.

    Raises
    ------
    FileError
        Its numbers lie in another file: a capture must not make this program open whatever it names.
    """
    link = file.get(name, getlink=True)
    if link is None:
        return None
    dataset = file.get(name) if isinstance(link, h5py.HardLink) else None
    if not isinstance(link, h5py.HardLink) or (
        isinstance(dataset, h5py.Dataset) and (dataset.external or dataset.is_virtual)
    ):
        raise FileError(
            f"{path}: {name} lies in another place or file. Copy it into the file itself, as with h5repack."
        )
    return dataset if isinstance(dataset, h5py.Dataset) else None


def small_numbers(file: h5py.File, path: Path, name: str, exact: bool = False) -> Numbers | None:
    """Return the few numbers of the dataset ``name`` at the root of a file; None when it is missing.

    With ``exact`` the float64 attribute ``exact`` is preferred to the float32 that the layout asks for.

    Raises
    ------
    FileError
        The dataset holds something else.
    """
    dataset = dataset_in(file, path, name)
    if dataset is None and file.get(name, getlink=True) is None:
        return None
    # checked before reading: a dataset may claim any size without taking any
    if dataset is None or dataset.dtype.kind not in "biuf" or not 0 < (dataset.size or 0) <= 16:
        raise FileError(f"{path}: {name} is not what a capture has there. {NOT_ZNLOS}")
    values = dataset[()]
    if exact and "exact" in dataset.attrs and np.asarray(dataset.attrs["exact"]).dtype.kind in "iuf":
        values = dataset.attrs["exact"]
    return tuple(float(value) for value in np.ravel(values))


def stored_points(
    file: h5py.File, path: Path, name: str, sizes: Mapping[str, int], row_major: bool = False, like: str | None = None
) -> Float64:
    """Return a grid of positions or normals as (rows, columns, 3) float64, in the file's frame.

    Parameters
    ----------
    file, path, name
        The open file, its path, and the dataset: (3, rows, columns), or (3, points) as the .mat files of 2018 have it.
    sizes
        Length of every axis, of the laser's, too.
    row_major
        Whether its axes are in reverse order.
    like
        The dataset whose list of points goes through the grid in the same order; None: this one.

    Raises
    ------
    FileError
        The dataset is missing, not numeric, or does not have one entry per point.
    """
    need = layout.resolve_shape(layout.SPECS[name], sizes)
    values = _stored(file, path, name, need, row_major)
    if values.shape == need:
        return layout.axes_last(values)
    guide = values if like is None else _stored(file, path, like, need, row_major)
    by_rows = guide.shape == need or _unevenness(_by_rows(guide, need)) <= _unevenness(_by_columns(guide, need))
    return _by_rows(values, need) if by_rows else _by_columns(values, need)


def _stored(file: h5py.File, path: Path, name: str, need: tuple[int, ...], row_major: bool) -> Float64:
    """Return a dataset of points as (3, rows, columns) or (3, points)."""
    dataset = dataset_in(file, path, name)
    if dataset is None:
        raise FileError(f"{path}: has no dataset {name}. {NOT_ZNLOS}")
    if dataset.dtype.kind not in "iuf" or dataset.size != prod(need):
        raise FileError(f"{path}: {name} is {dataset.dtype} {dataset.shape}, need numbers of shape {need}")
    values = np.asarray(dataset[()], dtype=np.float64)
    listed = (need[0], prod(need[1:]))
    for turned in (values.transpose(), values) if row_major else (values, values.transpose()):
        if turned.shape in (need, listed):
            return turned
    if listed[1] == 1:  # the only point, in whatever shape
        return values.reshape(need)
    raise FileError(f"{path}: {name} has shape {dataset.shape}, need {need}, or {listed} for a list of points")


def _by_rows(listed: Float64, need: tuple[int, ...]) -> Float64:
    return layout.axes_last(listed.reshape(need))


def _by_columns(listed: Float64, need: tuple[int, ...]) -> Float64:
    return layout.axes_last(listed.reshape(need[0], need[2], need[1])).swapaxes(0, 1)


def _unevenness(points: Float64) -> float:
    """Return how far points (rows, columns, 3) are from having one X per column: columns run along X."""
    return float(np.ptp(points[..., 0], axis=0).sum())


def plane_normal(points: Float64, towards: Numbers | None) -> Float64 | None:
    """Return the unit normal (3,) of the plane that points (..., 3) [m] lie in; None when they lie in none.

    It points towards a place (3,) before the wall; without one it is as near to (0, -1, 0) as it can be.
    """
    flat = points.reshape(-1, 3)
    if not np.isfinite(flat).all():
        return None
    middle = flat.mean(axis=0)
    variance, axes = np.linalg.eigh((flat - middle).T @ (flat - middle))  # ascending
    thickness, width, length = np.sqrt(np.maximum(variance, 0))
    if width <= FLATNESS * length or length == 0:  # a line or a point: the layout has the wall in Y = 0
        flat_in_y = np.ptp(flat[:, 1]) <= FLATNESS * np.ptp(flat, axis=0).max()
        return np.array([0.0, -1.0, 0.0]) if flat_in_y else None
    if thickness > FLATNESS * length:
        return None
    normal: Float64 = axes[:, 0]
    before = -normal[1] if towards is None else float(normal @ (np.asarray(towards) - middle))
    return normal if before > 0 else -normal


def same_points(file: h5py.File, path: Path, name: str, other: str) -> bool:
    """Return whether two datasets of as many numbers hold the same points, in whatever shape."""
    first, second = (dataset_in(file, path, each) for each in (name, other))
    if first is None or second is None or {first.dtype.kind, second.dtype.kind} - set("iuf"):
        return False
    if first.size != second.size:
        return False
    one, two = np.ravel(first[()]), np.ravel(second[()])
    return bool(np.allclose(one, two, rtol=0, atol=SAME_POINT * max(float(np.abs(two).max()), 1e-30)))
