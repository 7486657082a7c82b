"""Independent reference renderer: the Python side of ``transport.c``. Imports nothing of nlosrender."""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
COMPILER = shutil.which("cc")
TRIANGLE, SPHERE, CYLINDER = range(3)
MATERIALS = [
    *("diffuse", "conductor", "roughconductor", "dielectric", "thindielectric"),
    *("blendbsdf", "mask", "twosided", "plastic", "null"),
]
ROW = 17  # doubles of a pair of sensor and laser point


@functools.cache
def library() -> ctypes.CDLL:
    """Compile ``transport.c`` into a temporary folder and load it."""
    source = Path(__file__).with_name("transport.c")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "transport.so")
        flags = ["-std=c11", "-D_GNU_SOURCE", "-O2", "-shared", "-fPIC", "-pthread"]
        subprocess.run([str(COMPILER), *flags, str(source), "-o", str(target), "-lm"], check=True)
        return ctypes.CDLL(str(target))  # stays mapped without its file


@dataclass
class Scene:
    """Surfaces and materials as ``transport.c`` wants them; every method returns the index of what it added."""

    primitives: list[tuple[list[int], list[float]]] = field(default_factory=list)
    materials: list[tuple[list[int], list[float]]] = field(default_factory=list)
    textures: list[tuple[Array, bool]] = field(default_factory=list)

    def texture(self, texels: ArrayLike, nearest: bool = False) -> int:
        """Add a grey picture (row, column); its first row lies at v = 1, texels repeat outside of 0 to 1."""
        self.textures.append((np.asarray(texels, dtype=np.float64), nearest))
        return len(self.textures) - 1

    def material(
        self,
        kind: str,
        value: float = 0.0,
        *,
        texture: int = -1,
        children: Sequence[int] = (),
        eta: float = 0.0,
        k: float = 0.0,
        alpha: float = 0.0,
        beckmann: bool = False,
        specular: float = 1.0,
        nonlinear: bool = False,
    ) -> int:
        """Add a material.

        ``value``: reflectance of diffuse and conductors, weight of blends, opacity of masks. A conductor with eta = 0
        reflects everything. ``children``: blendbsdf (at weight 0, at weight 1), twosided (front, back), mask (one).
        """
        first, second = (*children, *([children[-1]] * (2 - len(children)))) if children else (-1, -1)
        numbers = [value, eta, k, alpha, float(beckmann), specular, float(nonlinear)]
        self.materials.append(([MATERIALS.index(kind), first, second, texture], numbers))
        return len(self.materials) - 1

    def triangle(
        self,
        corners: ArrayLike,
        material: int,
        *,
        normals: ArrayLike | None = None,
        uvs: ArrayLike | None = None,
        hidden: bool = True,
    ) -> int:
        """Add a triangle, (3, 3) corners [m], seen from where they run counter-clockwise; normals shade it."""
        p = np.asarray(corners, dtype=np.float64)
        shading = np.zeros(9) if normals is None else np.ravel(normals)
        coordinates = np.zeros(6) if uvs is None else np.ravel(uvs)
        numbers = [*p[0], *(p[1] - p[0]), *(p[2] - p[0]), *shading, *coordinates]
        return self._add(TRIANGLE, material, hidden, numbers, normals is not None)

    def sphere(
        self, center: ArrayLike, radius: float, material: int, *, inside: bool = False, hidden: bool = True
    ) -> int:
        """Add a sphere, seen from outside or from inside."""
        return self._add(SPHERE, material, hidden, [*np.ravel(center), radius, -1.0 if inside else 1.0])

    def cylinder(
        self, base: ArrayLike, axis: ArrayLike, radius: float, height: float, material: int, *, inside: bool = False
    ) -> int:
        """Add an open tube that starts at ``base`` and runs ``height`` along the unit vector ``axis``."""
        sign = -1.0 if inside else 1.0
        return self._add(CYLINDER, material, True, [*np.ravel(base), *np.ravel(axis), radius, height, sign])

    def _add(self, kind: int, material: int, hidden: bool, numbers: Sequence[float], shaded: bool = False) -> int:
        self.primitives.append(([kind, material, int(hidden), int(shaded)], [float(number) for number in numbers]))
        return len(self.primitives) - 1


@dataclass(frozen=True)
class WallPoint:
    """A laser or sensor point: position [m], the primitive it lies on, where its device is."""

    position: Array
    primitive: int
    device: Array


@dataclass(frozen=True)
class Window:
    """Time bins in optical path length [m], and the bounces: ``n_slots`` of them from 2, the last holds the rest."""

    start: float
    width: float
    n_bins: int
    max_bounce: int = 3
    n_slots: int = 2


@dataclass(frozen=True)
class Reference:
    """``mean`` and ``variance`` (of the mean): (bounce - 2, pair, bin) [J m^-2 sr^-1]."""

    mean: Array
    variance: Array

    @property
    def error(self) -> float:
        """Relative L2 error of ``mean``, summed over bounces."""
        total = self.mean.sum(axis=0)
        return float(np.sqrt(self.variance.sum() / max((total**2).sum(), 1e-300)))


def render(
    scene: Scene,
    pairs: Sequence[tuple[WallPoint, WallPoint]],
    window: Window,
    samples: int,
    *,
    legs: bool = False,
    energy: float = 1.0,
    spot_radius: float = 0.0,
    chain: int = 2,
    replicas: int = 8,
    seed: int = 0,
    threads: int | None = None,
) -> Reference:
    """Render pairs of (sensor point, laser point).

    Parameters
    ----------
    samples
        Paths per pair, shared among ``replicas`` independent estimates.
    legs
        Count the way from the laser to its point and from the sensor point to the sensor.
    chain
        Longest chain of mirrors and panes between a matt surface and the laser point that is looked for, up to 4.
        A chain may hold planes and, reflecting outwards, spheres.
    """
    rows = np.zeros((len(pairs), ROW))
    for row, (sensor, laser) in zip(rows, pairs, strict=True):
        ways = [point.device - point.position for point in (sensor, laser)]
        row[0:3], row[3], row[4:7] = sensor.position, sensor.primitive, _unit(ways[0])
        row[7:10], row[10], row[11:14] = laser.position, laser.primitive, _unit(ways[1])
        row[14:17] = sum(np.linalg.norm(way) for way in ways) if legs else 0.0, energy, spot_radius
    kinds, numbers = _table(scene.primitives, 40)
    material_kinds, material_numbers = _table(scene.materials, 12)
    texels = np.concatenate([np.zeros(1), *(picture.ravel() for picture, _ in scene.textures)])
    offsets = np.cumsum([1, *(picture.size for picture, _ in scene.textures)])
    texture_kinds = np.array(
        [[offsets[i], p.shape[1], p.shape[0], nearest] for i, (p, nearest) in enumerate(scene.textures)] or [[0] * 4],
        dtype=np.int32,
    )
    shape = (len(pairs), window.n_slots, window.n_bins)
    mean, variance, outside = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    pointer = [
        array.ctypes.data_as(ctypes.c_void_p)
        for array in (
            kinds,
            numbers,
            material_kinds,
            material_numbers,
            texture_kinds,
            texels,
            rows,
            mean,
            variance,
            outside,
        )
    ]
    failed = library().reference_render(
        len(kinds), *pointer[0:2], len(material_kinds), *pointer[2:6], len(pairs), pointer[6],
        ctypes.c_double(window.start), ctypes.c_double(window.width), window.n_bins, window.max_bounce, window.n_slots,
        chain, replicas, ctypes.c_int64(max(1, samples // replicas)), ctypes.c_uint64(seed),
        threads or min(4, os.cpu_count() or 1), *pointer[7:10],
    )  # fmt: skip
    if failed:
        raise RuntimeError("the reference renderer could not start its threads")
    return Reference(mean.transpose(1, 0, 2), variance.transpose(1, 0, 2))


def _table(entries: Sequence[tuple[list[int], list[float]]], width: int) -> tuple[NDArray[np.int32], Array]:
    numbers = np.zeros((len(entries), width))
    for row, (_, values) in zip(numbers, entries, strict=True):
        row[: len(values)] = values
    return np.array([kind for kind, _ in entries], dtype=np.int32), numbers


def _unit(way: Array) -> Array:
    return way / np.linalg.norm(way)
