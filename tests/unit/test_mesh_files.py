"""What .obj and .ply files hold is read whole, or refused with its line: polygons, rows, marks, comments, strips."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import shapely

from nlosrender.scene.meshes.obj import read_obj
from nlosrender.scene.meshes.ply import read_ply

ELL = np.array([[0, 0], [0, 0.8], [0.24, 0.8], [0.24, 0.24], [0.8, 0.24], [0.8, 0]])  # area 0.8^2 - 0.56^2
PLATE = "v 0 0 1\nv 2 0 1\nv 2 1 1\nv 0 1 1\n"
PLY_PLATE = ("0 0 1", "2 0 1", "2 1 1", "0 1 1")


def shoelace(polygon: np.ndarray) -> float:
    """Area of a simple polygon."""
    (x, y), (u, v) = polygon.T, np.roll(polygon, -1, axis=0).T
    return 0.5 * abs(float((x * v - u * y).sum()))


def tilted(polygon: np.ndarray) -> np.ndarray:
    """The polygon in a plane that no axis is normal to."""
    return polygon[:, :1] * [0.6, 0.0, 0.8] + polygon[:, 1:] * [0.64, 0.6, -0.48] + [3.0, -1.0, 2.0]


def obj_polygon(points: np.ndarray) -> bytes:
    """One face, from its first corner on."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    return "\n".join([*lines, "f " + " ".join(str(i + 1) for i in range(len(points)))]).encode()


def ply_text(vertices: tuple[str, ...] = PLY_PLATE, faces: tuple[str, ...] = ("4 0 1 2 3",), more: str = "") -> bytes:
    """An ASCII file; ``more``: further properties of its faces."""
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n{more}end_header\n"
    return (head + "\n".join([*vertices, *faces]) + "\n").encode()


def ply_polygon(points: np.ndarray) -> bytes:
    """One face, from its first corner on."""
    vertices = tuple(f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist())
    return ply_text(vertices, (" ".join(map(str, [len(points), *range(len(points))])),))


READ = {"obj": (read_obj, obj_polygon), "ply": (read_ply, ply_polygon)}


@pytest.mark.parametrize("kind", READ)
@pytest.mark.parametrize("first", range(6))
def test_a_concave_polygon_has_its_own_area_from_whichever_corner_it_begins(kind: str, first: int) -> None:
    """An L is cut inside its rim, and its triangles face where it faces."""
    read, written = READ[kind]
    mesh = read(written(tilted(np.roll(ELL, first, axis=0)))).mesh
    # the triangles are a partition only if they overlap nowhere: then their areas sum to the polygon's
    assert np.isclose(mesh.area, 0.8**2 - 0.56**2, rtol=1e-12)
    normals = mesh.face_normals()
    np.testing.assert_allclose(normals, np.broadcast_to(-np.cross([0.6, 0, 0.8], [0.64, 0.6, -0.48]), normals.shape))


def test_polygons_that_no_corner_sees_whole_are_cut_by_ears() -> None:
    """Combs of 3 to 9 teeth: no fan covers them."""
    for teeth in range(3, 10):
        top = [[x + dx, y] for x in range(teeth) for dx, y in ((0.0, 3.0), (0.5, 3.0), (0.5, 1.0), (1.0, 1.0))]
        comb = np.array([[0.0, 0.0], *top, [float(teeth), 0.0]])
        mesh = read_obj(obj_polygon(tilted(comb))).mesh
        assert np.isclose(mesh.area, shoelace(comb), rtol=1e-12)
        assert np.isclose(mesh.area, teeth * (1 + 0.5 * 2), rtol=1e-12)


def test_a_hole_joined_to_the_rim_by_a_double_edge_stays_open() -> None:
    """How exporters write a square frame as one polygon."""
    rim, hole = [[0, 0], [4, 0], [4, 4], [0, 4]], [[1, 1], [1, 3], [3, 3], [3, 1]]
    frame = np.array([*rim, rim[0], *hole, hole[0]], dtype=float)
    for first in range(len(frame)):
        mesh = read_obj(obj_polygon(tilted(np.roll(frame, first, axis=0)))).mesh
        assert np.isclose(mesh.area, 16 - 4, rtol=1e-12)


def test_corners_that_all_but_touch_are_told_apart() -> None:
    """Outlines of random unions of squares, with corners on edges, twice the same, and rounded as in float32."""
    generator = np.random.default_rng(11)
    count = 0
    for _ in range(60):
        cells = np.argwhere(generator.random((5, 5)) < 0.6)
        union = shapely.union_all(shapely.box(*cells.T, *(cells.T + 1)))
        for part in shapely.get_parts(union):
            if part.interiors:
                continue
            rim = shapely.get_coordinates(part.exterior)[:-1]
            middles = (rim + np.roll(rim, -1, axis=0)) / 2
            corners = np.stack([rim, rim, middles], axis=1).reshape(-1, 2)[generator.random(3 * len(rim)) < 0.7]
            if shapely.area(shapely.Polygon(corners)) != part.area:
                continue  # a corner of the union is gone
            corners = corners + generator.normal(0, 1e-7, corners.shape)
            mesh = read_obj(obj_polygon(tilted(np.roll(corners, int(generator.integers(len(corners))), axis=0)))).mesh
            # slivers of up to 5 x 1e-6 at each of some 30 corners
            assert np.isclose(mesh.area, part.area, atol=2e-4)
            count += 1
    assert count > 10


def test_convex_polygons_are_fans_from_their_first_corner() -> None:
    """As they have always been: renders of quadrangles stay the same to the last bit."""
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    mesh = read_obj(obj_polygon(tilted(np.stack([np.cos(angles), np.sin(angles)], axis=-1)))).mesh
    np.testing.assert_array_equal(mesh.faces, [[0, k, k + 1] for k in range(1, 6)])


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0], [1, 1], [1, 0], [0, 1]],  # a bow-tie whose halves have the same area
        [[0, 0], [2, 1.5], [2, 0], [0, 1]],
        [[np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5)] for k in range(5)],  # a pentagram
    ],
)
def test_a_polygon_that_crosses_itself_is_refused_with_its_line(corners: list[list[float]]) -> None:
    """It bounds no one surface."""
    points = tilted(np.array(corners))
    with pytest.raises(ValueError, match=rf"line {len(points) + 1} is a polygon that crosses itself"):
        read_obj(obj_polygon(points))
    with pytest.raises(ValueError, match=rf"face 0 \(line {len(points) + 10}\) is a polygon that crosses itself"):
        read_ply(ply_polygon(points))


def test_a_polygon_that_is_bent_is_told() -> None:
    """A quadrangle with a corner out of its plane is two surfaces, by which diagonal it is cut along."""
    bent = tilted(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])) + np.array([[0], [0], [0.2], [0]]) * [0.0, 0.8, 0.6]
    assert "1 of its polygons are not flat, line 5 by" in read_obj(obj_polygon(bent)).doubts[0]
    assert not read_obj(obj_polygon(tilted(ELL))).doubts


def test_a_byte_order_mark_belongs_to_no_line() -> None:
    """Windows editors begin a file with it: the first vertex is there all the same."""
    mark = b"\xef\xbb\xbf"
    # four vertices after it: one lost would shift the indices, and the face would still be found
    assert read_obj(mark + (PLATE + "v 9 9 9\nf 1 2 3 4\n").encode()).mesh.area == 2.0
    assert read_ply(mark + ply_text()).mesh.area == 2.0


def test_comments_after_data_and_continued_lines() -> None:
    """A comment ends a line of numbers, a backslash joins it with the next; a comment that ends in one does not."""
    text = "# exported to C:\\models\\\n" + PLATE.replace("1\n", "1 # a 7\n", 1)
    assert read_obj((text + "f 1 2 \\\n 3 4 # f 1 1 1\n").encode()).mesh.area == 2.0
    with pytest.raises(ValueError, match="line 8, 'f 1 2 9', refers to a vertex"):
        read_obj((text + "f 1 2 \\\n 3 4\nf 1 2 9\n").encode())


def test_lines_that_mean_nothing_are_told() -> None:
    """A slip in a keyword loses a part of the surface: said with its line; so are surfaces that are not read."""
    found = read_obj((PLATE + "f 1 2 3\nf1 3 4\nsurf 0 1 0 1 1 2 3 4\nl 1 2\n").encode())
    assert "line 6: 'f1 3 4'" in " ".join(found.doubts)
    assert "free-form surfaces are left out" in " ".join(found.doubts)
    assert found.dropped == ("1 lines",)
    assert read_obj((PLATE + "o a\ng b\ns 1\nusemtl c\nf 1 2 3\n").encode()).doubts == ()


def test_materials_are_those_of_faces() -> None:
    """In the order of the file; one that no face has is none."""
    text = PLATE + "usemtl unused\nusemtl red paint\nf 1 2 3\nusemtl blue\nf 1 3 4\nusemtl red paint\nf 1 2 4\n"
    assert read_obj(text.encode()).materials == ("red paint", "blue")
    assert read_obj((PLATE + "f 1 2 3\nusemtl a\nf 1 3 4\n").encode()).materials == ("none", "a")
    more = ply_text(faces=("3 0 1 2 0", "3 0 2 3 4"), more="property int texnumber\n")
    assert read_ply(more).materials == ("texnumber 0", "texnumber 4")


def test_corners_without_normals_or_texture_coordinates() -> None:
    """Normals: zero there. Texture coordinates are all or none, and the line that lacks them is named."""
    text = PLATE + "vn 0 0 1\nvt 0.25 0.5\nvt 0.75\nf 1/1/1 2/2/1 3/1/1\nf 1 3 4\n"
    found = read_obj(text.encode())
    normals = found.mesh.normals
    assert normals is not None
    np.testing.assert_array_equal(normals[found.mesh.faces], [[[0, 0, 1]] * 3, [[0, 0, 0]] * 3])
    assert found.mesh.uvs is None
    assert found.no_uvs == "its face at line 9 has no texture coordinates"
    whole = read_obj(text.replace("f 1 3 4\n", "").encode()).mesh
    assert whole.uvs is not None
    np.testing.assert_array_equal(whole.uvs[whole.faces[0]], [[0.25, 0.5], [0.75, 1.0], [0.25, 0.5]])  # v up to down


LEFT_OVER = {
    "more in a row": (ply_text(faces=("3 0 1 2 0", "3 0 2 3 0")), r"line 14: values are left over \(1\)"),
    "list that the header does not name": (
        ply_text(faces=("3 0 1 2 9 1 1 1", "3 0 2 3 9 1 1 1"), more="property uchar red\n"),
        r"line 15: values are left over \(3\), element face",
    ),
    "more rows": (ply_text() + b"3 0 2 3\n\n3 0 1 2\n", "line 15 and 1 more: values are left over"),
    "a row that goes on": (ply_text(faces=("4 0 1", "2 3")), r"line 14: values are missing \(2\)"),
    "a word": (ply_text(("0 0 1", "2 0 1", "2 one 1", "0 1 1")), "line 12: 'one' is no number"),
    "fewer vertices than rows": (ply_text().replace(b"vertex 4", b"vertex 3"), "line 13: values are left over"),
}


@pytest.mark.parametrize("name", LEFT_OVER)
def test_a_row_of_a_ply_ends_at_its_line(name: str) -> None:
    """What the header does not announce has been misread: refused with the line, never half a mesh."""
    content, message = LEFT_OVER[name]
    with pytest.raises(ValueError, match=message):
        read_ply(content)


def binary_ply(faces: list[tuple[int, ...]], uvs: list[list[float]] | None = None, header: bytes = b"\n") -> bytes:
    """Little-endian, with the texture coordinates of each face's corners."""
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 4", *(f"property float {a}" for a in "xyz")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    lines += ["property list uchar float texcoord"] * (uvs is not None) + ["end_header", ""]
    body = b"".join(struct.pack("<3f", *map(float, row.split())) for row in PLY_PLATE)
    for number, face in enumerate(faces):
        body += struct.pack(f"<B{len(face)}i", len(face), *face)
        if uvs is not None:
            body += struct.pack(f"<B{len(uvs[number])}f", len(uvs[number]), *uvs[number])
    return header.join(line.encode() for line in lines) + body


def test_a_binary_body_ends_with_its_last_record() -> None:
    """Bytes left over are faces that the header does not count; white space at the end is none of them."""
    sound = binary_ply([(0, 1, 2), (0, 2, 3)])
    assert read_ply(sound + b"\r\n").mesh.area == 2.0
    with pytest.raises(ValueError, match="13 bytes are left over after what its header promises: 4 of element vertex"):
        read_ply(sound + struct.pack("<B3i", 3, 1, 2, 3))


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n", b"\r"])
def test_headers_of_all_systems(line_end: bytes) -> None:
    """The body begins right after the line end_header; a comment may name it."""
    content = binary_ply([(0, 1, 2, 3)], header=line_end)
    content = content.replace(b"element v", b"comment end_header" + line_end + b"element v")
    assert read_ply(content).mesh.area == 2.0


def test_texture_coordinates_of_corners_split_vertices() -> None:
    """MeshLab's ``texcoord`` of a face: neighbours may disagree about a vertex they share."""
    left, right = [0.0, 0.0, 1.0, 0.0, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0, 0.0, 1.0]
    mesh = read_ply(binary_ply([(0, 1, 2), (0, 2, 3)], [left, right])).mesh
    assert mesh.uvs is not None
    np.testing.assert_array_equal(mesh.uvs[mesh.faces], np.reshape([left, right], (2, 3, 2)))
    assert len(mesh.vertices) == 5  # vertex 0 twice, vertex 2 has (1, 1) in both
    assert mesh.area == 2.0
    quadrangle = read_ply(binary_ply([(0, 1, 2, 3)], [[0, 0, 1, 0, 1, 1, 0, 1]])).mesh
    np.testing.assert_array_equal(quadrangle.uvs, [[0, 0], [1, 0], [1, 1], [0, 1]])
    some = read_ply(binary_ply([(0, 1, 2), (0, 2, 3)], [left, []]))
    assert some.no_uvs == "its face 1 has no texture coordinates for its corners"


def test_triangle_strips_turn_every_second_triangle() -> None:
    """Two strips of one list, ended by -1, and a second list: all triangles face +z, the area is the grid's."""
    columns = 5
    vertices = tuple(f"{i // 2} {i % 2} 1" for i in range(2 * columns))
    strip = " ".join(str(i ^ 1) for i in range(6)) + " -1 " + " ".join(str(i ^ 1) for i in range(4, 10))
    head = ply_text(vertices, ()).decode().replace("element face 0", "element tristrips 2").splitlines()
    text = [*head[: head.index("end_header") + 1], *vertices, f"{len(strip.split())} {strip}", "3 0 2 1"]
    mesh = read_ply(("\n".join(text) + "\n").encode()).mesh
    assert len(mesh.faces) == 2 * (columns - 1) + 1
    assert np.isclose(mesh.area, columns - 1 + 0.5)
    np.testing.assert_array_equal(mesh.face_normals()[:, 2], [1] * 9)
