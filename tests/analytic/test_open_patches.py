"""Patches in the hull of the hidden geometry take no visibility rays, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
from rendering import configured, flat_wall

from nlosrender import pipeline
from nlosrender.engine.backend import start_backend

LETTER = {"type": "letters", "text": "E", "height": 0.7, "center": [0.1, 0, 0.9], "normal": [0.1, -0.2, -1]} | {
    "thickness": 0.05,
    "bsdf": {"type": "diffuse", "reflectance": 0.6},
}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "normal": [0, 0, -1]}
FRONT, BEHIND = PLATE | {"center": [0.3, 0, 0.8]}, PLATE | {"center": [-0.3, 0, 1.0]}


def engine_of(*hidden: dict, scan: str = "single"):
    """Return the virtual-light engine of a scene, and the plan."""
    config = configured(flat_wall(*hidden, scan=scan, sensors=(7, 5), engine="virtual_lights", spp=None))
    backend = start_backend("llvm")
    built = pipeline.load_scene(config)
    capture, time_axis = pipeline.describe_capture(config, built.wall, built)
    return pipeline.prepare(config, backend, built, capture, time_axis)


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("hidden", [(LETTER,), (FRONT, BEHIND)], ids=["letter", "two plates"])
def test_rays_to_open_patches_change_nothing(hidden: tuple[dict, ...], scan: str) -> None:
    """What lies in a face of the hull is seen by the whole wall: leaving its rays out gives the same bits."""
    plan, engine = engine_of(*hidden, scan=scan)
    third, batch = engine.third, plan.batches[0]
    assert engine.settings.needs_visibility
    is_open = third.lit_patches(batch, 0.5).is_open
    assert is_open.any()
    assert not is_open.all()
    without = third.gather(batch, 0.5).values
    third.hull.corners = None
    assert not third.lit_patches(batch, 0.5).is_open.any()
    assert without.sum() > 0
    np.testing.assert_array_equal(third.gather(batch, 0.5).values, without)


def test_only_the_foremost_plate_is_open() -> None:
    """A plate has the other one before its plane, or behind it."""
    plan, engine = engine_of(FRONT, BEHIND)
    lit = engine.third.lit_patches(plan.batches[0], 0.7)
    depth = lit.positions[:, 2] * engine.built.unit
    np.testing.assert_array_equal(lit.is_open, depth < 0.9)


def test_no_patch_of_a_two_sided_surface_is_open() -> None:
    """What is seen from behind is seen past whatever lies behind its plane."""
    two_sided = {"type": "twosided", "nested": {"type": "diffuse"}}
    plan, engine = engine_of(FRONT | {"bsdf": two_sided}, BEHIND)
    assert not engine.third.lit_patches(plan.batches[0], 0.7).is_open.any()


def test_a_sphere_counts_by_its_box() -> None:
    """A plate before a sphere is open; before a sphere that reaches over its plane it is not."""
    for z, expected in ((1.2, True), (0.9, False)):
        plan, engine = engine_of(FRONT, {"type": "sphere", "center": [-0.5, 0, z], "radius": 0.2})
        lit = engine.third.lit_patches(plan.batches[0], 0.7)
        plate = np.abs(lit.positions[:, 2] * engine.built.unit - 0.8) < 1e-3
        plate &= lit.normals[:, 2] < -0.999
        assert plate.any()
        assert (lit.is_open[plate] == expected).all()


@pytest.mark.parametrize("shape", ["plane", "line", "solid"])
def test_the_hull_of_many_points_is_few_points_that_reach_as_far(shape: str) -> None:
    """20,000 points of a tilted rectangle have four outermost ones: patches times points would take minutes."""
    from nlosrender.engine.virtual_lights.occlusion import _outermost

    generator = np.random.default_rng(2)
    flat = generator.random((20_000, 3)) * {"plane": [1, 1, 0], "line": [1, 0, 0], "solid": [1, 1, 1]}[shape]
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * flat.max(axis=0)
    turn = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    points = np.concatenate([flat, np.unique(corners, axis=0)]) @ turn.T + [0.3, 0.1, 2.0]
    found = _outermost(points)
    assert len(found) <= 16
    directions = generator.normal(size=(100, 3))
    np.testing.assert_allclose((directions @ found.T).max(axis=1), (directions @ points.T).max(axis=1), atol=1e-9)
