"""Meshes finer than time and distance can tell apart: their cost follows the accuracy asked, and they stay right."""

from __future__ import annotations

from dataclasses import replace
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

Array = NDArray[np.float64]
N_FINE = 70  # rows of squares of a fine sheet: 15 mm of 0.8 m, far below the size allowed at scale 1, 0.2 m


def sheet(folder: Path, n: int, waves: float = 0.05, name: str = "sheet.ply") -> dict[str, Any]:
    """Return a square sheet of 0.8 m and 2 n (n + 1) triangles, tilted, with waves of some height [m]."""
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.4, 0.4, n + 2), np.linspace(-0.4, 0.4, n + 1)))
    z = waves * np.sin(9 * x) * np.cos(7 * y) + 0.2 * x - 0.3 * y
    write_ply(folder / name, np.stack([x, y, z], axis=1), grid_faces(n, n + 1)[:, ::-1])  # facing -z
    bsdf = {"type": "diffuse", "reflectance": 0.8}
    return {"type": "mesh", "filename": name, "translate": [0.1, -0.05, 0.9], "face_normals": True, "bsdf": bsdf}


def tessellated(*hidden: dict[str, Any], folder: Path, **settings: Any) -> Any:
    """Return the tessellator of a scene."""
    bins = {"bins": (0.6, 0.02, 160)}
    config = flat_wall(*hidden, spp=None, engine="virtual_lights", target_error=0.05, **(bins | settings))
    return Stage.of(config, folder).engine.tessellator


def second_moments(triangles: Array, areas: Array) -> Array:
    """Return the integral of x x^T (3, 3) over triangles (n, 3, 3) of given areas."""
    edges = (triangles + np.roll(triangles, 1, axis=1)) / 2  # exact for squares: the mean over the edges' middles
    return np.einsum("n,nki,nkj->ij", areas / 3, edges, edges)


@pytest.mark.parametrize("patch_scale", [1.0, 0.4])
def test_clusters_lie_where_their_members_do(tmp_path: Path, patch_scale: float) -> None:
    """Area, middle and second moments of a flat sheet are those of its parallelograms, coarse or fine."""
    tessellator = tessellated(sheet(tmp_path, N_FINE, waves=0.0), folder=tmp_path)
    elements, patches = tessellator.elements, tessellator.patches(patch_scale)
    assert patches.is_cluster.all()
    assert len(patches) < len(elements.sizes) / 4
    a, b, c = (patches.corners[:, k] for k in range(3))
    halves = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, a + c - b], axis=1)])
    total = tessellator.shared.areas.sum()
    assert patches.areas.sum() == pytest.approx(total, rel=1e-9)  # flat: one normal
    middle = np.einsum("n,nx->x", patches.areas, patches.centres)
    assert middle == pytest.approx(
        np.einsum("n,nx->x", tessellator.shared.areas, elements.corners.mean(axis=1)), rel=1e-9
    )
    found = second_moments(halves, np.tile(patches.areas / 2, 2))
    assert found == pytest.approx(
        second_moments(elements.corners, tessellator.shared.areas), rel=1e-5
    )  # the planes' ridge


@pytest.mark.parametrize("face_normals", [True, False])
@pytest.mark.parametrize("to_sensor", [(0.0, 0.0, -1.0), (0.5, 0.2, -0.8), (-0.6, 0.3, -0.7)])
def test_clusters_send_on_the_light_of_their_members(
    tmp_path: Path, to_sensor: tuple[float, float, float], face_normals: bool
) -> None:
    """From a laser far away, the light of a wavy sheet to any direction is that of its triangles, exactly.

    They are lit by their shading normals and seen by their own.
    """
    from nlosrender.engine.virtual_lights.elements.clusters import Merger

    tessellator = tessellated(sheet(tmp_path, N_FINE) | {"face_normals": face_normals}, folder=tmp_path)
    elements, normals, areas = tessellator.elements, tessellator.shared.normals, tessellator.shared.areas
    assert np.allclose(elements.shading_normals, normals, atol=1e-6) == face_normals
    to_light = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
    allowed, ratios = tessellator.shared.allowed, np.zeros(len(areas))
    merger = Merger(elements, normals, areas, allowed, ratios, 1e9 * to_light, True, tessellator.tuning)
    patches = merger.clusters(2.0)
    expected = np.einsum("n,n,n->", areas, elements.shading_normals @ to_light, normals @ np.array(to_sensor))
    found = np.einsum("n,n,n->", patches.areas, patches.normals @ to_light, patches.normals @ np.array(to_sensor))
    # 1e9 units away directions differ by 1e-9; nothing is steeper than 60 degrees to the laser. A cluster's area is no
    # more than its members', which binds where it is flat and its shading normals lie off by their float32 rounding.
    assert found == pytest.approx(expected, rel=1e-6)
    assert patches.areas.sum() < 0.99 * areas.sum()  # what bends away from the laser sends less


def test_facets_of_rough_clusters_send_on_the_light_of_their_members(tmp_path: Path) -> None:
    """From anywhere to anywhere, exactly, where several laser points leave no direction to be right for.

    What comes from one side of a cluster does so, too: slopes and positions of its facets vary together as those of its
    members do. Without that, delays are off wherever slopes that face a sensor point lie nearer to it than others.
    """
    from nlosrender.engine.virtual_lights.elements.clusters import Merger

    tessellator = tessellated(crumpled(tmp_path, 60, 0.003), folder=tmp_path)
    elements, normals, areas = tessellator.elements, tessellator.shared.normals, tessellator.shared.areas
    allowed, ratios, light = tessellator.shared.allowed, np.zeros(len(areas)), tessellator.size_field.light
    tuning = replace(tessellator.tuning, facet_roughness=0.0)  # no cluster is flat enough for one
    patches = Merger(elements, normals, areas, allowed, ratios, light, False, tuning).clusters(0.5)
    _, cluster = np.unique(np.round(patches.centres[:, None] + patches.members, 6), axis=0, return_inverse=True)
    assert 2.9 * (cluster.max() + 1) < len(patches) < 0.1 * len(areas)  # one member has one slope
    found = np.einsum("n,ni,nj->ij", patches.areas, patches.normals, patches.normals)
    expected = np.einsum("n,ni,nj->ij", areas, normals, normals)
    np.testing.assert_allclose(found, expected, atol=1e-9 * expected.max())
    assert np.linalg.norm(patches.normals, axis=1) == pytest.approx(1, rel=1e-12)

    def of_slopes(areas: Array, normals: Array, places: Array) -> Array:
        return np.einsum("n,ni,nj->ij", areas * normals[:, 2], normals[:, :2], places)

    expected = of_slopes(areas, normals, elements.corners.mean(axis=1))
    weights = patches.areas * patches.normals[:, 2] ** 2
    sums = [np.bincount(cluster, weights * place) for place in patches.centres.T]
    middles = (np.array(sums) / np.bincount(cluster, weights)).T[cluster]
    errors = [
        np.linalg.norm(of_slopes(patches.areas, patches.normals, places) - expected)
        for places in (patches.centres, middles)
    ]
    assert errors[0] < 0.01 * errors[1]  # shading normals are float32: 6e-8 of areas times places


@pytest.mark.parametrize("patch_scale", [1.0, 0.4])
def test_no_cluster_lies_between_two_sheets(tmp_path: Path, patch_scale: float) -> None:
    """Surfaces of one mesh above one another, 0.15 m apart, are clusters of their own: nothing reflects between."""
    item = sheet(tmp_path, N_FINE, waves=0.0)
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.4, 0.4, N_FINE), np.linspace(-0.4, 0.4, N_FINE + 1)))
    lower = np.stack([x, y, 0.2 * x - 0.3 * y], axis=1)
    faces = grid_faces(N_FINE, N_FINE - 1)[:, ::-1]
    both = np.concatenate([lower, lower + np.array([0, 0, 0.15])])
    write_ply(tmp_path / "sheet.ply", both, np.concatenate([faces, faces + len(lower)]))
    tessellator = tessellated(item, folder=tmp_path)
    patches = tessellator.patches(patch_scale)
    assert patches.is_cluster.all()
    x, y, z = (patches.centres * tessellator.built.metres_per_engine_unit - item["translate"]).T
    heights = z - 0.2 * x + 0.3 * y
    # less than a share p of the other sheet is let pass: p (1 - p) 0.15^2 = level^2 / 12, the level being 0.08 m at
    # scale 1: p = 0.0243; and a quarter of that, a sixteenth, ... by the finer moments that clusters are made of
    assert np.abs(heights - 0.15 * (heights > 0.075)).max() < 0.0243 * 4 / 3 * 0.15
    areas = [patches.areas[which].sum() for which in (heights > 0.075, heights < 0.075)]
    assert areas == pytest.approx([tessellator.shared.areas.sum() / 2] * 2, rel=0.025)


def test_what_a_cluster_is_made_of_does_not_matter(tmp_path: Path) -> None:
    """Elements merged in two steps have the sums of elements merged in one, and a member of each cluster lies in it."""
    tessellator = tessellated(sheet(tmp_path, N_FINE), folder=tmp_path)
    generator, tuning = np.random.default_rng(0), tessellator.tuning
    finest = tessellator.shared.merger._element_moments
    coarse = finest.merged(1.0, generator, tuning)
    twice = finest.merged(0.25, generator, tuning).merged(1.0, generator, tuning)
    assert len(twice) < 1.1 * len(coarse) < 0.1 * len(finest)
    for merged in (coarse, twice):
        assert merged.places.sum(axis=0) == pytest.approx(finest.places.sum(axis=0), rel=1e-9)
        assert merged.light.sum(axis=0) == pytest.approx(finest.light.sum(axis=0), rel=1e-9, abs=1e-12)
        apart = np.linalg.norm(finest.in_box[merged.representatives, :2] - merged.in_box[:, None, :2], axis=2)
        same_facing = finest.facing[merged.representatives] == merged.facing[:, None]
        # of a box and a sliver beside it, 1.3 by 1, no point is farther from the middle than their longer diagonal
        assert same_facing.all()
        assert (apart < 1.65 * 0.8 * 2.0 ** merged.scales[:, None]).all()


def test_the_number_of_patches_follows_the_accuracy_not_the_triangles(tmp_path: Path) -> None:
    """Sheets of one shape, 15 times apart in triangles, are as many patches at the same scale: as counted."""
    few, many = (tessellated(sheet(tmp_path, n), folder=tmp_path) for n in (50, 195))
    for patch_scale in (1.0, 0.7, 0.5):
        assert len(many.patches(patch_scale)) == pytest.approx(len(few.patches(patch_scale)), rel=0.1)
        assert many.count(patch_scale) == pytest.approx(len(many.patches(patch_scale)), rel=0.5)


def rendered(config: dict[str, Any], folder: Path, target: float) -> tuple[Array, float, Array, int]:
    """Return H (laser, sensor, bin), the error stated, H with no triangles merged, and the number of patches."""
    from nlosrender.engine.interface import Budget

    stage = Stage.of(config, folder)
    engine = stage.engine
    budget = engine.calibrate(Budget(target_error=target))
    result = engine.render(stage.batch, budget)
    stated = float(np.sqrt(result.variance.sum() / (result.mean**2).sum()))
    used = len(engine.tessellator.patches(budget.patch_scale))
    unmerged, scale = stage.tuned(merge_ratio=0.0).engine, min(budget.patch_scale, 1.0) / 2
    truth = unmerged.third.gather(stage.batch, scale).values[0, 0, ..., :-1] * unmerged.device.scale
    return result.mean[0, stage.bounces.slot(3)], stated, truth, used


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_merged_mesh_has_the_error_it_states(tmp_path: Path, scan: str) -> None:
    """A fine wavy sheet before and behind which others lie: within twice what is stated, which is what was asked."""
    behind = sheet(tmp_path, N_FINE, 0.02, "behind.ply") | {"translate": [0.3, 0.2, 1.15]}
    keys: dict[str, Any] = {"lasers": (2, 3)} if scan == "exhaustive" else {}
    config = flat_wall(
        sheet(tmp_path, N_FINE), behind, scan=scan, bins=(0.6, 0.02, 200), spp=None, engine="virtual_lights", **keys
    )
    result, stated, truth, used = rendered(config, tmp_path, 0.05)
    assert used < 2 * 2 * N_FINE * (N_FINE + 1) / 2
    assert stated <= 0.05
    assert relative_l2(result - truth, truth) <= 2 * stated


def crumpled(folder: Path, n: int, height: float) -> dict[str, Any]:
    """Return a sheet whose vertices are displaced at random, and no two neighbours alike."""
    item = sheet(folder, n, 0.03, "crumpled.ply")
    along = np.linspace(-0.4, 0.4, n + 1)
    x, y = (side.ravel() for side in np.meshgrid(along, along))
    z = height * np.random.default_rng(n).normal(size=len(x)) + 0.1 * x
    write_ply(folder / "crumpled.ply", np.stack([x, y, z], axis=1), grid_faces(n, n)[:, ::-1])
    return item


HARD = {
    "waves": lambda folder: [sheet(folder, 160)],
    "4 mm apart": lambda folder: [
        sheet(folder, 160),
        sheet(folder, 150, name="behind.ply") | {"translate": [0.15, 0.0, 0.904]},
    ],
    "on its side": lambda folder: [sheet(folder, 160) | {"rotate_deg": [0, 65, 20]}],
    "crumpled": lambda folder: [crumpled(folder, 150, 0.002)],
    "before a plate": lambda folder: [
        sheet(folder, 160) | {"translate": [0.1, 0.0, 0.5], "scale": 0.4},
        {"type": "rectangle", "center": [0.0, 0.0, 0.9], "normal": [0.1, 0.0, -1.0], "width": 1.2, "height": 1.0},
    ],
    "close to the wall": lambda folder: [sheet(folder, 160) | {"translate": [0.1, 0.0, 0.3], "scale": 0.5}],
}


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("target", [0.1, 0.03, 0.01])
@pytest.mark.parametrize("name", HARD)
def test_merged_meshes_have_the_errors_they_state(tmp_path: Path, name: str, target: float, scan: str) -> None:
    """The same for meshes that are hard on clusters, at targets that merge much, little and hardly."""
    keys: dict[str, Any] = {"lasers": (2, 3)} if scan == "exhaustive" else {}
    config = flat_wall(
        *HARD[name](tmp_path), scan=scan, bins=(0.3, 0.01, 300), spp=None, engine="virtual_lights", **keys
    )
    result, stated, truth, used = rendered(config, tmp_path, target)
    ratio = relative_l2(result - truth, truth) / stated
    print(f"{ratio:.2f}  stated {stated:.4f}  patches {used}  target {target}  {name}, {scan}")
    assert ratio <= 2


def smooth_ball(folder: Path, n: int) -> dict[str, Any]:
    """Return a ball of radius 0.25 m as a mesh of 4 n^2 triangles with the normals of the ball."""
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * n + 1), np.linspace(0, np.pi, n + 1))
    unit = np.stack([np.cos(turn) * np.sin(height), np.sin(turn) * np.sin(height), np.cos(height)], axis=-1)
    vertices = unit.reshape(-1, 3)
    faces = grid_faces(n, 2 * n)[:, ::-1] + 1
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in 0.25 * vertices]
    lines += [f"vn {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in faces]
    (folder / "ball.obj").write_text("\n".join(lines) + "\n")
    bsdf = {"type": "diffuse", "reflectance": 0.8}
    return {"type": "mesh", "filename": "ball.obj", "translate": [0.1, -0.1, 0.7], "bsdf": bsdf}


def test_a_fine_mesh_of_a_ball_is_the_ball(tmp_path: Path) -> None:
    """Merged triangles with shading normals send on what Mitsuba's own sphere does, within what both state."""
    from nlosrender.engine.interface import Budget

    ball = {"type": "sphere", "center": [0.1, -0.1, 0.7], "radius": 0.25}
    ball["bsdf"] = {"type": "diffuse", "reflectance": 0.8}
    results, stated = [], []
    for item in (ball, smooth_ball(tmp_path, 60)):
        config = flat_wall(item, bins=(0.6, 0.04, 80), spp=None, engine="virtual_lights")
        stage = Stage.of(config, tmp_path)
        histogram = stage.engine.render(stage.batch, Budget(target_error=0.02))
        results.append(histogram.mean)
        stated.append(float(np.sqrt(histogram.variance.sum() / (histogram.mean**2).sum())))
    assert stage.engine.tessellator.patches(0.8).is_cluster.any()
    # 120 x 60 facets lie up to 0.25 (1 - cos(pi / 60)) = 0.3 mm within the ball, and their area is 0.1 % less
    assert relative_l2(results[1] - results[0], results[0]) <= 2 * sum(stated) + 0.01


def test_shading_normals_across_the_triangles_leave_patches_where_the_mesh_is(tmp_path: Path) -> None:
    """What such members send on may count as negative, without second moments; patches stay within the mesh."""
    n, random = 40, np.random.default_rng(3)
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.4, 0.4, n + 2), np.linspace(-0.4, 0.4, n + 1)))
    vertices = np.stack([x, y, 0.05 * np.sin(9 * x)], axis=1)
    normals = random.normal([0, 0, -0.05], 1, vertices.shape)
    lines = [f"v {' '.join(map(str, row))}" for row in vertices] + [f"vn {' '.join(map(str, row))}" for row in normals]
    lines += ["f " + " ".join(f"{k + 1}//{k + 1}" for k in face) for face in grid_faces(n, n + 1)[:, ::-1]]
    (tmp_path / "rough.obj").write_text("\n".join(lines))
    bsdf = {"type": "diffuse", "reflectance": 0.8}
    item = {"type": "mesh", "filename": "rough.obj", "translate": [0.1, -0.05, 0.9], "bsdf": bsdf}
    tessellator = tessellated(item, folder=tmp_path, scan="confocal")
    for patch_scale in (1.0, 0.7, 0.5):
        corners = tessellator.patches(patch_scale).corners
        assert np.ptp(corners.reshape(-1, 3), axis=0).max() < 1.0  # engine units of 2 m
