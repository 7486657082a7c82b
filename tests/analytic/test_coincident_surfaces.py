"""Surfaces in one place, or closer than float32 tells apart: what lies behind is dark, and a union counts once.

Right values are sums of float64 quadrature over the plates that are seen; wide gaps are left to ``test_occlusion``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.quadrature import Setup, rectangle_cells, third_bounce
from support.rendering import configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

SENSORS = (3, 2)
ENGINES = {
    "virtual_lights": {"engine": "virtual_lights", "spp": None, "target_error": 0.005},
    "hidden geometry sampling": {"engine": "path", "spp": 2**15},
    "BSDF sampling": {"engine": "path", "spp": 2**16, "hidden_geometry_sampling": False},
}


def plate(width: float, height: float, center: tuple[float, float, float], albedo: float, size: float = 1.0) -> dict:
    """Return a plate that faces the wall, every length times ``size``."""
    bsdf = {"type": "diffuse", "reflectance": albedo}
    at = [size * x for x in center]
    return {"type": "rectangle", "width": size * width, "height": size * height, "center": at, "bsdf": bsdf}


def light_of(items: list[dict[str, Any]], size: float = 1.0) -> float:
    """Return the sum of H by quadrature over plates that are seen whole; what counts twice has a negative albedo."""
    total = 0.0
    ny, nx = SENSORS[1], SENSORS[0]
    for item in items:
        cells = rectangle_cells(item["width"], item["height"], item["center"], [0, 0, -1], n=60)
        setup = Setup(cells, np.array([0.0, 100.0 * size]), item["bsdf"]["reflectance"])
        for i in range(nx):
            for j in range(ny):
                sensor = np.array([(i + 0.5) / nx * 2 - 1, (j + 0.5) / ny * 1.6 - 0.8, 0]) * size
                total += third_bounce(setup, np.array([0.3, -0.2, 0]) * size, sensor).sum()
    return total


def rendered(items: list[dict[str, Any]], engine: str, size: float = 1.0, folder: Path | None = None) -> float:
    """Return the sum of H over all bins before a wall of 2 x 1.6 m times ``size``."""
    config = flat_wall(*items, sensors=SENSORS, bins=(0, 0.1 * size, 90), **ENGINES[engine])
    config["scene"]["relay_wall"] |= {"width": 2 * size, "height": 1.6 * size}
    config["capture"]["laser_point"] = [0.3 * size, -0.2 * size]
    return float(render(config, folder=folder).mean.sum())


# 1 % is 5 standard deviations of the noisiest: BSDF sampling of 4e5 paths, a third of which find the plate.
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("gap", "size"),
    [(0.0, 1.0), (1e-5, 1.0), (3e-4, 10.0), (1e-8, 0.01)]
    + [pytest.param(*more, marks=pytest.mark.slow) for more in ((1e-6, 1.0), (1e-4, 1.0), (1e-5, 10.0))],
)
def test_a_poster_hides_the_board_behind_it(gap: float, size: float, engine: str) -> None:
    """However small the gap [m], also none, before walls of 2 cm to 20 m."""
    board = plate(0.6, 0.6, (0.1, 0, 1), 0.8, size)
    poster = plate(0.4, 0.4, (0.15, 0.02, 1 - gap / size), 0.2, size)
    hidden_part = poster | {"bsdf": {"reflectance": -0.8}}
    expected = light_of([board, poster, hidden_part], size)
    assert rendered([board, poster], engine, size) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_union_of_plates_in_one_plane_counts_once(engine: str) -> None:
    """Two plates, a third in the same place as the second, and cuts that none of their triangles share."""
    first, second = plate(0.6, 0.6, (0, 0, 1), 0.8), plate(0.6, 0.6, (0.3, 0.1, 1), 0.8)
    common = plate(0.3, 0.5, (0.15, 0.05, 1), -0.8)
    assert rendered([first, second, dict(second)], engine) == pytest.approx(light_of([first, second, common]), rel=0.01)


@pytest.mark.parametrize("engine", ENGINES)
def test_of_many_layers_the_last_is_seen(engine: str) -> None:
    """Half a dozen, the last one grey and the others white."""
    plates = [plate(0.6, 0.6, (0, 0, 1), albedo) for albedo in (*[0.9] * 5, 0.3)]
    assert rendered(plates, engine) == pytest.approx(light_of(plates[-1:]), rel=0.01)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_poster_on_a_mesh_of_mitsuba(engine: str) -> None:
    """A plugin's own triangles are looked at as those of other items: a cube whose front a black plate covers."""
    to_world = [[0.3, 0, 0, 0], [0, 0.3, 0, 0], [0, 0, 0.3, 1.3], [0, 0, 0, 1]]
    cube = {"type": "mitsuba", "shape": {"type": "cube", "to_world": to_world}}
    covered = rendered([cube, plate(0.6, 0.6, (0, 0, 1), 0.0)], engine)
    assert covered < 1e-3 * rendered([cube], engine)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("two_sided", [True, False])
def test_both_faces_of_a_sheet_without_thickness_count_once(two_sided: bool, engine: str, tmp_path: Path) -> None:
    """One quadrilateral listed both ways round: cut along other diagonals, so no two triangles are the same."""
    lines = ["v -0.5 -0.2 1", "v -0.5 0.2 1", "v 0 0.2 1", "v 0 -0.2 1", "f 1 2 3 4", "f 4 3 2 1"]
    (tmp_path / "sheet.obj").write_text("\n".join(lines) + "\n")
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": 0.6}
    if two_sided:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    sheet = {"type": "mesh", "filename": "sheet.obj", "face_normals": True, "bsdf": bsdf}
    expected = light_of([plate(0.5, 0.4, (-0.25, 0, 1), 0.6)])
    assert rendered([sheet], engine, folder=tmp_path) == pytest.approx(expected, rel=0.01)


BALL = {"type": "sphere", "center": [0, 0, 1], "radius": 0.3}
TUBE = {"type": "cylinder", "center": [0, 0, 1], "axis": [0.3, 1, 0], "radius": 0.05, "height": 0.6}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("gap", [1e-4, 0.0, *(pytest.param(gap, marks=pytest.mark.slow) for gap in (1.5e-5, 1e-6))])
@pytest.mark.parametrize("item", [BALL, TUBE], ids=["ball", "tube"])
def test_what_lies_inside_a_black_shell_is_dark(item: dict[str, Any], gap: float, engine: str) -> None:
    """However thin the space between; the later one is the shell where both have one radius."""
    white, black = ({"bsdf": {"type": "diffuse", "reflectance": albedo}} for albedo in (1.0, 0.0))
    # the open ends of a tube show its inside, which is black, too
    assert rendered([item | white, item | black | {"radius": item["radius"] + gap}], engine) == 0


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("gap", [1e-4, 1e-6])
def test_a_black_lining_hides_the_ball_around_it(gap: float, engine: str) -> None:
    """Seen from within, the smaller of two balls is in front."""
    white, black = ({"bsdf": {"type": "diffuse", "reflectance": albedo}, "inside": True} for albedo in (1.0, 0.0))
    around = {"type": "sphere", "center": [0, 0, 0], "radius": 2.0}
    assert rendered([around | white, around | black | {"radius": 2.0 - gap}], engine) == 0


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "item", [BALL, pytest.param(TUBE | {"radius": 0.3}, marks=pytest.mark.slow)], ids=["ball", "tube"]
)
def test_a_surface_seen_from_outside_and_within_is_two(item: dict[str, Any], engine: str) -> None:
    """One radius, one item for each side, in either order: as if the inner one were 1 cm smaller."""
    alone = rendered([item, item | {"inside": True, "radius": item["radius"] - 0.01}], engine)
    assert rendered([item, item | {"inside": True}], engine) == pytest.approx(alone, rel=0.02)
    assert rendered([item | {"inside": True}, item], engine) == pytest.approx(alone, rel=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_what_two_layers_hide_stays_hidden_beside_the_shorter(engine: str) -> None:
    """A can, black paint on it, and a short label on the paint: the can is dark."""
    can = TUBE | {"axis": [0, 1, 0], "radius": 0.3, "bsdf": {"type": "diffuse", "reflectance": 0.8}}
    paint = can | {"bsdf": {"type": "diffuse", "reflectance": 0.0}}
    label = can | {"height": 0.1, "bsdf": {"type": "diffuse", "reflectance": 0.1}}
    apart = [item | {"radius": radius} for item, radius in ((can, 0.29), (paint, 0.3), (label, 0.301))]
    assert rendered([can, paint, label], engine) == pytest.approx(rendered(apart, engine), rel=0.03)


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_a_disk_in_the_plane_of_a_plate_is_said(gap: float) -> None:
    """Disks are no triangles, and are not moved."""
    start_backend("llvm", colored=False, polarized=False)
    shape = {"type": "disk", "to_world": [[0.2, 0, 0, 0], [0, 0.2, 0, 0], [0, 0, -1, 1 - gap], [0, 0, 0, 1]]}
    items = [plate(0.6, 0.6, (0, 0, 1), 0.8), {"type": "mitsuba", "shape": shape}]
    warnings = stages.load_scene(configured(flat_wall(*items))).warnings
    assert any("a disk in one place" in text for text in warnings) == (gap == 0)


@pytest.mark.parametrize(
    ("items", "is_said"),
    [
        ((BALL, BALL | {"radius": 0.3000001}), True),
        ((TUBE, TUBE), True),
        ((BALL, BALL | {"radius": 0.3001}), False),
        ((BALL, BALL | {"center": [0, 0.001, 1]}), False),
        ((BALL, BALL | {"inside": True}), False),
        ((TUBE, TUBE | {"axis": [0.31, 1, 0]}), False),
        ((TUBE, TUBE | {"center": [0.3, 1, 1]}), False),
        ((BALL, TUBE), False),
    ],
)
def test_concentric_surfaces_are_said(items: tuple[dict[str, Any], ...], is_said: bool) -> None:
    """Not those farther apart, beside each other along an axis, or seen from opposite sides."""
    start_backend("llvm", colored=False, polarized=False)
    warnings = stages.load_scene(configured(flat_wall(*items))).warnings
    assert any("closer than rays tell apart" in text for text in warnings) == is_said


def sheet(n: int, random: np.random.Generator, wave: float) -> TriangleMesh:
    """Return a tilted sheet of 2 n^2 triangles, wavy or flat, diagonals at random."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, n + 1), np.linspace(-0.5, 0.5, n + 1))
    vertices = np.stack([x, y, 1 + 0.3 * x + wave * np.sin(9 * x) * np.cos(8 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.stack([corner, corner + n + 1, corner + n + 2, corner + 1], axis=1)
    quads = np.where(random.random((len(quads), 1)) < 0.5, quads, np.roll(quads, 1, axis=1))
    return TriangleMesh(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def test_nothing_is_moved_where_nothing_coincides(tmp_path: Path) -> None:
    """Neighbours, a plate through them, a sheet 1e-4 m behind, and one with other waves that crosses all."""
    start_backend("llvm", colored=False, polarized=False)
    import mitsuba as mi

    from nlosrender.scene.loading.coincident import overlaps

    random = np.random.default_rng(1)
    wavy, other = sheet(40, random, 0.05), sheet(40, random, -0.07)
    other = replace(other, vertices=other.vertices + np.array([0, 0, 0.0137]))
    behind = replace(wavy, vertices=wavy.vertices + np.array([0, 0, 1e-4]))
    crossing = TriangleMesh(
        np.array([[-0.5, 0, 0.5], [0.5, 0, 0.5], [0.5, 0.01, 1.5], [-0.5, 0.01, 1.5]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    meshes = dict(enumerate([wavy, behind, crossing, other]))
    shapes = [device_mesh(mi, f"m{number}", mesh) for number, mesh in meshes.items()]
    scene = mi.load_dict({"type": "scene", **{f"m{i}": shape for i, shape in enumerate(shapes)}})
    assert overlaps(scene, shapes, meshes) == []


def test_a_sheet_cut_twice_becomes_two_layers() -> None:
    """All of the later one is moved, by one gap, in the order of the triangles or out of it."""
    start_backend("llvm", colored=False, polarized=False)
    import mitsuba as mi

    from nlosrender.scene.loading.coincident import GAP, MAX_LAYERS, STEP, moved_apart, overlaps

    random = np.random.default_rng(2)
    meshes = {number: sheet(30, random, 0.0) for number in range(2)}
    for seed in range(MAX_LAYERS):
        shapes = [device_mesh(mi, f"m{number}", mesh) for number, mesh in meshes.items()]
        scene = mi.load_dict({"type": "scene", **{f"m{i}": shape for i, shape in enumerate(shapes)}})
        found = overlaps(scene, shapes, meshes, seed)
        if not found:
            break
        assert [(overlap.mesh, overlap.other) for overlap in found] == [(1, 0)]
        assert seed > 0 or found[0].share > 0.99
        meshes[1] = moved_apart(meshes[1], found[0].faces, both_sides=False)
    assert not found
    x, _, z = meshes[1].vertices.T
    off = np.abs((z - 1 - 0.3 * x) / np.hypot(1, 0.3))
    assert len(meshes[1].faces) == len(meshes[0].faces)
    assert np.isclose(np.median(off), STEP * GAP * (1 + np.median(z)), rtol=0.2)  # of float32 coordinates: 1e-7


@pytest.mark.parametrize("level", [0.5, 0.7311])
def test_small_triangles_on_large_ones_are_found_at_once(level: float) -> None:
    """The undersides of 4 x 4 legs on a floor of two triangles: few of its points lie in any, rays meet either."""
    start_backend("llvm", colored=False, polarized=False)
    import mitsuba as mi

    from nlosrender.scene.loading.coincident import moved_apart, overlaps

    random, legs = np.random.default_rng(3), []
    for x, y in np.ndindex(4, 4):
        one = sheet(30, random, 0.0)
        legs.append(replace(one, vertices=one.vertices * [0.03, 0.03, 0] + [0.2 * x - 0.31, 0.2 * y - 0.3, level]))
    corners = np.array([[-1, -1, level], [1, -1, level], [1, 1, level], [-1, 1, level]])
    meshes = {0: TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), 1: TriangleMesh.merged(legs)}
    counts = []
    for seed in range(2):
        shapes = [device_mesh(mi, f"m{number}", mesh) for number, mesh in meshes.items()]
        scene = mi.load_dict({"type": "scene", **{f"m{i}": shape for i, shape in enumerate(shapes)}})
        found = overlaps(scene, shapes, meshes, seed)
        counts.append(int(found[0].faces.sum()) if found else 0)
        for overlap in found:
            meshes[1] = moved_apart(meshes[1], overlap.faces, both_sides=False)
    assert counts == [16 * 2 * 30**2, 0]


def device_mesh(mi: Any, name: str, mesh: TriangleMesh) -> Any:
    """Return a mesh on the device."""
    shape = mi.Mesh(name, len(mesh.vertices), len(mesh.faces))
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    parameters.update()
    return shape
