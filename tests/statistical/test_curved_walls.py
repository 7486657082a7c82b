"""Both engines agree, bounce by bounce, where the wall is a sphere, a cylinder or a mesh: it reflects to itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.agreement import relative_l2
from support.engine_sums import assert_alike, energies, finer, group_sums
from support.rendering import flat_wall, render
from support.varied_scenes import Stage, ball, diffuse, plate
from support.wall_meshes import flat, globe, sheet, wavy, write_uv_ply

from nlosrender.engine.backend.start import start_backend

GREY = {"bsdf": diffuse(0.6)}
WITHIN, BEFORE = ball((0.1, 0.05, 0.1), 0.2), plate((0.1, -0.05, 1.6), (0.1, 0.2, -1.0), (0.7, 0.6))
NEAR = plate((0.1, -0.05, 0.7), (0.1, 0.2, -1.0), (0.6, 0.5))
SPHERE = {"type": "sphere", "radius": 0.8, **GREY}
TUBE = {"type": "cylinder", "radius": 0.8, "height": 1.5, **GREY}
# wall, hidden item, extent of the sensor grid: on the mesh all points stay 2 cm off the edges
# between triangles, near which what a point sees of itself is rare and bright: no mean of few paths is normal there
WALLS: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[float, float]]] = {
    "in a sphere": ({**SPHERE, "inside": True}, WITHIN, (4.0, 1.2)),
    "on a sphere": ({**SPHERE, "inside": False}, BEFORE, (2.0, 1.0)),
    "in a tube": ({**TUBE, "inside": True}, WITHIN, (4.0, 1.2)),
    "on a tube": ({**TUBE, "inside": False}, BEFORE, (2.0, 1.0)),
    "waves": ({"type": "mesh", "filename": "waves.ply", **GREY}, NEAR, (1.7, 0.95)),
}


def scene(name: str, scan: str, engine: str = "virtual_lights", **render: Any) -> dict[str, Any]:
    """Return the configuration of one of the walls."""
    wall, hidden, (width, height) = WALLS[name]
    grid = {"nx": 4, "ny": 2, "width": width, "height": height}
    capture: dict[str, Any] = {"sensor_grid": grid}
    if scan == "single":
        capture["laser_point"] = [0.22, -0.05]
    if scan == "exhaustive":
        capture["laser_grid"] = {"nx": 2, "ny": 3, "width": 1.1, "height": 0.9}
    settings = {"spp": None, "target_error": 0.02, "max_bounces": 5, "bins": (0.0, 0.06, 100), **render}
    config = flat_wall(hidden, scan=scan, capture=capture, engine=engine, **settings)
    config["scene"]["relay_wall"] = dict(wall)
    return config


def compare(
    name: str, scan: str, folder: Path, *, seeds: int, rounds: int, spp: int, max_bounces: int = 5, target: float = 0.02
) -> None:
    """Render a wall with both engines, ``seeds`` times each, and compare sums."""
    start_backend("llvm")
    from nlosrender.engine.interface import Budget

    write_uv_ply(folder / "waves.ply", *sheet(wavy(2.0, 1.6, 0.1), 12, 10))
    stage = Stage.of(scene(name, scan, max_bounces=max_bounces), folder)
    assert stage.engine.name == "virtual_lights"
    assert stage.engine.further is not None or max_bounces == 3
    budget = replace(finer(stage.engine, target), rounds=rounds)
    lights = stage.repeated(budget, range(1, seeds + 1))
    reference = Stage.of(scene(name, scan, "path", spp=spp, target_error=None, max_bounces=max_bounces), folder)
    paths = reference.repeated(Budget(spp=spp), range(101, 101 + seeds))
    second = stage.bounces.slot(2)
    np.testing.assert_array_equal(lights.means[:, :, second], paths.means[:, :, second])
    assert lights.means[:, :, second].any() == ((name.startswith("in") or name == "waves") and scan != "confocal")
    for bounce in range(3, max_bounces + 1):
        slot = stage.bounces.slot(bounce)
        if lights.means[:, :, slot].any() or paths.means[:, :, slot].any():
            assert_alike(group_sums(lights, paths, slot, bounce == 3), f"{name}, bounce {bounce}")
    lights, paths = (replace(side, means=np.delete(side.means, second, axis=2)) for side in (lights, paths))
    assert_alike(energies(lights, paths), f"{name}, energies")


def test_engines_agree_in_a_tube_in_a_few_seconds(tmp_path: Path) -> None:
    """Bin groups, rows and energies of every bounce, with little work."""
    compare("in a tube", "single", tmp_path, seeds=6, rounds=2, spp=4096, max_bounces=4, target=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("name", WALLS)
def test_engines_agree_on_curved_walls(name: str, scan: str, tmp_path: Path) -> None:
    """Bin groups, rows and energies of every bounce; of 8 rounds some sums on a tube are far from normal."""
    compare(name, scan, tmp_path, seeds=16, rounds=32, spp=100_000, target=0.01)


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_a_flat_mesh_wall_has_the_bits_of_the_rectangle(engine: str, tmp_path: Path) -> None:
    """Both engines know that a flat mesh is a plane, and give the same numbers on it."""
    write_uv_ply(tmp_path / "flat.ply", *sheet(flat(2.0, 1.6), 4, 3))
    goal = {"spp": 512} if engine == "path" else {"spp": None, "target_error": 0.05}
    config = flat_wall(NEAR, engine=engine, max_bounces=4, **goal)
    rectangle = render(config)
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": "flat.ply"}
    mesh = render(config, folder=tmp_path)
    assert rectangle.mean.any()
    np.testing.assert_array_equal(mesh.mean, rectangle.mean)


def test_a_finer_and_finer_globe_becomes_the_sphere(tmp_path: Path) -> None:
    """The third bounce of tessellated sphere walls approaches that of the sphere, second order in the triangles."""
    radius = 0.8
    grid = {"sensor_grid": {"nx": 3, "ny": 2, "width": 2.0, "height": 0.9}, "laser_point": [0.17, -0.11]}
    config = flat_wall(capture=grid, engine="virtual_lights", spp=None, target_error=0.05, bins=(0.0, 0.12, 30))
    config["scene"]["relay_wall"] = {**SPHERE, "inside": True}
    sphere = render(config).bounce(3)
    errors = []
    for columns in (12, 36):
        write_uv_ply(tmp_path / "globe.ply", *sheet(globe(radius), columns + 1, columns // 2 + 1))
        mesh = {"type": "mesh", "filename": "globe.ply", "flip_normals": True, "width": 2 * np.pi * radius, **GREY}
        config["scene"]["relay_wall"] = {**mesh, "height": 2 * radius}
        errors.append(relative_l2(render(config, folder=tmp_path).bounce(3) - sphere, sphere))
    # a ninth of the triangles' error is left; both renders are off by 5 % at most
    assert errors[1] < 0.1
    assert errors[1] < errors[0] / 3


def test_points_on_the_edges_of_a_mesh_wall_are_said(tmp_path: Path) -> None:
    """3 columns of sensor points over 12 of quads: the middle one lies on an edge; the warning counts its points."""
    start_backend("llvm")
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    write_uv_ply(tmp_path / "waves.ply", *sheet(wavy(2.0, 1.6, 0.1), 12, 10))
    config = scene("waves", "single")
    assert not [text for text in scene_warnings(Stage.of(config, tmp_path).engine) if "edges" in text]
    config["capture"]["sensor_grid"]["nx"] = 3
    said = scene_warnings(Stage.of(config, tmp_path).engine)
    assert any("2 of 6 sensor points lie on edges of the relay wall's triangles" in text for text in said)


@pytest.mark.parametrize(
    ("name", "engine"), [("in a sphere", "virtual_lights"), ("on a tube", "virtual_lights"), ("waves", "path")]
)
def test_auto_takes_the_engine_that_is_quicker(name: str, engine: str, tmp_path: Path) -> None:
    """Round walls are cut into few elements; the edges of a mesh wall take very many, and a reason is given."""
    write_uv_ply(tmp_path / "waves.ply", *sheet(wavy(2.0, 1.6, 0.1), 12, 10))
    chosen = Stage.of(scene(name, "single", "auto"), tmp_path).engine
    assert chosen.name == engine
    assert ("curved wall" if engine == "virtual_lights" else "a mesh that sees itself") in chosen.reason


@pytest.mark.parametrize("engine", ["auto", "virtual_lights"])
def test_a_needle_is_not_cut_into_millions_of_patches(engine: str) -> None:
    """The elements of a tube of 1 micrometre are as long as it is wide: 76 million in 1.5 m, more than memory holds."""
    config = flat_wall(sensors=(3, 2), scan="confocal", max_bounces=4, engine=engine, spp=None)
    config["scene"]["relay_wall"] = {"type": "cylinder", "radius": 1e-6, "height": 1.5, "bsdf": diffuse(0.7)}
    chosen = Stage.of(config).engine
    assert chosen.name == "path"
    assert "so narrow" in chosen.reason
