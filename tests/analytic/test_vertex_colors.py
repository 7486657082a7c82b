"""Colours of a mesh's vertices as its reflectance: the light of the same reflectances by quadrature, or a refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.quadrature import Array, Setup, grid_points, rectangle_cells, third_bounces
from support.rendering import configured, flat_wall, render
from support.views import view_config

from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import ConfigError
from nlosrender.rendering import stages
from nlosrender.scene.meshes.mesh_file import read_mesh

CENTER = np.array([0.2, 0.1, 0.8])
WIDTH, HEIGHT = 0.6, 0.4
LASER, SENSORS = np.array([[[0.3, -0.2, 0.0]]]), grid_points(5, 3, 2.0, 1.6)
EDGES = np.linspace(0.0, 6.0, 61)
WHOLE = {"uchar": 255, "ushort": 65535}


def reflectance(points: Array) -> Array:
    """Red, green, blue (n, 3) at points: linear in place, so that triangles interpolate them exactly."""
    x, y = (points - CENTER)[:, :2].T / [[WIDTH], [HEIGHT]]
    return np.stack([0.5 + 0.9 * x, 0.4 - 0.6 * y, 0.5 + 0.4 * x + 0.5 * y], axis=-1)


def write_plate(path: Path, colors: Array | None = None, kind: str = "float", names: str = "red green blue") -> str:
    """Write a rectangle that faces the wall, with an unused vertex and a face without area before it."""
    across = np.array([[-9, 0, 0], [-0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0]])
    points = CENTER + across * [WIDTH, HEIGHT, 0]
    rows = reflectance(points) if colors is None else np.broadcast_to(colors, (5, 3))
    written = np.round(np.clip(rows, 0, 1) * WHOLE[kind]).astype(int) if kind in WHOLE else rows
    lines = ["ply", "format ascii 1.0", "element vertex 5", *(f"property double {axis}" for axis in "xyz")]
    lines += [f"property {kind} {name}" for name in names.split()]
    lines += ["element face 3", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(repr, [*point, *row])) for point, row in zip(points.tolist(), written.tolist(), strict=True)]
    path.write_text("\n".join([*lines, "3 1 1 2", "3 1 2 3", "3 1 3 4"]) + "\n", encoding="utf-8")
    return path.name


def colored(name: str, attribute: str = "vertex_color", **texture: Any) -> dict[str, Any]:
    """A mesh item whose reflectance is an attribute."""
    read = {"type": "mesh_attribute", "name": attribute, **texture}
    return {"type": "mesh", "filename": name, "bsdf": {"type": "diffuse", "reflectance": read}}


@pytest.mark.parametrize(
    ("engine", "kind", "names"),
    [("path", "float", "r g b"), ("path", "uchar", "red green blue"), ("virtual_lights", "ushort", "r g b")]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in (
            ("path", "ushort", "r g b"),
            ("virtual_lights", "float", "r g b"),
            ("virtual_lights", "uchar", "red green blue"),
        )
    ],
)
def test_light_from_a_mesh_with_colours(engine: str, kind: str, names: str, tmp_path: Path) -> None:
    """Each channel is the quadrature over the colours of the vertices; whole numbers stand for 0 to 1, linear."""
    item = colored(write_plate(tmp_path / "plate.ply", kind=kind, names=names))
    budget = {"spp": 4096} if engine == "path" else {"spp": None, "target_error": 0.02}
    result = render(flat_wall(item, bins=(0.0, 0.1, 60), engine=engine, color="rgb", **budget), folder=tmp_path)
    cells = rectangle_cells(WIDTH, HEIGHT, CENTER, [0, 0, -1], n=100)
    for channel, rho in enumerate(reflectance(cells.points).T):
        reference = third_bounces(Setup(cells, EDGES, brdf=lambda *_, rho=rho: rho / np.pi), LASER, SENSORS)
        # 2 % asked; colours that are the mean everywhere are 12 % off
        assert np.linalg.norm(result.mean[channel].sum(axis=0) - reference) < 0.03 * np.linalg.norm(reference)


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_colours_stay_at_their_vertices(normals: Any, tmp_path: Path) -> None:
    """Whatever becomes of a mesh: vertices that are left out or doubled, faces that are turned round."""
    write_plate(tmp_path / "plate.ply")
    mesh = read_mesh(str(tmp_path / "plate.ply"), "ply", normals)
    assert len(mesh.vertices) == 4
    for each in (mesh, mesh.turned_round(), mesh.subset(np.array([False, True]))):
        np.testing.assert_allclose(each.colors, reflectance(each.vertices), atol=1e-12)
    moved = mesh.transformed(np.diag([2.0, -1.0, 3.0, 1.0]))
    np.testing.assert_array_equal(moved.colors, mesh.colors)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        (colored("plate.ply", "vertex_colour"), r"has no attribute vertex_colour \(it has: vertex_color\)"),
        (colored("plate.ply", scale=3.0), r"values of vertex_color, such as .*, are not from 0 to 1"),
        (colored("bright.ply"), r"12 of 12 values of vertex_color, such as 2, are not from 0 to 1"),
        (colored("odd.ply"), r"values of vertex_color, such as -1, are not from 0 to 1"),
        (
            {**colored("", "vertex_color"), "type": "rectangle", "width": 1, "height": 1, "center": [0, 0, 1]},
            r"has no attribute vertex_color \(it has: none\)",
        ),
    ],
)
def test_attributes_that_are_not_there_or_cannot_be_are_refused(
    item: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Mitsuba takes them for black, or for reflectances above 1."""
    write_plate(tmp_path / "plate.ply")
    write_plate(tmp_path / "bright.ply", np.full(3, 2.0))
    write_plate(tmp_path / "odd.ply", np.array([np.nan, 0.5, 0.5]))
    if item["type"] == "rectangle":
        del item["filename"]
    config = configured(flat_wall(item), folder=tmp_path)
    start_backend("llvm", colored=True, polarized=False)
    with pytest.raises(ConfigError, match=message) as caught:
        stages.load_scene(config)
    assert caught.value.issues[0].key == "scene.hidden_geometry.0.bsdf"


def test_a_relay_wall_has_no_attributes() -> None:
    """Its points are known by their texture coordinates alone."""
    config = configured(flat_wall(wall={"bsdf": colored("")["bsdf"]}))
    start_backend("llvm", colored=True, polarized=False)
    with pytest.raises(ConfigError, match="a relay wall's points have no attribute vertex_color; use a bitmap"):
        stages.load_scene(config)


@pytest.mark.parametrize("referred", ["", "bsdf", "texture"])
@pytest.mark.parametrize(
    ("kind", "attribute", "scale", "message"),
    [
        ("float", "vertex_color", 1.0, ""),
        ("uchar", "vertex_color", 1 / 255, ""),
        ("uchar", "vertex_color", 1.0, r"line 2: <shape type='ply'>: .*not from 0 to 1, .*0\.00392157 for 8 bits"),
        ("float", "vertex_colour", 1.0, r"has no attribute vertex_colour \(it has: vertex_color\)"),
    ],
)
def test_attributes_in_a_mitsuba_scene(
    kind: str, attribute: str, scale: float, message: str, referred: str, tmp_path: Path
) -> None:
    """Mitsuba's own reader takes whole numbers as they stand: they need a scale; nothing is black without a word."""
    write_plate(tmp_path / "plate.ply", np.full(3, 0.5), kind=kind, names="r g b")
    texture = f"""<texture type='mesh_attribute' {"id='t'" if referred == "texture" else "name='reflectance'"}>
        <string name='name' value='{attribute}'/><float name='scale' value='{scale}'/></texture>"""
    held = "<ref name='reflectance' id='t'/>" if referred == "texture" else texture
    bsdf = f"<bsdf type='diffuse' id='b'>{held}</bsdf>"
    shape = "<shape type='ply'><string name='filename' value='plate.ply'/>{}</shape>"
    content = shape.format("<ref id='b'/>" if referred == "bsdf" else bsdf)
    content += {"": "", "bsdf": bsdf, "texture": texture}[referred]
    (tmp_path / "scene.xml").write_text(f"<scene version='3.0.0'>\n{content}</scene>", encoding="utf-8")
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": 1.0}
    config = configured(view_config(emitters=[lamp], scene={"mitsuba": "scene.xml"}), folder=tmp_path)
    start_backend("llvm", colored=True, polarized=False)
    if not message:
        assert stages.load_view(config).n_triangles == 3
        return
    with pytest.raises(ConfigError, match=message):
        stages.load_view(config)
