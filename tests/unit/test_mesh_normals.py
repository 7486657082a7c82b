"""Normals of mesh files, mirrored meshes, and what is said of each mesh before it is rendered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.rendering import configured, flat_wall

from nlosrender.errors import ConfigError
from nlosrender.scene.meshes.mesh_file import read_mesh
from nlosrender.scene.meshes.mesh_report import edge_counts
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.read_surfaces import ReadSurfaces, describe_meshes

CUBE = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
# two triangles a side, counter-clockwise from outside
SIDES = [[1, 3, 4], [1, 4, 2], [5, 6, 8], [5, 8, 7], [1, 2, 6], [1, 6, 5]]
SIDES += [[3, 7, 8], [3, 8, 4], [1, 5, 7], [1, 7, 3], [2, 4, 8], [2, 8, 6]]


def cube(folder: Path, corner: str = "{v}", more: str = "", faces: object = SIDES) -> str:
    """Write a cube of edges 2; ``corner`` is how a corner of a face is written. Return the file's name."""
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in CUBE.tolist()) + more
    text += "".join("f " + " ".join(corner.format(v=v) for v in face) + "\n" for face in faces)  # type: ignore[attr-defined]
    path = folder / "cube.obj"
    path.write_text(text)
    return str(path)


def vertex_normals(sign: float = 1.0) -> str:
    """A normal for each vertex, away from the cube's centre."""
    return "".join(f"vn {sign * x} {sign * y} {sign * z}\n" for x, y, z in CUBE.tolist())


def described(*items: dict, folder: Path) -> ReadSurfaces:
    """Read the meshes of a scene."""
    return describe_meshes(configured(flat_wall(*items), folder=folder).scene)


def mesh_item(filename: str, **keys: object) -> dict:
    """A mesh in front of the wall."""
    return {"type": "mesh", "filename": filename, "translate": [0, 0, 3], **keys}


def only_mesh(read: ReadSurfaces) -> TriangleMesh:
    """The one shape of a scene."""
    (mesh,) = read.shapes
    assert isinstance(mesh, TriangleMesh)
    return mesh


def test_a_file_without_normals_is_flat_unless_smooth_is_asked_for(tmp_path: Path) -> None:
    """Averaged normals change the light of a cube by a quarter: a file that has none does not ask for them."""
    name = cube(tmp_path)
    assert read_mesh(name, "obj").normals is None
    assert read_mesh(name, "obj", "flat").normals is None
    smooth = read_mesh(name, "obj", "smooth")
    np.testing.assert_allclose(smooth.normals, smooth.vertices / np.sqrt(3), atol=1e-12)
    with pytest.raises(ValueError, match="12 of its 12 triangles have no normals"):
        read_mesh(name, "obj", "file")


def test_normals_of_a_file_are_taken_and_its_other_faces_are_flat(tmp_path: Path) -> None:
    """One side of a cube without normals keeps the faces' own, and no other corner changes."""
    text = Path(cube(tmp_path, "{v}//{v}", vertex_normals())).read_text().splitlines()
    text[-1], text[-2] = "f 2 8 6", "f 2 4 8"
    (tmp_path / "cube.obj").write_text("\n".join(text))
    mesh = read_mesh(str(tmp_path / "cube.obj"), "obj")
    assert mesh.normals is not None
    corners = mesh.normals[mesh.faces]
    np.testing.assert_allclose(corners[:10], mesh.vertices[mesh.faces[:10]] / np.sqrt(3), atol=1e-12)
    np.testing.assert_allclose(corners[10:], np.broadcast_to([1, 0, 0], (2, 3, 3)), atol=1e-12)
    with pytest.raises(ValueError, match="2 of its 12 triangles have no normals"):
        read_mesh(str(tmp_path / "cube.obj"), "obj", "file")


def test_normals_that_are_the_faces_are_left_away(tmp_path: Path) -> None:
    """Programs write flat faces with a normal each: engines then need not know of them. ``file`` keeps them."""
    sides = [[0, 0, -1], [0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]]
    more = "".join(f"vn {x} {y} {z}\n" for x, y, z in sides)
    faces = [[f"{v}//{side // 2 + 1}" for v in face] for side, face in enumerate(SIDES)]
    name = cube(tmp_path, more=more, faces=faces)
    assert read_mesh(name, "obj").normals is None
    assert read_mesh(name, "obj", "file").normals is not None


def test_smooth_normals_do_not_stop_at_seams_of_the_texture(tmp_path: Path) -> None:
    """Corners that differ in texture coordinates only are one point of the surface."""
    more = "".join(f"vt {k / 40} 0.5\n" for k in range(36))
    faces = [[f"{v}/{3 * number + k + 1}" for k, v in enumerate(face)] for number, face in enumerate(SIDES)]
    mesh = read_mesh(cube(tmp_path, more=more, faces=faces), "obj", "smooth")
    assert len(mesh.vertices) == 36
    np.testing.assert_allclose(mesh.normals, mesh.vertices / np.sqrt(3), atol=1e-12)


@pytest.mark.parametrize("scale", [-0.5, [-1, 1, 1], [1, -2, 0.5], [-1, -2, 0.5], [-1, -2, -0.5]])
def test_mirrored_meshes_keep_facing_outwards(tmp_path: Path, scale: object) -> None:
    """Any scale of a closed mesh: its signed volume is the scaled one and positive, its normals point outwards."""
    item = mesh_item(cube(tmp_path, "{v}//{v}", vertex_normals()), scale=scale, rotate_deg=[20, 30, 10])
    mesh = only_mesh(described(item, folder=tmp_path))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    volume = np.einsum("nx,nx->", a, np.cross(b, c)) / 6
    assert np.isclose(volume, 8 * abs(np.prod(np.broadcast_to(np.array(scale, dtype=float), 3))))
    assert mesh.normals is not None
    outwards = mesh.vertices - mesh.vertices.mean(axis=0)
    assert (np.einsum("nx,nx->n", outwards, mesh.normals) > 0).all()


@pytest.mark.parametrize("scale", [0, [1, 0, 1], [1, 1], True, "2", [1, None, 1]])
def test_a_scale_that_flattens_is_refused(tmp_path: Path, scale: object) -> None:
    """A number other than 0, or three."""
    with pytest.raises(ConfigError, match=r"scale: .*need a number other than 0, or three of them"):
        configured(flat_wall(mesh_item(cube(tmp_path), scale=scale)), folder=tmp_path)


def test_face_normals_and_normals_must_not_contradict(tmp_path: Path) -> None:
    """face_normals is Mitsuba's key: true is flat; false the file's, or averaged where it has none."""
    name = cube(tmp_path)
    for keys, expected in (
        ({}, "flat"),
        ({"face_normals": True}, "flat"),
        ({"face_normals": False}, "smoothed"),
        ({"face_normals": False, "normals": "smooth"}, "smoothed"),
    ):
        (mesh,) = described(mesh_item(name, **keys), folder=tmp_path).meshes  # type: ignore[arg-type]
        assert mesh.normals == expected
    for keys in ({"face_normals": True, "normals": "smooth"}, {"face_normals": False, "normals": "flat"}):
        with pytest.raises(ConfigError, match=r"normals: face_normals is .*, normals is .*\. Remove one of the two"):
            configured(flat_wall(mesh_item(name, **keys)), folder=tmp_path)  # type: ignore[arg-type]
    plugin = {"type": "mitsuba", "shape": {"type": "obj", "filename": name, "to_world": [{"translate": [0, 0, 3]}]}}
    (mesh,) = described(plugin, folder=tmp_path).meshes
    assert mesh.normals == "smoothed"  # a Mitsuba shape keeps Mitsuba's convention


def test_edges_whose_faces_disagree_are_counted() -> None:
    """A cube with one side turned round: its four outer edges; two faces of a side turned alike: not their diagonal."""
    faces = np.array(SIDES) - 1
    assert edge_counts(faces) == (18, 0)
    faces[0] = faces[0][::-1]
    assert edge_counts(faces) == (18, 3)
    faces[1] = faces[1][::-1]
    assert edge_counts(faces) == (18, 4)


def test_what_is_said_of_a_cube(tmp_path: Path) -> None:
    """All figures of the line; before a 2.0 x 1.6 m wall: its front of 2 m^2, and the sides at x = +-0.5 of 4."""
    (mesh,) = described(mesh_item(cube(tmp_path), scale=[0.5, 1, 1]), folder=tmp_path).meshes
    assert mesh.line() == (
        "mesh-0 (cube.obj): 12 triangles, 16 m^2, 1 x 2 x 2 m, 62.5 % of its area faces the wall, flat, "
        "no texture coordinates"
    )


def test_what_is_hardly_meant_is_told(tmp_path: Path) -> None:
    """Winding, normals, materials: each with its number and what to do; a sound cube has no warning."""
    sound = mesh_item(cube(tmp_path, "{v}//{v}", vertex_normals()))
    assert described(sound, folder=tmp_path).warnings == ()
    turned = [SIDES[0][::-1], SIDES[1][::-1], *SIDES[2:]]
    item = mesh_item(cube(tmp_path, faces=turned))
    assert "at 4 of its 18 edges the two faces disagree" in described(item, folder=tmp_path).warnings[0]
    assert described({**item, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}, folder=tmp_path).warnings == ()
    inwards = described(mesh_item(cube(tmp_path, "{v}//{v}", vertex_normals(-1.0))), folder=tmp_path)
    assert "the file's normals contradict its faces on 100 % of its area" in inwards.warnings[0]
    assert np.isclose(inwards.meshes[0].largest_angle_deg, 180 - np.degrees(np.arccos(1 / np.sqrt(3))))
    painted = [f"{name}\nf {' '.join(map(str, face))}\n" for name, face in zip("ab" * 6, SIDES, strict=True)]
    path = tmp_path / "cube.obj"
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in CUBE.tolist()) + "usemtl " + "usemtl ".join(painted))
    (warning,) = described(mesh_item(str(path)), folder=tmp_path).warnings
    assert "its faces have 2 materials (a, b), which are not read" in warning


@pytest.mark.parametrize("kind", ["mesh", "mitsuba"])
def test_a_picture_needs_texture_coordinates(tmp_path: Path, kind: str) -> None:
    """Without them Mitsuba would look it up by a point's place within its triangle."""
    bsdf = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    name = cube(tmp_path, "{v}/1", "vt 0.5 0.5\n")
    items = {"mesh": mesh_item(name), "mitsuba": {"type": "mitsuba", "shape": {"type": "obj", "filename": name}}}
    item = {**items[kind], "bsdf": bsdf}
    assert only_mesh(described(item, folder=tmp_path)).uvs is not None
    text = Path(name).read_text()
    Path(name).write_text(text.replace("f 2/1 8/1 6/1", "f 2 8 6"))
    message = r"hidden_geometry\.0\.bsdf: a picture needs .*: its face at line 21 has no texture coordinates"
    with pytest.raises(ConfigError, match=message):
        described(item, folder=tmp_path)
    described(mesh_item(name), folder=tmp_path)  # nothing to place
