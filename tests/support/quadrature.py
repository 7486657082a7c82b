"""Third bounces by brute force: float64 quadrature written from the definition of H, with nothing of the engine.

H of a bin is the integral over the hidden surface, for path lengths in the bin, of

    f_l cos(l->x) * cos(x->l) / r1^2 * f_x * cos(x->s) cos(s->x) / r2^2 * f_s      (f = albedo / pi if Lambertian)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Cells:
    """A surface cut into cells: midpoints (n, 3), unit normals (n, 3), areas (n,), coordinates (n, 2) in [0, 1]."""

    points: Array
    normals: Array
    areas: Array
    uv: Array


@dataclass(frozen=True, eq=False)
class Frame:
    """Right-handed axes from a normal and an up direction: x = up x normal."""

    x: Array
    y: Array
    normal: Array

    @classmethod
    def of(cls, normal: ArrayLike, up: ArrayLike = (0.0, 1.0, 0.0)) -> Frame:
        """Make ``up`` perpendicular to ``normal`` and normalise."""
        normal = unit(np.asarray(normal, dtype=np.float64))
        x = unit(np.cross(np.asarray(up, dtype=np.float64), normal))
        return cls(x, np.cross(normal, x), normal)


def unit(vectors: Array) -> Array:
    """Normalise vectors along the last axis."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def midpoints(n: int) -> Array:
    """Midpoints of n equal cells of [0, 1]."""
    return (np.arange(n) + 0.5) / n


def grid_points(
    nx: int, ny: int, width: float, height: float, center: ArrayLike = (0, 0, 0), frame: Frame | None = None
) -> Array:
    """Cell centres of a grid on a rectangle, rows ascending in its y: (ny, nx, 3)."""
    frame = frame or Frame.of(Z)
    x = ((midpoints(nx) - 0.5) * width)[None, :, None]
    y = ((midpoints(ny) - 0.5) * height)[:, None, None]
    return np.asarray(center, dtype=np.float64) + x * frame.x + y * frame.y


def rectangle_cells(
    width: float, height: float, center: ArrayLike, normal: ArrayLike, up: ArrayLike = (0, 1, 0), n: int = 400
) -> Cells:
    """A rectangle in n x n cells."""
    frame = Frame.of(normal, up)
    points = grid_points(n, n, width, height, center, frame).reshape(-1, 3)
    uv = np.stack(np.meshgrid(midpoints(n), midpoints(n)), axis=-1).reshape(-1, 2)
    return Cells(points, np.broadcast_to(frame.normal, points.shape), np.full(n * n, width * height / n**2), uv)


def sphere_cells(center: ArrayLike, radius: float, n: int = 400, *, inside: bool = False) -> Cells:
    """A sphere in n x n cells of equal area (Archimedes: height and longitude are uniform)."""
    height, longitude = np.meshgrid(2 * midpoints(n) - 1, 2 * np.pi * midpoints(n))
    across = np.sqrt(1 - height**2)
    outward = np.stack([across * np.cos(longitude), height, across * np.sin(longitude)], axis=-1).reshape(-1, 3)
    areas = np.full(n * n, 4 * np.pi * radius**2 / n**2)
    points = np.asarray(center, dtype=np.float64) + radius * outward
    return Cells(points, -outward if inside else outward, areas, np.zeros((n * n, 2)))


def cylinder_cells(center: ArrayLike, radius: float, height: float, n: int = 400) -> Cells:
    """A tube about an axis along y, seen from outside."""
    along, angle = np.meshgrid((midpoints(n) - 0.5) * height, 2 * np.pi * midpoints(n))
    outward = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1).reshape(-1, 3)
    points = np.asarray(center, dtype=np.float64) + radius * outward
    points[:, 1] += along.ravel()
    return Cells(points, outward, np.full(n * n, 2 * np.pi * radius * height / n**2), np.zeros((n * n, 2)))


def joined(*parts: Cells) -> Cells:
    """All cells of several surfaces."""
    fields = ("points", "normals", "areas", "uv")
    return Cells(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))


def box_cells(center: ArrayLike, size: Sequence[float], n: int = 200) -> Cells:
    """The six sides of an upright box."""
    sides = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            middle = np.asarray(center, dtype=np.float64) + normal * size[axis] / 2
            # up x normal = +-(axis u): the rectangle's width runs along u, its height along v
            sides.append(rectangle_cells(size[u], size[v], middle, normal, np.eye(3)[v], n))
    return joined(*sides)


Brdf = Callable[[Cells, Array, Array], Array]  # (cells, unit directions to laser, to sensor) -> f [1/sr]
WallBrdf = Callable[[Array, Array], Array]  # (direction to the device (3,), directions to the cells (n, 3)) -> f [1/sr]


@dataclass(frozen=True, eq=False)
class Setup:
    """What a third bounce depends on, beside laser point and sensor point."""

    cells: Cells
    edges: Array  # of the bins, equally spaced [m]
    rho: float = 1.0  # hidden albedo
    rho_wall: float = 1.0
    energy: float = 1.0
    wall_normal: Array = None  # type: ignore[assignment]
    laser_leg: float = 0.0
    sensor_leg: float = 0.0
    visible: Callable[[Array, Array], Array] | None = None  # (point (3,), cells (n, 3)) -> (n,) bool
    brdf: Brdf | None = None
    laser_brdf: WallBrdf | None = None
    sensor_brdf: WallBrdf | None = None


@dataclass(frozen=True)
class Legs:
    """From one point on the wall to every cell."""

    value: Array  # of the point's factors in H
    opl: Array  # optical path length [m]
    way_back: Array  # (n, 3), unit, from the cells to the point


def legs_of(setup: Setup, point: Array, wall_brdf: WallBrdf | None) -> Legs:
    """Return the way between a laser or sensor point and every cell."""
    cells = setup.cells
    wall_normal = Z if setup.wall_normal is None else setup.wall_normal
    way = cells.points - point
    distance = np.sqrt(np.einsum("ij,ij->i", way, way))
    way /= distance[:, None]
    at_wall = np.maximum(way @ wall_normal, 0)
    at_cell = np.maximum(-np.einsum("ij,ij->i", way, cells.normals), 0)
    value = at_wall * at_cell / distance**2
    value = value * (setup.rho_wall / np.pi if wall_brdf is None else wall_brdf(point, way))
    if setup.visible is not None:
        value = value * setup.visible(point, cells.points)
    return Legs(value, distance, -way)


def of_pair(setup: Setup, to_laser: Legs, to_sensor: Legs) -> tuple[Array, Array]:
    """Value [J m^-2 sr^-1] and optical path length [m] of every cell."""
    value = setup.cells.areas * setup.energy * to_laser.value * to_sensor.value
    value *= setup.rho / np.pi if setup.brdf is None else setup.brdf(setup.cells, to_laser.way_back, to_sensor.way_back)
    return value, setup.laser_leg + setup.sensor_leg + to_laser.opl + to_sensor.opl


def contributions(setup: Setup, laser: Array, sensor: Array) -> tuple[Array, Array]:
    """Value [J m^-2 sr^-1] and optical path length [m] of every cell for one pair of points."""
    return of_pair(setup, legs_of(setup, laser, setup.laser_brdf), legs_of(setup, sensor, setup.sensor_brdf))


def third_bounce(setup: Setup, laser: Array, sensor: Array) -> Array:
    """Histogram (bins,) of one pair; light outside the edges is left out."""
    value, opl = contributions(setup, laser, sensor)
    return binned(value, opl, setup.edges)


def binned(value: Array, opl: Array, edges: Array) -> Array:
    """Sum values by bin; the edges are equally spaced."""
    n = len(edges) - 1
    index = np.floor((opl - edges[0]) / (edges[-1] - edges[0]) * n).astype(np.int64)
    inside = (index >= 0) & (index < n)
    return np.bincount(index[inside], weights=value[inside], minlength=n)


def third_bounces(setup: Setup, lasers: Array, sensors: Array) -> Array:
    """Histograms (ly, lx, sy, sx, bins) of every pair of two grids (y, x, 3)."""
    rows = []
    for laser in lasers.reshape(-1, 3):
        to_laser = legs_of(setup, laser, setup.laser_brdf)
        for sensor in sensors.reshape(-1, 3):
            value, opl = of_pair(setup, to_laser, legs_of(setup, sensor, setup.sensor_brdf))
            rows.append(binned(value, opl, setup.edges))
    return np.array(rows).reshape(*lasers.shape[:2], *sensors.shape[:2], -1)


def confocal_third_bounces(setup: Setup, points: Array) -> Array:
    """Histograms (1, 1, sy, sx, bins) where laser and sensor share each point of a grid (y, x, 3)."""
    rows = []
    for point in points.reshape(-1, 3):
        to_laser = to_sensor = legs_of(setup, point, setup.laser_brdf)
        if setup.sensor_brdf is not setup.laser_brdf:
            to_sensor = legs_of(setup, point, setup.sensor_brdf)
        rows.append(binned(*of_pair(setup, to_laser, to_sensor), setup.edges))
    return np.array(rows).reshape(1, 1, *points.shape[:2], -1)


def clear_of_rectangle(
    center: ArrayLike, normal: ArrayLike, width: float, height: float, up: ArrayLike = (0, 1, 0)
) -> Callable[[Array, Array], Any]:
    """Visibility past a rectangular occluder: false where the segment from a point to a cell crosses it."""
    frame = Frame.of(normal, up)
    middle = np.asarray(center, dtype=np.float64)

    def visible(point: Array, cells: Array) -> Array:
        before, after = (point - middle) @ frame.normal, (cells - middle) @ frame.normal
        crossing = before * after < 0
        share = before / np.where(crossing, before - after, 1.0)
        where = point + share[:, None] * (cells - point) - middle
        covered = (np.abs(where @ frame.x) < width / 2) & (np.abs(where @ frame.y) < height / 2)
        return ~(crossing & covered)

    return visible
