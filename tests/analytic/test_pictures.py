"""Pictures on surfaces: the first row at the surface's up side, the first column at the left as seen from the front.

Expected reflectances are looked up in the array by hand, from points that are written down here for each shape.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from support.quadrature import Array, Frame, Setup, grid_points, rectangle_cells, third_bounces
from support.rendering import configured, flat_wall, render
from support.views import view_config

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

TEXELS = np.array([[0.1, 0.9, 0.3], [0.6, 0.2, 0.8]], dtype=np.float32)  # not symmetric in any way
ROWS, COLUMNS = TEXELS.shape
CENTER = np.array([0.2, -0.1, 1.1])
TURNED = {"normal": [0.3, -0.4, -1.0], "up": [0.5, 1.0, 0.2]}
WALL_POSE = {"center": [0.3, 0.2, -0.1], "normal": [0.1, 0.2, 1.0], "up": [0.3, 1.0, 0.1]}
X, Y, Z = np.eye(3)
LAMP = {"type": "point", "position": [0, 0, 4], "intensity": 1.0}

# Where a surface is, as a function of (s, t) in [0, 1]: s from the left to the right, t from the top down, both as seen
# from the front. It returns the point and the unit normal of the front.
Place = Callable[[float, float], tuple[Array, Array]]


@pytest.fixture
def picture(tmp_path: Path) -> dict[str, Any]:
    """A diffuse BSDF with a picture of ``TEXELS``."""
    start_backend("llvm")
    import mitsuba as mi

    filename = tmp_path / "texels.exr"
    mi.Bitmap(TEXELS[..., None]).write(str(filename))
    texture = {"type": "bitmap", "filename": str(filename), "filter_type": "nearest", "raw": True}
    return {"type": "diffuse", "reflectance": texture}


def flat(center: ArrayLike, normal: ArrayLike, up: ArrayLike, width: float, height: float) -> Place:
    """A rectangle: its right is up x normal."""
    frame = Frame.of(normal, up)
    return lambda s, t: (
        np.asarray(center) + (s - 0.5) * width * frame.x + (0.5 - t) * height * frame.y,
        frame.normal,
    )


def side(out: Array, up: Array, size: ArrayLike, *, center: Array = CENTER, within: bool = False) -> Place:
    """A side of a box without rotation, told by its outward normal."""
    normal = -out if within else out
    size = np.asarray(size)
    width = float(np.abs(np.cross(up, out)) @ size)
    return flat(center + out * size / 2, normal, up, width, float(np.abs(up) @ size))


def round_about(axis: ArrayLike, middle: ArrayLike, radius: float, height: float | None, *, inside: bool) -> Place:
    """A tube, or a sphere, whose picture has its middle on the side of ``middle``."""
    y = np.asarray(axis) / np.linalg.norm(axis)
    front = np.asarray(middle) - (np.asarray(middle) @ y) * y
    front = front / np.linalg.norm(front)
    right = np.cross(y, -front if inside else front)

    def place(s: float, t: float) -> tuple[Array, Array]:
        azimuth, polar = 2 * np.pi * (s - 0.5), np.pi * t
        across = front * np.cos(azimuth) + right * np.sin(azimuth)
        if height is None:
            outward = across * np.sin(polar) + y * np.cos(polar)
            point = radius * outward
        else:
            outward, point = across, radius * across + (0.5 - t) * height * y
        return CENTER + point, -outward if inside else outward

    return place


def seen(built: Any, shape: Any, place: Place, to_local: Callable[[Array], Array]) -> Array:
    """Reflectance of a shape at the middle of every texel, (rows, columns), met by rays from 1 mm before it."""
    import mitsuba as mi

    found = np.empty(TEXELS.shape)
    for row in range(ROWS):
        for column in range(COLUMNS):
            point, normal = place((column + 0.5) / COLUMNS, (row + 0.5) / ROWS)
            start, end = to_local(point + 1e-3 * normal), to_local(point - 1e-3 * normal)
            ray = mi.Ray3f(
                mi.Point3f(start / built.metres_per_engine_unit),
                mi.Vector3f((end - start) / np.linalg.norm(end - start)),
            )
            met = built.scene.ray_intersect(ray)
            assert np.all(np.array(met.shape == mi.ShapePtr(shape)))
            assert (normal @ normal) == pytest.approx(1)
            assert float(np.ravel(met.wi.z)[0]) > 0.9  # the front, near enough straight on
            found[row, column] = np.ravel(met.bsdf().eval_diffuse_reflectance(met))[0]
    return found


ITEMS = {
    "rectangle": ({"type": "rectangle", "width": 0.9, "height": 0.5}, flat(CENTER, -Z, Y, 0.9, 0.5)),
    "turned rectangle": (
        {"type": "rectangle", "width": 0.9, "height": 0.5, **TURNED},
        flat(CENTER, TURNED["normal"], TURNED["up"], 0.9, 0.5),
    ),
    "sphere": ({"type": "sphere", "radius": 0.3}, round_about(Y, -Z, 0.3, None, inside=False)),
    "sphere from within": (
        {"type": "sphere", "radius": 0.3, "inside": True},
        round_about(Y, -Z, 0.3, None, inside=True),
    ),
    "cylinder": ({"type": "cylinder", "radius": 0.2, "height": 0.5}, round_about(Y, -Z, 0.2, 0.5, inside=False)),
    "turned cylinder from within": (
        {"type": "cylinder", "radius": 0.2, "height": 0.5, "axis": [0.3, 1.0, 0.4], "inside": True},
        round_about([0.3, 1.0, 0.4], -Z, 0.2, 0.5, inside=True),
    ),
}
BOX = (0.3, 0.4, 0.5)
# the up side of each side: y, but of the horizontal ones z
for name, out, up in (
    ("front", -Z, Y),
    ("back", Z, Y),
    ("right", X, Y),
    ("left", -X, Y),
    ("top", Y, Z),
    ("bottom", -Y, Z),
):
    ITEMS[f"box, {name}"] = ({"type": "box", "size": list(BOX)}, side(out, up, BOX))


@pytest.mark.parametrize("name", ITEMS)
def test_a_picture_lies_the_right_way_up_on_a_hidden_item(name: str, picture: dict[str, Any]) -> None:
    """The texel of row i and column j lies (j + 1/2)/columns from the left, (i + 1/2)/rows from the top."""
    item, place = ITEMS[name]
    config = configured(flat_wall({**item, "center": CENTER.tolist(), "bsdf": picture}, wall=WALL_POSE))
    built = stages.load_scene(config)
    np.testing.assert_allclose(seen(built, built.hidden_shapes[0], place, built.wall.pose.to_local), TEXELS, rtol=1e-6)


@pytest.mark.parametrize(
    ("out", "up"), [(Z, Y), (X, Y), (-X, Y), (Y, Z), (-Y, Z)], ids=["back", "right", "left", "ceiling", "floor"]
)
def test_a_picture_lies_the_right_way_up_on_the_sides_of_a_room(out: Array, up: Array, picture: dict[str, Any]) -> None:
    """As seen from within; ceiling and floor have their first row at the far side."""
    size = np.array([3.0, 2.0, 4.0])
    config = configured(flat_wall({"type": "room", "size": size.tolist(), "bsdf": picture}, wall=WALL_POSE))
    built = stages.load_scene(config)
    place = side(out, up, size, center=np.array([0.0, 0.0, 2.0]), within=True)  # in the wall's frame
    np.testing.assert_allclose(seen(built, built.hidden_shapes[0], place, np.asarray), TEXELS, rtol=1e-6)


def test_a_picture_spans_letters_the_right_way_up(picture: dict[str, Any]) -> None:
    """A picture covers the text's extent: each triangle of the letters shows the texel at its centre."""
    import mitsuba as mi

    item = {"type": "letters", "text": "HZ", "height": 0.5, "center": CENTER.tolist(), "bsdf": picture, **TURNED}
    built = stages.load_scene(configured(flat_wall(item, wall=WALL_POSE)))
    frame = Frame.of(TURNED["normal"], TURNED["up"])
    mesh = built.surfaces[0].shape
    own = (built.wall.pose.to_scene(mesh.vertices) - CENTER) @ np.column_stack([frame.x, frame.y])
    share = (own - own.min(axis=0)) / np.ptp(own, axis=0)
    centres = share[mesh.faces].mean(axis=1)
    inside = np.abs(centres * [COLUMNS, ROWS] % 1 - 0.5).max(axis=1) < 0.49  # not on an edge between texels
    normal = built.wall.pose.direction_to_local(frame.normal)
    start = (mesh.vertices[mesh.faces].mean(axis=1) + 0.01 * normal) / built.metres_per_engine_unit
    met = built.scene.ray_intersect(mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(-normal)))
    found = np.ravel(met.bsdf().eval_diffuse_reflectance(met))
    column, row = (centres[:, 0] * COLUMNS).astype(int), ((1 - centres[:, 1]) * ROWS).astype(int)
    assert set(zip(row[inside], column[inside], strict=True)) >= {(0, 0), (1, 0), (0, 2), (1, 2)}
    np.testing.assert_allclose(found[inside], TEXELS[row, column][inside], rtol=1e-6)


def test_an_obj_quad_shows_what_a_rectangle_shows(picture: dict[str, Any], tmp_path: Path) -> None:
    """Texture coordinates (0, 0) at the lower left corner, as everywhere in .obj files."""
    corners = [
        flat(CENTER, TURNED["normal"], TURNED["up"], 0.9, 0.5)(s, t)[0] for s, t in ((0, 1), (1, 1), (1, 0), (0, 0))
    ]
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.array(corners).tolist()]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "f 1/1 2/2 3/3 4/4"]
    (tmp_path / "quad.obj").write_text("\n".join(lines), encoding="utf-8")
    item = {"type": "mesh", "filename": "quad.obj", "bsdf": picture}
    built = stages.load_scene(configured(flat_wall(item), folder=tmp_path))
    place = flat(CENTER, TURNED["normal"], TURNED["up"], 0.9, 0.5)
    np.testing.assert_allclose(seen(built, built.hidden_shapes[0], place, np.asarray), TEXELS, rtol=1e-6)


@pytest.mark.parametrize("kind", ["item", "scene file"])
def test_mitsubas_own_rectangle_keeps_its_convention(kind: str, picture: dict[str, Any], tmp_path: Path) -> None:
    """v grows upwards there, so the first row of a picture lies at the lower edge."""
    if kind == "item":
        shape = {"type": "rectangle", "to_world": [{"translate": [0, 0, 1]}]}
        built = stages.load_scene(configured(flat_wall({"type": "mitsuba", "shape": shape, "bsdf": picture})))
    else:
        (tmp_path / "scene.xml").write_text(
            "<scene version='3.0.0'><shape type='rectangle'><transform name='to_world'><translate z='1'/></transform>"
            "<bsdf type='diffuse'><texture type='bitmap' name='reflectance'><boolean name='raw' value='true'/>"
            "<string name='filter_type' value='nearest'/><string name='filename' value='texels.exr'/></texture></bsdf>"
            "</shape></scene>"
        )
        view = view_config(emitters=[LAMP], color="grey", scene={"mitsuba": "scene.xml"})
        built = stages.load_view(configured(view, folder=tmp_path))
    place = flat([0, 0, 1], Z, Y, 2.0, 2.0)
    np.testing.assert_allclose(seen(built, built.hidden_shapes[0], place, np.asarray), TEXELS[::-1], rtol=1e-6)


@pytest.mark.parametrize("name", ["quad.obj", "quad.ply"])
def test_a_picture_on_a_mesh_wall_lies_as_the_file_says(name: str, picture: dict[str, Any], tmp_path: Path) -> None:
    """The first row is at v = 1 of an .obj and at v = 0 of a .ply; wall coordinates grow with the file's u and v."""
    places, coordinates = flat([0, 0, 0], Z, Y, 2.0, 1.6), ((0, 0), (1, 0), (1, 1), (0, 1))
    corners = np.array([places(u, 1 - v)[0] for u, v in coordinates]).tolist()
    if name.endswith("obj"):
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"vt {u} {v}" for u, v in coordinates]
        lines += ["f 1/1 2/2 3/3 4/4"]
    else:
        lines = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {x}" for x in "xyzuv")]
        lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
        lines += [f"{x} {y} {z} {u} {v}" for (x, y, z), (u, v) in zip(corners, coordinates, strict=True)]
        lines += ["4 0 1 2 3"]
    (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    config = flat_wall()
    config["scene"]["relay_wall"] = {"type": "mesh", "filename": name, "bsdf": picture}
    built = stages.load_scene(configured(config, folder=tmp_path))
    expected = TEXELS if name.endswith("obj") else TEXELS[::-1]
    np.testing.assert_allclose(seen(built, built.wall_shape, places, built.wall.pose.to_local), expected, rtol=1e-6)
    np.testing.assert_allclose(built.wall.positions([0.3, 0.4]), [0.3, 0.4, 0], atol=1e-6)


def test_a_picture_in_a_scene_file_on_a_mesh_without_texture_coordinates_is_told(
    picture: dict[str, Any], tmp_path: Path
) -> None:
    """Mitsuba puts it on every triangle; with coordinates nothing is said."""
    texture = "<texture type='bitmap' name='reflectance'><string name='filename' value='texels.exr'/></texture>"
    content = f"""<scene version='3.0.0'><bsdf type='diffuse' id='b'>{texture}</bsdf>
      <shape type='obj'><string name='filename' value='a.obj'/><ref id='b'/></shape></scene>"""
    (tmp_path / "scene.xml").write_text(content, encoding="utf-8")
    config = view_config(emitters=[LAMP], color="grey", scene={"mitsuba": "scene.xml"})
    told = []
    for corners in ("1 2 3", "1/1 2/1 3/1"):
        (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf {corners}\n", encoding="utf-8")
        told.append(stages.load_view(configured(config, folder=tmp_path)).warnings)
    assert told[1] == ()
    (warning,) = told[0]
    assert "line 2: <shape type='obj'> has a picture, but its file no texture coordinates at every corner" in warning


WALLS = {
    "rectangle": ({"type": "rectangle", "width": 2.0, "height": 1.6, "center": CENTER.tolist(), **TURNED}, None),
    "sphere": ({"type": "sphere", "radius": 0.7, "inside": False}, None),
    "sphere from within": ({"type": "sphere", "radius": 0.7}, None),
    "cylinder": ({"type": "cylinder", "radius": 0.7, "height": 1.3, "inside": False}, 1.3),
    "turned cylinder from within": ({"type": "cylinder", "radius": 0.7, "height": 1.3, "axis": [0.3, 1.0, 0.4]}, 1.3),
}


@pytest.mark.parametrize("name", WALLS)
def test_a_picture_lies_the_right_way_up_on_the_relay_wall(name: str, picture: dict[str, Any]) -> None:
    """Rays meet the texel."""
    wall, height = WALLS[name]
    config = flat_wall()
    config["scene"]["relay_wall"] = {**wall, "center": CENTER.tolist(), "bsdf": picture}
    built = stages.load_scene(configured(config))
    if wall["type"] == "rectangle":
        place = flat(CENTER, TURNED["normal"], TURNED["up"], 2.0, 1.6)
    else:
        place = round_about(wall.get("axis", Y), Z, 0.7, height, inside=wall.get("inside", True))
    to_local = built.wall.pose.to_local
    np.testing.assert_allclose(seen(built, built.wall_shape, place, to_local), TEXELS, rtol=1e-6)


@pytest.mark.parametrize("name", ["rectangle", "cylinder", "relay wall"])
def test_the_pictures_own_transform_comes_last(name: str, picture: dict[str, Any]) -> None:
    """Moved by one column and one row in (u, v), every texel shows its neighbour to the right and below, all shapes."""
    picture["reflectance"]["to_uv"] = [{"translate": [1 / COLUMNS, 1 / ROWS, 0]}]
    config = flat_wall(wall={"bsdf": picture})
    place = flat([0, 0, 0], Z, Y, 2.0, 1.6)
    if name != "relay wall":
        item, place = ITEMS[name]
        config = flat_wall({**item, "center": CENTER.tolist(), "bsdf": picture})
    built = stages.load_scene(configured(config))
    shape = built.wall_shape if name == "relay wall" else built.hidden_shapes[0]
    expected = np.roll(TEXELS, (-1, -1), axis=(0, 1))
    np.testing.assert_allclose(seen(built, shape, place, built.wall.pose.to_local), expected, rtol=1e-6)


LASER, SENSORS = np.array([[[0.3, -0.2, 0.0]]]), grid_points(5, 3, 2.0, 1.6)
EDGES = np.linspace(0.0, 6.0, 61)


def looked_up(uv: Array) -> Array:
    """Texels at coordinates (n, 2) that grow to the right and upwards."""
    return TEXELS[((1 - uv[:, 1]) * ROWS).astype(int), (uv[:, 0] * COLUMNS).astype(int)]


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_light_from_a_plate_with_a_picture(engine: str, picture: dict[str, Any]) -> None:
    """The third bounce of a turned plate is the quadrature over its texels."""
    cells = rectangle_cells(0.9, 0.5, CENTER, TURNED["normal"], TURNED["up"], n=150)
    plate = {"type": "rectangle", "width": 0.9, "height": 0.5, "center": CENTER.tolist(), "bsdf": picture, **TURNED}
    budget = {"spp": 16384} if engine == "path" else {"spp": None, "target_error": 0.05}
    result = render(flat_wall(plate, bins=(0.0, 0.1, 60), engine=engine, color="grey", **budget))
    rho = looked_up(cells.uv)
    reference = third_bounces(Setup(cells, EDGES, brdf=lambda *_: rho / np.pi), LASER, SENSORS)
    # 5 % asked, 1 % of the quadrature's own; the picture upside down is 20 % off
    assert np.linalg.norm(result.total - reference) < 0.06 * np.linalg.norm(reference)


@pytest.mark.parametrize("engine", ["path", "virtual_lights"])
def test_light_from_a_wall_with_a_picture(engine: str, picture: dict[str, Any]) -> None:
    """Every sensor point reflects by the texel it lies on, and so does the laser point."""
    cells = rectangle_cells(0.9, 0.5, CENTER, -Z, n=100)
    plate = {"type": "rectangle", "width": 0.9, "height": 0.5, "center": CENTER.tolist()}
    budget = {"spp": 16384} if engine == "path" else {"spp": None, "target_error": 0.02}
    result = render(
        flat_wall(plate, bins=(0.0, 0.1, 60), wall={"bsdf": picture}, engine=engine, color="grey", **budget)
    )

    def on_wall(point: Array, ways: Array) -> Array:
        uv = point[None, :2] / [2.0, 1.6] + 0.5
        return looked_up(uv)[0] / np.pi * np.ones(len(ways))

    setup = Setup(cells, EDGES, laser_brdf=on_wall, sensor_brdf=on_wall)
    reference = third_bounces(setup, LASER, SENSORS)
    np.testing.assert_allclose(result.total.sum(axis=-1), reference.sum(axis=-1), rtol=0.03)  # texels differ by 1.5
