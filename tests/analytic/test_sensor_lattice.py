"""Visibility that is interpolated between the nodes of a sensor lattice: docs/virtual-lights.md, 5.8."""

from __future__ import annotations

import math
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

DIFFUSE = {"type": "diffuse", "reflectance": 0.6}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "normal": [0, 0, -1], "bsdf": DIFFUSE}
FRONT, BEHIND = PLATE | {"center": [0.3, 0, 0.6]}, PLATE | {"center": [-0.2, 0, 1.0]}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.2], "bsdf": DIFFUSE}
SCANS = ("single", "confocal")


def stage_of(*hidden: dict[str, Any], scan: str, folder: Path | None = None, **more: Any) -> Stage:
    """Return a scene's engine, and the batch of all its points."""
    arguments = {"sensors": (33, 29), "bins": (0, 0.03, 300), "engine": "virtual_lights", "spp": None} | more
    return Stage.of(flat_wall(*hidden, scan=scan, **arguments), folder)


def gathered(stage: Stage, patch_scale: float, step: int | None = None, rays: int = 1) -> NDArray[np.float64]:
    """Return the third bounce, by nodes ``step`` points apart; None: every point sends rays of its own."""
    from nlosrender.engine.virtual_lights.refinement import Lattice

    lattice = None if step is None else Lattice(step, rays)
    stage.engine.third.forget()
    return np.asarray(stage.engine.third.gather(stage.batch, patch_scale, lattice=lattice).values)


@pytest.mark.parametrize("scan", SCANS)
@pytest.mark.parametrize("hidden", [(FRONT, BEHIND), (ROOM, FRONT)], ids=["plates", "room"])
def test_nodes_at_all_points_see_what_the_points_see(scan: str, hidden: tuple[dict[str, Any], ...]) -> None:
    """With a node at every point nothing is interpolated, with regions of the sensor grid and without."""
    stage = stage_of(*hidden, scan=scan).tuned(min_region_sensors=16, sensors_per_patch_cost=1)
    own = gathered(stage, 1.0)
    assert own.sum() > 0
    assert relative_l2(gathered(stage, 1.0, 1) - own, own) <= 1e-6


@pytest.mark.parametrize("scan", SCANS)
def test_what_nothing_hides_is_not_changed(scan: str) -> None:
    """Where all nodes see all of a patch, so do the points between them."""
    stage = stage_of(PLATE | {"center": [-0.6, 0, 1]}, PLATE | {"center": [0.6, 0, 1.2]}, scan=scan)
    own = gathered(stage, 1.0)
    for rays in (1, 4):
        assert relative_l2(gathered(stage, 1.0, 4, rays) - own, own) <= 1e-6


@pytest.mark.parametrize("scan", ["single", pytest.param("confocal", marks=pytest.mark.slow)])
def test_interpolation_errs_as_the_step_at_least(scan: str) -> None:
    """Bilinear interpolation errs as the squared step inside a penumbra, at kinks of the visible share as the step.

    So from steps of 8 to steps of 2 the error of a shadow that covers several cells falls by 4 at least.
    """
    stage = stage_of(FRONT, BEHIND, scan=scan)
    own = gathered(stage, 0.25, 1, 4)
    narrow, wide = (relative_l2(gathered(stage, 0.25, step, 4) - own, own) for step in (2, 8))
    assert 4 * narrow < wide < 0.05


def test_four_rays_halve_the_noise() -> None:
    """The share of a patch that is seen is told by four points, drawn evenly: half the deviation of one, or less.

    Confocal, where nothing but visibility is random: a single laser sends four rays to a patch in any case.
    """
    from nlosrender.engine.virtual_lights.refinement import Lattice

    stage, noise = stage_of(FRONT, BEHIND, scan="confocal", sensors=(17, 13)), {}
    for rays in (1, 4):
        engines = (stage.seeded(seed) for seed in range(16))
        sums = [one.third.gather(stage.batch, 1.0, lattice=Lattice(4, rays)).values.sum(axis=-1) for one in engines]
        noise[rays] = math.sqrt(np.var(sums, axis=0, ddof=1).sum() / np.square(np.mean(sums, axis=0)).sum())
    assert noise[4] < 0.7 * noise[1]  # 15 degrees of freedom at least: 0.5 +- 0.1


def carpet(folder: Path) -> dict[str, Any]:
    """Return a steep pile as a mesh: what faces the wall is hidden less often than what does not."""
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.4, 0.4, 142), np.linspace(-0.4, 0.4, 141)))
    z = -0.02 * np.abs(np.sin(80 * x) * np.cos(75 * y))
    write_ply(folder / "carpet.ply", np.stack([x, y, z], axis=1), grid_faces(140, 141)[:, ::-1])
    return {"type": "mesh", "filename": "carpet.ply", "face_normals": True, "bsdf": DIFFUSE}


@pytest.mark.parametrize(
    ("angle", "scan"),
    [
        (30, "single"),
        (0, "confocal"),
        pytest.param(0, "single", marks=pytest.mark.slow),
        pytest.param(30, "confocal", marks=pytest.mark.slow),
    ],
)
def test_clusters_of_a_steep_pile_keep_their_light(tmp_path: Path, scan: str, angle: float) -> None:
    """Members count by their cosines: what faces a point is hidden less often than what is turned away.

    One ray, to a member drawn by area, leaves clusters 0.5 to 2.5 % too dark; truth: all triangles are patches.
    """
    mesh = carpet(tmp_path) | {"translate": [0, 0.1, 0.8], "rotate_deg": [angle, 0, 0]}
    stage = stage_of(mesh, scan=scan, folder=tmp_path, sensors=(17, 13), bins=(0, 0.01, 600))
    assert stage.engine.tessellator.patches(0.4).is_cluster.all()
    truth, one, four = (
        values.sum(axis=-1) for values in (gathered(stage, 0.05), gathered(stage, 0.4), gathered(stage, 0.4, 1, 4))
    )
    assert relative_l2(four - truth, truth) < min(0.02, 0.75 * relative_l2(one - truth, truth))


@pytest.mark.parametrize("scan", SCANS)
def test_how_a_capture_is_cut_changes_no_bit(scan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Into batches whose cells have nodes in one another, and into passes."""
    from nlosrender.capture.plan import Batch
    from nlosrender.capture.tile import Tile
    from nlosrender.engine.virtual_lights.gather import sensor_lattice
    from nlosrender.engine.virtual_lights.refinement import Lattice

    stage = stage_of(FRONT, BEHIND, scan=scan)
    whole, parts = gathered(stage, 1.0, 4), []
    for tile in (Tile(0, 29, 0, 14), Tile(0, 29, 14, 33)):
        batch = Batch(tile, tile if scan == "confocal" else stage.batch.lasers)
        parts.append(stage.engine.third.gather(batch, 1.0, lattice=Lattice(4, 1)).values)
    shape = (*whole.shape[:3], 29, -1, whole.shape[-1])
    joined = np.concatenate([part.reshape(shape) for part in parts], axis=4)
    assert np.array_equal(joined.reshape(whole.shape), whole)
    monkeypatch.setattr(sensor_lattice, "MAX_ENTRIES", 2**12)
    assert np.array_equal(gathered(stage, 1.0, 4), whole)


@pytest.mark.parametrize(("slits", "target"), [(0, 0.01), (4, 0.03)], ids=["plate", "slits"])
def test_the_stated_error_holds_that_of_interpolation(slits: int, target: float) -> None:
    """The true one is at most twice as large.

    Truth has patches of half the size and rays of each point's own: less than a third of the error.
    """
    from nlosrender.engine.interface import Budget

    bars = [FRONT | {"center": [-0.3 + 0.2 * k, 0, 0.1], "width": 0.1} for k in range(slits)]
    screen = bars or [FRONT | {"center": [0.3, 0, 0.3]}]
    stage = stage_of(*screen, BEHIND, scan="confocal", sensors=(64, 32)).tuned(min_lattice_pairs=0, min_lattice=4)
    budget = stage.engine.calibrate(Budget(target_error=target))
    assert budget.visibility_step is not None
    assert budget.visibility_step > 1
    rendered = stage.engine.render(stage.batch, budget)
    finer = replace(budget, patch_scale=budget.patch_scale / 2, visibility_step=1, rays_per_node=4)
    truth = stage.engine.render(stage.batch, finer).mean
    stated = math.sqrt(rendered.variance.sum() / np.square(truth).sum())
    assert stated <= target
    assert relative_l2(rendered.mean - truth, truth) < 2 * stated


def random_items(seed: int) -> list[dict[str, Any]]:
    """Return two to four plates, spheres, letters or boxes that hide one another."""
    draw, items = np.random.default_rng(seed), []
    for _ in range(draw.integers(2, 5)):
        center = [float(draw.uniform(*ends)) for ends in ((-0.6, 0.6), (-0.5, 0.5), (0.25, 1.3))]
        sizes, tilt = [float(draw.uniform(0.1, 0.4)) for _ in range(3)], [float(draw.uniform(-1, 1)) for _ in range(2)]
        kinds: dict[str, dict[str, Any]] = {
            "rectangle": {"width": 2 * sizes[0], "height": 2 * sizes[1], "normal": [*tilt, -1]},
            "sphere": {"radius": sizes[0] / 2},
            "letters": {"text": "AZ", "height": sizes[0] + 0.2, "normal": [tilt[0] / 2, 0, -1]},
            "box": {"size": sizes},
        }
        kind = str(draw.choice(list(kinds)))
        items.append({"type": kind, "center": center, "bsdf": DIFFUSE} | kinds[kind])
    return items


@pytest.mark.slow
@pytest.mark.parametrize("target", [0.03, 0.015])
def test_random_scenes_have_the_errors_they_state(target: float) -> None:
    """Whatever lattice is chosen: the true error is at most twice the stated one in 95 % of 24 scenes, never thrice."""
    from nlosrender.engine.interface import Budget

    ratios, steps = [], set()
    for seed in range(24):
        stage = stage_of(*random_items(seed), scan=SCANS[seed % 2], sensors=(48, 36), bins=(0, 0.02, 300))
        stage.tuned(min_lattice=4, min_lattice_pairs=0)
        budget = stage.engine.calibrate(Budget(target_error=target))
        rendered = stage.engine.render(stage.batch, budget)
        finer = replace(budget, patch_scale=budget.patch_scale / 2.5, visibility_step=1, rays_per_node=4)
        truth = stage.engine.render(stage.batch, finer).mean
        stated = math.sqrt(rendered.variance.sum() / np.square(truth).sum())
        ratios.append(relative_l2(rendered.mean - truth, truth) / stated)
        steps.add(budget.visibility_step)
    assert {2, 4, 8} <= steps
    assert np.quantile(ratios, 0.95) < 2
    assert max(ratios) < 3
