"""Samplers against their densities: chi-square over triangles, analytic shapes and cells of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy import stats
from support.agreement import FALSE_ALARM
from support.rendering import configured, flat_wall

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

N = 2**20
SPHERE = {"type": "sphere", "center": [0.4, 0.2, 0.7], "radius": 0.2}
CYLINDER = {"type": "cylinder", "center": [-0.4, 0.2, 0.6], "radius": 0.1, "height": 0.6, "axis": [0, 1, 0]}
BOX = {"type": "box", "center": [0.0, -0.3, 0.8], "size": [0.5, 0.2, 0.1], "rotate_deg": [10, 20, 30]}
PLATE = {"type": "rectangle", "width": 0.3, "height": 0.4, "center": [0.0, 0.4, 0.9]}


@dataclass(frozen=True, eq=False)
class Sampled:
    """Points of a sampler with the numbers of their shapes and triangles."""

    built: Any
    sampler: Any
    points: np.ndarray  # (n, 3) engine units
    owners: np.ndarray  # registry numbers
    primitives: np.ndarray

    def number(self, shape: Any) -> int:
        import drjit as dr
        import mitsuba as mi

        return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


@pytest.fixture(scope="module")
def sampled() -> Sampled:
    """2^20 points on box, plate, sphere and cylinder."""
    config = configured(flat_wall(BOX, SPHERE, PLATE, CYLINDER))
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.surface_sampler import SurfaceSampler

    built = stages.load_scene(config)
    sampler = SurfaceSampler(built)
    rng = np.random.default_rng(1)
    bits = mi.UInt32(rng.integers(0, 2**32, N, dtype=np.uint32))
    sample = sampler.sample(bits, mi.Float(rng.random(N, dtype=np.float32)), mi.Bool(True))
    owners = dr.reinterpret_array(mi.UInt32, sample.shape)
    return Sampled(
        built,
        sampler,
        np.asarray(sample.p, dtype=np.float64).T,
        np.broadcast_to(np.asarray(owners), N),
        np.broadcast_to(np.asarray(sample.primitive), N),
    )


def assert_shares(*parts: tuple[np.ndarray, np.ndarray]) -> None:
    """Pearson's chi-square of counts against expected shares, for several independent multinomials at once."""
    statistic, freedom = 0.0, 0
    for counts, shares in parts:
        expected = shares / shares.sum() * counts.sum()
        assert expected.min() > 5
        statistic += ((counts - expected) ** 2 / expected).sum()
        freedom += len(counts) - 1
    assert stats.chi2.sf(statistic, freedom) > FALSE_ALARM


def corners_of(mesh: Any) -> np.ndarray:
    """Corners (n, 3, 3) of a mesh's triangles."""
    import mitsuba as mi

    parameters = mi.traverse(mesh)
    return np.reshape(parameters["vertex_positions"], (-1, 3))[np.reshape(parameters["faces"], (-1, 3))].astype(float)


def test_every_triangle_and_shape_is_sampled_by_its_area(sampled: Sampled) -> None:
    """Density 1 / area over all sampled surfaces together; ``area`` is their sum."""
    counts, areas = [], []
    for shape in sampled.built.hidden_shapes:
        own = sampled.owners == sampled.number(shape)
        if not shape.is_mesh():
            counts.append(own.sum())
            areas.append(float(np.ravel(shape.surface_area())[0]))
            continue
        corners = corners_of(shape)
        found = np.bincount(sampled.primitives[own], minlength=len(corners))
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        kept = found > 0
        counts += found[kept].tolist()
        areas += (np.linalg.norm(cross, axis=-1) / 2)[kept].tolist()
        # what is never sampled turns its back to every point of the wall, whose corners are its extremes
        x, y = sampled.built.wall.width / 2, sampled.built.wall.height / 2
        wall = np.array([[x, y, 0], [x, -y, 0], [-x, y, 0], [-x, -y, 0]]) / sampled.built.metres_per_engine_unit
        heights = np.einsum("ikj,kj->ki", wall[:, None] - corners[None, :, 0], cross)
        assert (heights[~kept] <= 0).all()
    assert sum(counts) == N
    # 1 m^2 is 1 / unit^2 engine units
    assert sampled.sampler.area == pytest.approx(sum(areas), rel=1e-5)
    assert_shares((np.array(counts), np.array(areas)))


def test_a_triangle_is_sampled_evenly(sampled: Sampled) -> None:
    """Four congruent sub-triangles, cut by the midlines, hold a quarter each."""
    box = sampled.built.hidden_shapes[0]
    corners = corners_of(box)
    own = sampled.owners == sampled.number(box)
    parts = []
    for triangle in np.unique(sampled.primitives[own]):
        a, b, c = corners[triangle]
        points = sampled.points[own & (sampled.primitives == triangle)]
        weights = np.linalg.lstsq(np.stack([b - a, c - a], axis=-1), (points - a).T, rcond=None)[0].T
        barycentric = np.column_stack([1 - weights.sum(axis=-1), weights])
        assert (barycentric > -1e-5).all()
        cell = np.where(barycentric.max(axis=-1) > 0.5, barycentric.argmax(axis=-1), 3)
        parts.append((np.bincount(cell, minlength=4), np.ones(4)))
    assert len(parts) >= 6
    assert_shares(*parts)


@pytest.mark.parametrize(("index", "item"), [(1, SPHERE), (3, CYLINDER)])
def test_a_round_shape_is_sampled_evenly(sampled: Sampled, index: int, item: dict) -> None:
    """Height and longitude are uniform on both (Archimedes), and every point lies on the surface."""
    shape = sampled.built.hidden_shapes[index]
    unit = sampled.built.metres_per_engine_unit
    away = sampled.points[sampled.owners == sampled.number(shape)] * unit - item["center"]
    distance = np.linalg.norm(away if index == 1 else away[:, [0, 2]], axis=-1)
    np.testing.assert_allclose(distance, item["radius"], rtol=1e-5)
    span = item["radius"] if index == 1 else item["height"] / 2
    height = np.clip((away[:, 1] / span + 1) / 2, 0, 1 - 1e-9)
    turn = np.arctan2(away[:, 0], away[:, 2]) / (2 * np.pi) % 1
    cell = (height * 7).astype(int) * 5 + (turn * 5).astype(int)
    assert_shares((np.bincount(cell, minlength=35), np.ones(35)))


def test_density_is_claimed_for_what_is_sampled_and_nothing_else(sampled: Sampled) -> None:
    """``covers`` holds on hidden surfaces, not on the relay wall and not in the void."""
    import mitsuba as mi

    scene, wall = sampled.built.scene, mi.ShapePtr(sampled.built.wall_shape)
    origin = np.array([0.0, 0.0, 0.1])
    directions = {"hidden": sampled.points[0] - origin, "wall": [0.0, 0.0, -1.0], "void": [1.0, 0.0, 0.05]}
    covered = {}
    for name, direction in directions.items():
        towards = [float(x) for x in np.array(direction) / np.linalg.norm(direction)]
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(towards)))
        covered[name] = bool(sampled.sampler.covers(si, si.shape == wall)[0])
    assert covered == {"hidden": True, "wall": False, "void": False}


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_additive_recurrences_cover_boxes_evenly(dimensions: int) -> None:
    """The share of n points in a box differs from its volume by less than for random numbers."""
    n = 4096
    rng = np.random.default_rng(2)
    from nlosrender.engine.launch.sequences import recurrence_steps

    steps = np.array(recurrence_steps(dimensions), dtype=np.uint64)
    start = rng.integers(0, 2**32, dimensions, dtype=np.uint64)
    points = ((start + np.arange(n, dtype=np.uint64)[:, None] * steps) % 2**32) / 2**32
    corners = rng.random((300, dimensions))
    inside = (points[None] < corners[:, None]).all(axis=-1).mean(axis=-1)
    worst = np.abs(inside - corners.prod(axis=-1)).max()
    # The largest of 300 random deviations, sigma up to 0.5 / sqrt(n), would be above 2 sigma; these fall as 1 / n.
    assert worst < 0.5 / np.sqrt(n)


def test_the_guide_leads_to_the_entry_that_covers_a_number() -> None:
    """The guided search finds what a search of the whole table finds, at the edges of entries, too."""
    sphere = {"type": "sphere", "center": [0.0, 0.0, 3.0], "radius": 1.5}  # beside triangles of a millionth of its area
    letters = {"type": "letters", "text": "S", "height": 0.01, "center": [0, 0, 1], "normal": [0, 0, -1]}
    config = configured(flat_wall(letters, sphere, PLATE))
    start_backend("llvm")
    import mitsuba as mi

    from nlosrender.engine.launch.surface_sampler import SurfaceSampler

    sampler = SurfaceSampler(stages.load_scene(config))
    edges = np.array(sampler._table.edges).astype(np.int64)
    assert len(np.unique(edges)) > 10
    wanted = np.concatenate([edges, edges - 1, edges + 1, np.random.default_rng(2).integers(0, 2**32, 5000)])
    bits = np.clip(wanted, 0, 2**32 - 1)
    expected = np.searchsorted(edges[1:-1], bits, side="right")
    found = sampler._entry(mi.UInt32(bits.astype(np.uint32)), mi.Bool(True))
    np.testing.assert_array_equal(np.array(found), expected)
