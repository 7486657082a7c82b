"""Whatever is in a mesh file: its triangles, or a message that says what is wrong with it."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from conftest import Ledger
from containment import Containment
from damage import damaged
from support.rendering import configured, flat_wall, render

from nlosrender.errors import ConfigError
from nlosrender.scene.meshes.mesh_file import read_mesh

CORNERS = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0.1]])
TRIANGLES = ((0, 2, 1), (0, 3, 2))


def ply(faces: object = TRIANGLES, order: str = "<", scalar: str = "float", count: int | None = None) -> bytes:
    """Return a .ply file; ``order`` < or > for binary, "" for ASCII; ``count``: the number of faces it claims."""
    faces = list(faces)  # type: ignore[call-overload]
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = f"ply\nformat {name} 1.0\ncomment made by hand\nobj_info none\nelement vertex {len(CORNERS)}\n"
    header += "".join(f"property {scalar} {axis}\n" for axis in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    header += (
        f"element face {len(faces) if count is None else count}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = [(*corner, 0.0, 0.0, -2.0, corner[0] + 0.5, corner[1] + 0.5) for corner in CORNERS.tolist()]
    if not order:
        lines = [" ".join(map(repr, row)) for row in rows] + [
            f"{len(face)} {' '.join(map(str, face))}" for face in faces
        ]
        return (header + "\n".join(lines) + "\n").encode()
    kind = {"float": "f", "double": "d"}[scalar]
    body = b"".join(struct.pack(f"{order}8{kind}", *row) for row in rows)
    return header.encode() + body + b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)


def obj(faces: str = "f 1/1/1 3/3/1 2/2/1\nf 1/1/1 4/4/1 3/3/1\n") -> bytes:
    """Return an .obj file with texture coordinates and one normal."""
    text = "# by hand\nmtllib /etc/passwd\no plate\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS.tolist())
    text += "".join(f"vt {x + 0.5} {0.5 - y}\n" for x, y, _ in CORNERS.tolist()) + "vn 0 0 -2\nusemtl x\ns off\n"
    return (text + faces).encode()


SOUND = {
    "little endian.ply": ply(),
    "big endian.ply": ply(order=">"),
    "text.ply": ply(order=""),
    "doubles.ply": ply(scalar="double"),
    "quadrangle.ply": ply([(0, 3, 2, 1)]),
    "plain.obj": obj(),
    "quadrangle.obj": obj("f 1/1/1 4/4/1 3/3/1 2/2/1\n"),
    "negative.obj": obj("f -4/-4/-1 -2/-2/-1 -3/-3/-1\nf -4/-4/-1 -1/-1/-1 -2/-2/-1\n"),
    "continued.obj": obj("f 1/1/1 3/3/1 \\\n2/2/1\nf 1/1/1 4/4/1 \\\r\n3/3/1\n"),
}


def read(path: Path, content: bytes) -> np.ndarray:
    """Write and read a file; return its corners, texture coordinates and normals, face by face."""
    path.write_bytes(content)
    mesh = read_mesh(str(path), path.suffix.lstrip("."), "mitsuba")
    assert mesh.normals is not None
    parts = [mesh.vertices, mesh.normals] + ([] if mesh.uvs is None else [mesh.uvs])
    return np.concatenate([part[mesh.faces] for part in parts], axis=-1)


@pytest.mark.parametrize("name", SOUND)
def test_all_ways_to_write_a_plate_are_the_plate(name: str, tmp_path: Path) -> None:
    """Byte orders, number types, polygons, relative indices: the same triangles, coordinates and unit normals."""
    found = read(tmp_path / f"a.{name.split('.')[1]}", SOUND[name])
    corners = CORNERS[np.array(TRIANGLES)]
    expected = np.concatenate([corners, np.broadcast_to([0, 0, -1], corners.shape), corners[..., :2] + 0.5], axis=-1)
    order = np.lexsort(found.reshape(len(found), -1).T[::-1].round(6))
    rolled = {tuple(np.roll(triangle, k, axis=0).ravel().round(6)) for triangle in expected for k in range(3)}
    if "quadrangle" in name:
        assert len(found) == 2
        assert np.isclose(found[..., 2].sum(), 0.2 if found[0, :, 2].any() and found[1, :, 2].any() else 0.1)
    else:
        assert all(tuple(triangle.ravel().round(6)) in rolled for triangle in found[order])


def test_mixed_polygons_are_read_in_turn(tmp_path: Path) -> None:
    """Runs of triangles, quadrangles and pentagons of random lengths, against the list they were written from."""
    generator = np.random.default_rng(5)
    faces = [tuple(generator.permutation(4)[:3]) for _ in range(40)] + [(0, 1, 2, 3)] * 25 + [(0, 1, 2, 3, 0)] * 3
    generator.shuffle(faces)
    for order in ("<", ">", ""):
        path = tmp_path / "mixed.ply"
        path.write_bytes(ply(faces, order))
        fans = [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]
        area = sum(0.5 * np.linalg.norm(np.cross(*(CORNERS[list(fan)][1:] - CORNERS[fan[0]]))) for fan in fans)
        assert np.isclose(read_mesh(str(path), "ply").area, area)


def test_normals_are_those_mitsuba_computes(tmp_path: Path) -> None:
    """A file without normals gets the angle-weighted ones that Mitsuba's own reader gives it, to float32."""
    from nlosrender.engine.backend.start import start_backend

    start_backend("llvm")
    import mitsuba as mi

    generator = np.random.default_rng(3)
    vertices, faces = generator.normal(size=(40, 3)), np.array([generator.permutation(40)[:3] for _ in range(60)])
    path = tmp_path / "a.obj"
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist())
    path.write_text(text + "".join(f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()))
    parameters = mi.traverse(mi.load_dict({"type": "obj", "filename": str(path)}))
    theirs = np.array(parameters["vertex_normals"]).reshape(-1, 3)[np.array(parameters["faces"]).reshape(-1, 3)]
    mesh = read_mesh(str(path), "obj", "mitsuba")
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals[mesh.faces], theirs, atol=2e-5)  # float32 angles, summed over 5 faces


def test_opposite_faces_on_shared_vertices_keep_their_own_normals(tmp_path: Path) -> None:
    """Smooth normals of a double-sided sheet cancel out: each side is flat instead."""
    path = tmp_path / "sheet.ply"
    path.write_bytes(ply([(0, 1, 2), (0, 2, 1)]).replace(b"nx", b"ax").replace(b"ny", b"ay").replace(b"nz", b"az"))
    mesh = read_mesh(str(path), "ply", "mitsuba")
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals[mesh.faces], [[[0, 0, 1]] * 3, [[0, 0, -1]] * 3], atol=1e-12)


BAD = {
    "empty.ply": (b"", "it is empty"),
    "garbage.ply": (bytes(range(7, 200)), "it starts with .*, not with the line ply"),
    "no end.ply": (b"ply\nformat ascii 1.0\n", "no line end_header"),
    "no format.ply": (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "its header has no line format"),
    "negative count.ply": (
        ply().replace(b"vertex 4", b"vertex -4"),
        "line 5 of its header means nothing: 'element vertex -4'",
    ),
    "huge count.ply": (ply(count=4_000_000_000), "it has 4000000000 of element face, but ends after 2"),
    "huger count.ply": (ply().replace(b"vertex 4", b"vertex 4611686018427387904"), "of element vertex, but ends after"),
    "cut.ply": (ply()[:-5], "it has 2 of element face, but ends after 1"),
    "cut text.ply": (ply(order="")[:-4], "line 22: values are missing .2., element face of its header has more"),
    "index.ply": (ply([(0, 2, 1), (0, 3, 999_999)]), r"face 1 is \[0, 3, 999999\]: indices must lie between 0 and 3"),
    "large index.ply": (ply([(0, 2, 2**31 - 1)]), "indices must lie between 0 and 3"),
    "index below.ply": (ply([(0, 2, -1)]), r"face 0 is \[0, 2, -1\]"),
    "text index.ply": (ply([(0, 2, 1.5)], ""), "a face has the index 1.5, need integers"),
    "nan index.ply": (ply([(0, 2, "nan")], ""), "an index that is no number"),
    "long polygon.ply": (ply([(0, 1, 2) * 400], ""), "face 0 has a list of 1200 values, need 0 to 1000"),
    "points.ply": (ply().replace(b"face", b"edge"), "there is no element face"),
    "no x.ply": (ply().replace(b"float x", b"float q"), "there is no element vertex with x, y and z"),
    "nan.ply": (ply(order="").replace(b"-0.5 -0.5", b"nan -0.5", 1), r"vertices: vertex 0 is \[nan, -0.5, 0.0\]"),
    "nan normal.ply": (ply(order="").replace(b"-2.0", b"nan", 1), "normals: vertex 0 is"),
    "far.ply": (ply(order="").replace(b"-0.5 -0.5", b"1e200 -0.5", 1), r"need coordinates up to 1e\+30"),
    "no faces.ply": (ply([]), "it has no triangles"),
    "lines.ply": (ply([(0, 1), (1, 2)]), "it has no triangles"),
    "flat.ply": (ply([(0, 0, 1), (2, 2, 2)]), "none of its triangles has an area"),
    "empty.obj": (b"", "it has no vertices"),
    "binary.obj": (ply(), "a zero byte, so it is not text"),
    "no faces.obj": (b"v 0 0 0\n", "it has no faces"),
    "words.obj": (b"v a b c\nf 1 1 1\n", "line 1: need 3 numbers after v, got 'v a b c'"),
    "two numbers.obj": (b"v 0 0 0\nv 1 2\nf 1 1 1\n", "line 2: need 3 numbers after v, got 'v 1 2'"),
    "index.obj": (
        obj("f 1 2 9\n"),
        "line 15, 'f 1 2 9', refers to a vertex that is not there: .* 4, the first",
    ),
    "zero.obj": (obj("f 0 1 2\n"), "line 15, 'f 0 1 2', refers to a vertex that is not there"),
    "below.obj": (obj("f -1 -2 -9\n"), "refers to a vertex that is not there"),
    "huge index.obj": (obj("f 1 2 99999999999999999999\n"), "'99999999999999999999' is no corner"),
    "texture.obj": (
        obj("f 1/9 2/1 3/1\n"),
        "refers to a texture coordinate .* has 4",
    ),
    "normal.obj": (obj("f 1//2 2//1 3//1\n"), "refers to a normal that is not there: the file has 1, the first is 1"),
    "corner.obj": (obj("f 1/1/1/1 2 3\n"), "'1/1/1/1' is no corner, need v, v/vt, v//vn or v/vt/vn"),
    "long polygon.obj": (obj("f" + " 1" * 2000 + "\n"), "2000 corners, need at most 1000"),
    "infinite.obj": (b"v " + b"9" * 100_000 + b" 0 0\nv 0 0 0\nv 0 1 0\nf 1 2 3\n", r"vertex 0 is \[inf, 0.0, 0.0\]"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_mesh_is_told_what_is_wrong(name: str, tmp_path: Path) -> None:
    """Counts, indices and numbers that cannot be; several of them used to end the process."""
    content, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        read(tmp_path / f"a.{name.split('.')[1]}", content)


@pytest.mark.parametrize("cases", [150, pytest.param(4000, marks=pytest.mark.stress)])
def test_damaged_meshes_are_read_or_refused(cases: int, tmp_path: Path, ledger: Ledger) -> None:
    """Random damage: a mesh of finite numbers and sound indices, or a ValueError with a message."""
    names = list(SOUND)
    for seed in range(cases):
        name, message = names[seed % len(names)], "read"
        try:
            assert np.isfinite(read(tmp_path / f"a.{name.split('.')[1]}", damaged(SOUND[name], seed))).all()
        except ValueError as error:
            message = str(error)
        assert message
        ledger.count("damaged meshes, read", refused=message != "read", fault="")


@pytest.mark.stress
def test_damaged_meshes_are_rendered_or_refused(tmp_path: Path, contained: Containment, ledger: Ledger) -> None:
    """The command `plan` survives them, in both engines."""
    names, planned = list(SOUND), 0
    for seed in range(300):
        name = names[seed % len(names)]
        mesh = tmp_path / f"a.{name.split('.')[1]}"
        mesh.write_bytes(damaged(SOUND[name], seed))
        config = tmp_path / "a.yaml"
        item = f"{{type: mesh, filename: {mesh}, translate: [0, 0, 1]}}"
        config.write_text(
            f"scene: {{relay_wall: {{type: rectangle, width: 2, height: 2}}, hidden_geometry: [{item}]}}\n"
            "capture: {scan_type: confocal, sensor_grid: {nx: 3, ny: 2}}\n"
            "time_axis: {bin_width_opl: 0.05, n_bins: 128}\n"
            f"render: {{max_bounces: 4, time_limit_s: 0.1, engine: {('path', 'virtual_lights')[seed % 2]}}}\n"
        )
        outcome = contained.run("plan", config)
        planned += outcome.exit_code == 0
        ledger.count("damaged meshes, plan", refused=outcome.exit_code == 3, fault=outcome.fault)
        assert not outcome.fault, f"seed {seed}: {outcome.fault}\n{outcome.trace}"
        assert outcome.exit_code in (0, 3)
    assert planned > 20  # or all were refused for another reason


def test_a_small_mesh_takes_little_memory(tmp_path: Path, contained: Containment) -> None:
    """Reading up to the largest size allowed once reserved all of it: 4 GiB for two triangles."""
    mesh, config = tmp_path / "a.ply", tmp_path / "a.yaml"
    mesh.write_bytes(ply())
    item = f"{{type: mesh, filename: {mesh}, translate: [0, 0, 1]}}"
    config.write_text(
        f"scene: {{relay_wall: {{type: rectangle, width: 2, height: 2}}, hidden_geometry: [{item}]}}\n"
        "capture: {scan_type: confocal, sensor_grid: {nx: 3, ny: 2}}\ntime_axis: {bin_width_opl: 0.05, n_bins: 128}\n"
    )
    assert contained.run("plan", config).exit_code == 0


def serialized(faces: tuple[int, ...]) -> bytes:
    """Return one triangle in Mitsuba's own format."""
    body = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", 3, 1)
    body += np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], "<f4").tobytes() + np.array(faces, "<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


@pytest.mark.parametrize(
    ("kind", "content", "message"),
    [
        ("ply", ply([(0, 2, 1), (0, 3, 999_999)]), r"hidden_geometry\.0\.filename: .*face 1 is \[0, 3, 999999\]"),
        ("obj", obj("f 1 2 9\n"), "refers to a vertex that is not there"),
        ("serialized", serialized((0, 2, 99_999_999)), "a face refers to vertex 99999999, the file has 3"),
    ],
)
def test_meshes_behind_a_mitsuba_plugin_are_checked_as_well(
    kind: str, content: bytes, message: str, tmp_path: Path
) -> None:
    """Mitsuba's own readers end the process on a wrong index: ours read .ply and .obj, and look at the third first."""
    path = tmp_path / f"a.{kind}"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        render(flat_wall({"type": "mitsuba", "shape": {"type": kind, "filename": str(path)}}, spp=2))


def test_a_sound_mesh_is_the_same_behind_a_plugin(tmp_path: Path) -> None:
    """type: mesh, and type: mitsuba with a ply plugin; flip_normals turns it round."""
    path = tmp_path / "a.ply"
    path.write_bytes(ply())
    steps = {"to_world": [{"translate": [0, 0, 1]}], "face_normals": True}
    plugin = {"type": "mitsuba", "shape": {"type": "ply", "filename": str(path), **steps}}
    turned = {"type": "mitsuba", "shape": {**plugin["shape"], "flip_normals": True}}  # type: ignore[dict-item]
    mesh = {"type": "mesh", "filename": str(path), "translate": [0, 0, 1], "face_normals": True}
    same, other, dark = (render(flat_wall(item, spp=64)).mean for item in (mesh, plugin, turned))
    np.testing.assert_array_equal(same, other)
    assert same.any()
    assert not dark.any()
    assert configured(flat_wall(plugin))
