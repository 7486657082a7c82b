"""Sheets with texture coordinates, written as .ply or .obj: walls for tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Surface = Callable[[Array, Array], tuple[Array, Array, Array]]


def flat(width: float, height: float) -> Surface:
    """Return the map from (u, v) to a rectangle in z = 0, centred on the origin."""
    return lambda u, v: ((u - 0.5) * width, (v - 0.5) * height, 0 * u)


def wavy(width: float, height: float, depth: float) -> Surface:
    """Return the map to a rectangle with hills and valleys."""

    def surface(u: Array, v: Array) -> tuple[Array, Array, Array]:
        x, y = (u - 0.5) * width, (v - 0.5) * height
        return x, y, depth * np.sin(4 * x) * np.cos(3 * y)

    return surface


def globe(radius: float) -> Surface:
    """Return the equal-area map to a sphere; at the poles half of the triangles have no area."""

    def surface(u: Array, v: Array) -> tuple[Array, Array, Array]:
        longitude, height = (u - 0.5) * 2 * np.pi, 2 * v - 1
        across = radius * np.sqrt(np.maximum(1 - height**2, 0))
        return across * np.sin(longitude), radius * height, across * np.cos(longitude)

    return surface


def sheet(surface: Surface, columns: int, rows: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return vertices (n, 3), texture coordinates (n, 2) and faces (m, 3) of a grid of quads cut in two."""
    u, v = (values.ravel() for values in np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)))
    index = np.arange(len(u)).reshape(rows + 1, columns + 1)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack(surface(u, v), axis=1), np.stack([u, v], axis=1), faces


def write_uv_ply(path: Path, vertices: Array, uvs: Array | None, faces: NDArray[np.int64]) -> str:
    """Write a mesh as ASCII .ply; return its name."""
    names = ["x", "y", "z"] + ([] if uvs is None else ["u", "v"])
    rows = vertices if uvs is None else np.concatenate([vertices, uvs], axis=1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property double {n}" for n in names)]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = [*(" ".join(f"{x!r}" for x in row) for row in rows.tolist()), *(f"3 {a} {b} {c}" for a, b, c in faces)]
    path.write_text("\n".join(header + lines) + "\n")
    return path.name


def write_obj(path: Path, vertices: Array, uvs: Array, faces: NDArray[np.int64]) -> str:
    """Write a mesh as .obj; return its name."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + [f"vt {u!r} {v!r}" for u, v in uvs.tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path.name
