"""Spheres and cylinders as analytic shapes, against quadrature and against fine meshes of the same."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.quadrature import Array, Cells, Setup, cylinder_cells, grid_points, sphere_cells, third_bounces
from support.rendering import flat_wall, render

from nlosrender.bench.generated_meshes import write_ply

REPLICAS = 32
BINS = (0.7, 0.05, 40)
EDGES = 0.7 + 0.05 * np.arange(41)
CENTER, RADIUS, HEIGHT = [0.2, -0.1, 0.7], 0.25, 0.5
SPHERE = {"type": "sphere", "center": CENTER, "radius": RADIUS}
CYLINDER = {"type": "cylinder", "center": CENTER, "radius": RADIUS, "height": HEIGHT, "axis": [0, 1, 0]}


def mesh_of_revolution(profile: Array, n: int) -> tuple[Array, Array]:
    """Turn a profile (m, 2) of (radius, y), y ascending, about the y axis in n steps; outward triangles."""
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.zeros(n), np.sin(angle)], axis=-1)
    vertices = profile[:, None, :1] * ring + profile[:, None, 1:] * np.array([0.0, 1.0, 0.0])
    i, j = (k.ravel() for k in np.meshgrid(np.arange(len(profile) - 1), np.arange(n), indexing="ij"))
    a, b = i * n + j, i * n + (j + 1) % n
    faces = np.concatenate([np.stack([a, a + n, b], axis=-1), np.stack([b, a + n, b + n], axis=-1)])
    corners = vertices.reshape(-1, 3)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return vertices.reshape(-1, 3) + CENTER, faces[area > 1e-12]


SHAPES = {
    "sphere": (SPHERE, lambda: sphere_cells(CENTER, RADIUS, 500)),
    "cylinder": (CYLINDER, lambda: cylinder_cells(CENTER, RADIUS, HEIGHT, 500)),
}


@pytest.mark.parametrize("hidden_geometry_sampling", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_convex_shape_is_that_of_quadrature(shape: str, hidden_geometry_sampling: bool) -> None:
    """What faces away from laser or sensor is dark by its cosine; nothing else hides a convex shape."""
    item, cells_of = SHAPES[shape]
    cells: Cells = cells_of()
    config = flat_wall(item, sensors=(3, 2), bins=BINS, spp=65536, hidden_geometry_sampling=hidden_geometry_sampling)
    result = render(config, replicas=REPLICAS)
    reference = third_bounces(Setup(cells, EDGES), np.array([[[0.3, -0.2, 0.0]]]), grid_points(3, 2, 2.0, 1.6))
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=2e-3)


@pytest.mark.parametrize(
    ("shape", "scan"),
    [("sphere", "single"), ("cylinder", "confocal")]
    + [
        pytest.param(shape, scan, marks=pytest.mark.slow)
        for shape, scan in product(SHAPES, ("single", "confocal", "exhaustive"))
        if (shape, scan) not in (("sphere", "single"), ("cylinder", "confocal"))
    ],
)
def test_a_fine_mesh_renders_as_the_shape_it_approximates(shape: str, scan: str, tmp_path: Path) -> None:
    """20 000 or more triangles, flat: chords of a circle of 200 pieces are off by (pi / 200)^2 / 2 = 1e-4."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 101)
    profile = {
        "sphere": np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle)], axis=-1),
        "cylinder": np.stack([np.full(51, RADIUS), np.linspace(-HEIGHT / 2, HEIGHT / 2, 51)], axis=-1),
    }[shape]
    write_ply(tmp_path / "fine.ply", *mesh_of_revolution(profile, 200))
    mesh = {"type": "mesh", "filename": "fine.ply", "face_normals": True}
    analytic, triangles = (
        render(
            flat_wall(item, scan=scan, sensors=(3, 2), lasers=(1, 2), bins=BINS, spp=65536, seed=seed, max_bounces=4),
            folder=tmp_path,
            replicas=REPLICAS,
        )
        for seed, item in enumerate((SHAPES[shape][0], mesh))
    )
    # the facets' flat normals change a cosine by up to pi / 200, up and down alike: 1e-3 of the brightest bin
    assert_agrees(
        triangles.bounce(3),
        triangles.bounce_variance(3),
        analytic.bounce(3),
        reference_variance=analytic.bounce_variance(3),
        replicas=REPLICAS,
        floor=1e-3,
    )


def test_hidden_geometry_sampling_loses_nothing_on_tiny_triangles(tmp_path: Path) -> None:
    """The energy of 160 000 triangles, 2 mm each, is that found by BSDF sampling.

    A ray that lands in the triangle next to its target is taken for occluded: rounding of 1e-7 against edges of 1e-3
    may cost 3e-4, an offset of the ray's origin must not cost more.
    """
    angle = np.linspace(-np.pi / 2, np.pi / 2, 201)
    profile = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle)], axis=-1)
    write_ply(tmp_path / "tiny.ply", *mesh_of_revolution(profile, 400))
    mesh = {"type": "mesh", "filename": "tiny.ply", "face_normals": True}
    sampled, by_chance = (
        render(
            flat_wall(mesh, sensors=(3, 2), bins=(0.0, 10.0, 1), spp=262144, hidden_geometry_sampling=flag),
            folder=tmp_path,
            replicas=REPLICAS,
        )
        for flag in (True, False)
    )
    sigma = np.sqrt(sampled.variance.sum() + by_chance.variance.sum())
    energy = by_chance.total.sum()
    assert abs(sampled.total.sum() - energy) < 4 * sigma + 6e-4 * energy
    assert sigma < 1e-3 * energy


@pytest.mark.parametrize("hidden_geometry_sampling", [True, False])
def test_a_shape_that_cannot_be_sampled_is_found_by_chance(hidden_geometry_sampling: bool, tmp_path: Path) -> None:
    """A plugin shape beside a sphere: mixed or by chance alone, the result is the same."""
    (tmp_path / "rod.txt").write_text("-0.7 0.1 0.5 0.1\n-0.3 0.4 0.6 0.1\n")  # x y z radius
    rod = {"type": "mitsuba", "shape": {"type": "linearcurve", "filename": "rod.txt"}}
    results = [
        render(
            flat_wall(
                SPHERE,
                rod,
                sensors=(3, 2),
                bins=BINS,
                spp=65536,
                hidden_geometry_sampling=hidden_geometry_sampling,
                seed=seed,
            ),
            folder=tmp_path,
            replicas=REPLICAS,
            **options,
        )
        for seed, options in enumerate(({}, {"p_hidden_sampling": 0.0}))
    ]
    mixed, by_chance = results
    without = render(flat_wall(SPHERE, sensors=(3, 2), bins=BINS, spp=65536))
    assert by_chance.total.sum() > 1.1 * without.total.sum()  # the rod is there
    assert_agrees(
        mixed.total,
        mixed.total_variance,
        by_chance.total,
        reference_variance=by_chance.total_variance,
        replicas=REPLICAS,
    )
