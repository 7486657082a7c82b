"""Rays that visibility masks leave out change nothing in what is rendered.

A ray that grazes the plane of its own patch may differ by its last bits, and so may be hidden or not: it carries next
to nothing. Rays that pass an edge of another surface by less than float32 tells would count, but no scene here is made
so. A wrong bound shows: one patch of some hundred that is wrongly seen from one sensor point is 1e-4 and more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import relative_l2
from support.rendering import flat_wall
from support.varied_scenes import Stage

from nlosrender.bench.generated_meshes import grid_faces, write_ply

pytestmark = pytest.mark.usefixtures("backend")

Item = dict[str, Any]
NEVER = 10**12  # points
SAME = 1e-6
DIFFUSE = {"type": "diffuse", "reflectance": 0.6}
TWO_SIDED = {"type": "twosided", "nested": DIFFUSE}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "normal": [0, 0, -1], "bsdf": DIFFUSE}
FRONT, BEHIND = PLATE | {"center": [0.3, 0, 0.8]}, PLATE | {"center": [-0.3, 0, 1.0]}
SMALL = PLATE | {"center": [0.3, 0.3, 0.5], "width": 0.2, "height": 0.2}
LETTER = {"type": "letters", "text": "E", "height": 0.7, "center": [0.1, 0, 0.9], "normal": [0.3, -0.6, -1]} | {
    "thickness": 0.05,
    "bsdf": DIFFUSE,
}
NEAR = PLATE | {"center": [0.3, 0, 0.01], "width": 0.3, "height": 0.2, "normal": [0.1, 0, -1]}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.2], "bsdf": DIFFUSE}
TOUCHING = PLATE | {"center": [0.2, 0.1, 0.3], "normal": [1, 0, 0]}  # its edge lies on the wall
SCENES: dict[str, tuple[Item, ...]] = {
    "letter": (LETTER,),
    "two plates": (FRONT, BEHIND),
    "two-sided": (FRONT | {"normal": [0.5, 0.2, -1], "bsdf": TWO_SIDED}, BEHIND, SMALL),
    "rough conductor": (FRONT | {"bsdf": {"type": "roughconductor", "alpha": 0.3}}, BEHIND),
    "sphere": (BEHIND | {"center": [0, 0, 1]}, {"type": "sphere", "center": [-0.2, 0, 0.7], "radius": 0.2}),
    "near the wall": (NEAR, PLATE | {"center": [0, 0, 0.4], "normal": [1, 0, -1]}),
    "on the wall": (TOUCHING, PLATE | {"center": [0, 0.1, 0.8]}),
    "through the wall": (BEHIND | {"center": [0, 0, 0.1], "normal": [1, 0, -0.3]}, FRONT),
    "touching one another": (
        {"type": "box", "center": [0, 0, 0.8], "size": [0.3, 0.3, 0.4], "bsdf": DIFFUSE},
        {"type": "box", "center": [0.3, 0, 0.8], "size": [0.3, 0.3, 0.2], "bsdf": DIFFUSE},
    ),
}
SCANS = ("single", "confocal", "exhaustive")
TRIED = {
    ("letter", "single"),
    ("two-sided", "exhaustive"),
    ("sphere", "single"),
    ("near the wall", "confocal"),
}


def sheet(folder: Path, n: int, height: float, waves: float, **place: Any) -> Item:
    """Return a fine wavy sheet of 0.8 m as a mesh, with normals of its triangles or of the surface."""
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.4, 0.4, n + 2), np.linspace(-0.4, 0.4, n + 1)))
    z = height * np.sin(waves * x) * np.cos(0.8 * waves * y) + 0.1 * x
    write_ply(folder / "sheet.ply", np.stack([x, y, z], axis=1), grid_faces(n, n + 1)[:, ::-1])
    return {"type": "mesh", "filename": "sheet.ply", "face_normals": True, "bsdf": DIFFUSE} | place


def both(stage: Stage, patch_scale: float) -> list[NDArray[np.float64]]:
    """Return the third bounce with visibility masks, and with rays to every patch."""
    results, third = [], stage.engine.third
    for least in (0, NEVER):
        stage.tuned(min_mask_sensors=least)
        third.forget()
        results.append(third.gather(stage.batch, patch_scale).values)
        known = third.shadow_ray_targets(stage.batch, patch_scale).mask
        assert known.any() == (least == 0)
    return results


def assert_same(stage: Stage, patch_scale: float = 0.6) -> None:
    """Check that masks change nothing."""
    assert stage.engine.settings.needs_visibility
    masked, full = both(stage, patch_scale)
    assert full.sum() > 0
    assert relative_l2(masked - full, full) <= SAME


def stage_of(*hidden: Item, scan: str, folder: Path | None = None, **more: Any) -> Stage:
    """Return a scene's engine, and the batch of all its points."""
    grids = {"sensors": (9, 7), "lasers": (2, 3)}
    return Stage.of(flat_wall(*hidden, scan=scan, engine="virtual_lights", spp=None, **(grids | more)), folder)


@pytest.mark.parametrize(
    ("name", "scan"),
    [
        pytest.param(name, scan, marks=() if (name, scan) in TRIED else pytest.mark.slow)
        for name in SCENES
        for scan in SCANS
    ],
)
def test_masks_change_nothing(name: str, scan: str) -> None:
    """Of scenes that hide parts of themselves, each from some of the wall."""
    assert_same(stage_of(*SCENES[name], scan=scan))


def test_nor_before_a_turned_wall() -> None:
    """Rectangles and tiles are the wall's own."""
    wall = {"normal": [1, 0.1, 0.2], "up": [0, 0.3, 1]}
    letter = LETTER | {"center": [0.9, 0.1, 0.3], "normal": [-1, 0.2, -0.1]}
    plate = PLATE | {"center": [1.2, 0.2, 0], "normal": [-1, 0, 0]}
    assert_same(stage_of(letter, plate, scan="confocal", wall=wall))


@pytest.mark.parametrize("sensors", [pytest.param((1, 1), marks=pytest.mark.slow), (33, 1)], ids=["point", "row"])
def test_nor_seen_from_rectangles_without_area(sensors: tuple[int, int]) -> None:
    """One sensor point, or one row."""
    assert_same(stage_of(FRONT, BEHIND, LETTER, scan="single", sensors=sensors))


@pytest.mark.parametrize("scale", [1e-3, pytest.param(1e3, marks=pytest.mark.slow)])
def test_nor_at_other_scales(scale: float) -> None:
    """A wall of 2 mm, or of 2 km."""
    lengths = ("width", "height", "thickness")
    hidden = [
        {key: value * scale if key in lengths else value for key, value in item.items()}
        | {"center": [scale * x for x in item["center"]]}
        for item in (FRONT, BEHIND, LETTER)
    ]
    wall = {"width": 2 * scale, "height": 1.6 * scale}
    config = flat_wall(*hidden, scan="confocal", sensors=(9, 7), wall=wall, bins=(0, 0.02 * scale, 300))
    config["render"] |= {"engine": "virtual_lights", "spp": None}
    assert_same(Stage.of(config))


@pytest.mark.parametrize("face_normals", [pytest.param(True, marks=pytest.mark.slow), False])
def test_nor_of_meshes_with_or_without_smooth_normals(tmp_path: Path, face_normals: bool) -> None:
    """A sheet that hides its own valleys."""
    mesh = sheet(tmp_path, 12, 0.15, 15.0, translate=[0.1, 0, 0.6], face_normals=face_normals)
    assert_same(stage_of(mesh, scan="exhaustive", folder=tmp_path))


@pytest.mark.parametrize("angle", [0, 80])
@pytest.mark.parametrize("scan", [pytest.param("confocal", marks=pytest.mark.slow), "exhaustive"])
def test_nor_of_clusters(tmp_path: Path, scan: str, angle: float) -> None:
    """A cluster has the normal of all its members, and is looked at where one of them lies: often not in one plane.

    Standing across the wall, it is seen from wall points that lie before the plane through the middle, and behind that
    through the member. What is known of the latter plane says nothing of them.
    """
    mesh = sheet(tmp_path, 120, 0.05, 60.0, translate=[0, 0.2, 0.48], rotate_deg=[angle, 0, 0])
    stage = stage_of(mesh, scan=scan, folder=tmp_path, sensors=(19, 17))
    assert stage.engine.tessellator.patches(1.0).is_cluster.mean() > 0.5
    assert_same(stage, patch_scale=1.0)


@pytest.mark.parametrize("scan", ["single", pytest.param("confocal", marks=pytest.mark.slow)])
def test_nor_of_regions(scan: str) -> None:
    """Each region of the sensor grid looks out of a rectangle of its own."""
    stage = stage_of(ROOM, TOUCHING, scan=scan, sensors=(26, 22))
    stage.tuned(min_region_sensors=16, sensors_per_patch_cost=1)
    assert stage.engine.tessellator.regions is not None
    assert_same(stage, patch_scale=1.0)


def test_nor_of_further_bounces() -> None:
    """VPLs are seen past the same surfaces: from one seed the same contributions arrive."""
    from nlosrender.engine.interface import Budget

    results = []
    for least in (0, NEVER):
        stage = stage_of(FRONT, BEHIND, LETTER, scan="single", max_bounces=5, split_bounces=True)
        stage.tuned(min_mask_sensors=least)
        assert stage.engine.further is not None
        results.append(stage.engine.render(stage.batch, Budget(patch_scale=1.0, rounds=2)).mean[:, -2:])
    assert results[1].sum() > 0
    assert relative_l2(results[0] - results[1], results[1]) <= SAME
