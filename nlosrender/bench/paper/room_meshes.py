"""Two procedural interiors for closed rooms: a statue of half a million triangles, and furniture of 1.2 million.

They stand in for scanned models that are not ours to ship. Coordinates are those of a room of 2 x 2 m whose relay wall
lies in z = 0 and whose floor is y = -1.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlosrender.bench.generated_meshes import grid_faces, write_ply

Float64 = NDArray[np.float64]
Mesh = tuple[Float64, NDArray[np.int64]]

FLOOR = -1.0  # y [m]
WAVES = 5  # octaves of the relief of the statue


def write_statue(path: Path, n_triangles: int) -> None:
    """Write a standing figure: a surface of revolution on a plinth, displaced by waves down to 2 mm."""
    radius = _profile()

    def statue(around: Float64, up: Float64) -> Float64:
        angle = 2 * np.pi * around
        relief = sum(
            0.03 / 2**k * np.sin(3 * 2**k * angle + 7 * k + 5 * np.sin(9 * up)) * np.cos(11 * 2**k * up + k)
            for k in range(WAVES)
        )
        wide = np.maximum(radius(up) * (1 + relief / 0.2), 2e-3)
        sway = 0.05 * np.sin(5 * up)
        return np.stack([wide * np.sin(angle) + sway, FLOOR + 1e-3 + 1.3 * up, 1.1 + wide * np.cos(angle)], axis=-1)

    columns = round((n_triangles / 4) ** 0.5)
    write_ply(path, *surface(statue, 2 * columns, columns))


def write_furniture(path: Path, n_triangles: int) -> None:
    """Write a table, four stools, shelves of books, a lamp, and a carpet that takes the largest part."""
    parts = [
        *_table(0.25, 1.15),
        *(_stool(x, z) for x, z in ((-0.15, 0.75), (0.65, 0.75), (-0.15, 1.55), (0.65, 1.55))),
        *_shelves(),
        ellipsoid((-0.6, 0.45, 0.6), (0.12, 0.16, 0.12), 96),
    ]
    left = n_triangles - sum(len(faces) for _, faces in parts)
    side = max(8, round((left / 2) ** 0.5))

    def carpet(across: Float64, along: Float64) -> Float64:
        pile = 0.012 * np.abs(np.sin(180 * across) * np.cos(170 * along)) + 0.004 * np.sin(23 * across * along)
        return np.stack([1.8 * across - 0.9, FLOOR + 6e-3 + pile, 1.9 - 1.7 * along], axis=-1)

    parts.append(surface(carpet, side, side))
    write_ply(path, *joined(parts))


def surface(point: Callable[[Float64, Float64], Float64], rows: int, columns: int) -> Mesh:
    """Return a mesh of ``point(u, v)`` for u in [0, 1] along columns and v in [0, 1] along rows."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    return point(u, v).reshape(-1, 3), grid_faces(rows, columns)


def ellipsoid(center: tuple[float, float, float], radii: tuple[float, float, float], n: int) -> Mesh:
    """Return an ellipsoid of about 4 n^2 triangles, seen from outside."""

    def point(u: Float64, v: Float64) -> Float64:
        sine, cosine = np.sin(np.pi * v), -np.cos(np.pi * v)
        unit = np.stack([sine * np.sin(2 * np.pi * u), cosine, sine * np.cos(2 * np.pi * u)], axis=-1)
        return np.asarray(center) + np.asarray(radii) * unit

    return surface(point, n, 2 * n)


def block(low: tuple[float, float, float], high: tuple[float, float, float], n: int) -> Mesh:
    """Return a box whose six faces have 2 n^2 triangles each, seen from outside."""
    lower, size = np.asarray(low), np.asarray(high) - np.asarray(low)
    parts = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for end in (0.0, 1.0):
            first, second = (a, b) if end else (b, a)

            def point(u: Float64, v: Float64, first: int = first, second: int = second, axis: int = axis,
                      end: float = end) -> Float64:  # fmt: skip
                corner = np.zeros((*u.shape, 3))
                corner[..., first], corner[..., second], corner[..., axis] = u, v, end
                return lower + size * corner

            parts.append(surface(point, n, n))
    return joined(parts)


def joined(parts: list[Mesh]) -> Mesh:
    """Return several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _profile() -> Callable[[Float64], Float64]:
    """Return the radius of the statue [m] over its height: plinth, feet, waist, shoulders, neck, head."""
    heights = [0.0, 0.08, 0.1, 0.3, 0.5, 0.66, 0.74, 0.79, 0.88, 0.97, 1.0]
    radii = [0.3, 0.3, 0.2, 0.17, 0.13, 0.22, 0.2, 0.07, 0.11, 0.08, 0.003]
    return lambda up: np.interp(up, heights, radii)


def _table(x: float, z: float) -> list[Mesh]:
    top = block((x - 0.45, FLOOR + 0.55, z - 0.3), (x + 0.45, FLOOR + 0.59, z + 0.3), 60)
    legs = [
        block((x + dx - 0.02, FLOOR, z + dz - 0.02), (x + dx + 0.02, FLOOR + 0.55, z + dz + 0.02), 20)
        for dx in (-0.4, 0.4)
        for dz in (-0.25, 0.25)
    ]
    bowl = ellipsoid((x, FLOOR + 0.63, z), (0.14, 0.04, 0.14), 64)
    return [top, *legs, bowl]


def _stool(x: float, z: float) -> Mesh:
    seat = ellipsoid((x, FLOOR + 0.36, z), (0.13, 0.04, 0.13), 64)
    leg = block((x - 0.02, FLOOR, z - 0.02), (x + 0.02, FLOOR + 0.33, z + 0.02), 16)
    return joined([seat, leg])


def _shelves() -> list[Mesh]:
    """Three boards on the left wall with books of many widths and heights."""
    parts = []
    generator = np.random.default_rng(7)
    for board in range(3):
        y = FLOOR + 0.7 + 0.4 * board
        parts.append(block((-0.99, y, 0.9), (-0.75, y + 0.02, 1.8), 24))
        z = 0.92
        while z < 1.74:
            thick, high, deep = generator.uniform((0.015, 0.17, 0.12), (0.05, 0.3, 0.2))
            parts.append(block((-0.98, y + 0.02, z), (-0.98 + deep, y + 0.02 + high, z + thick), 10))
            z += thick + 0.002
    return parts
