"""Triangle meshes and the flat primitives."""

import numpy as np
import pytest

from nlosrender.scene.meshes.primitives import box_mesh, rectangle_mesh, room_mesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Pose

POSE = Pose.from_normal_up([0.3, -0.2, 1.1], [0.2, -0.4, -1.0], [0.1, 1.0, 0.3])
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def face_centres(mesh):
    return mesh.vertices[mesh.faces].mean(axis=1)


def signed_volume(mesh):
    """Volume inside a closed mesh with outward normals, by the divergence theorem."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.sum(a * np.cross(b, c)) / 6


def test_rectangle_has_its_size_and_faces_its_normal():
    """A posed rectangle has area width x height and both faces along the pose's z axis."""
    mesh = rectangle_mesh(0.6, 1.4, POSE)
    assert mesh.area == pytest.approx(0.84, rel=1e-14)
    np.testing.assert_allclose(mesh.face_normals(), np.tile(POSE.rotation[:, 2], (2, 1)), atol=1e-14)
    np.testing.assert_allclose(np.ptp(POSE.to_local(mesh.vertices), axis=0), [0.6, 1.4, 0], atol=1e-14)


def test_rectangle_texture_follows_its_axes():
    """u grows along x and v along y, from 0 to 1."""
    mesh = rectangle_mesh(0.6, 1.4, POSE)
    local = POSE.to_local(mesh.vertices)
    np.testing.assert_allclose(mesh.uvs, local[:, :2] / [0.6, 1.4] + 0.5, atol=1e-14)


def test_box_is_closed_with_outward_normals():
    """A posed box has 12 faces, the closed-form area and volume, and normals away from its centre."""
    size = np.array([0.3, 0.5, 0.9])
    mesh = box_mesh(size, POSE)
    assert len(mesh.faces) == 12
    assert mesh.area == pytest.approx(2 * (0.3 * 0.5 + 0.5 * 0.9 + 0.9 * 0.3), rel=1e-14)
    assert signed_volume(mesh) == pytest.approx(size.prod(), rel=1e-13)
    assert np.all(np.sum((face_centres(mesh) - POSE.origin) * mesh.face_normals(), axis=1) > 0)
    np.testing.assert_allclose(np.ptp(POSE.to_local(mesh.vertices), axis=0), size, atol=1e-14)


def test_room_is_open_towards_the_wall_and_faces_inwards():
    """Five sides between z = 0 and the depth, none in z = 0, all with normals towards the room's middle."""
    mesh = room_mesh([3.0, 2.5, 4.0])
    np.testing.assert_allclose(mesh.bounds(), [[-1.5, -1.25, 0], [1.5, 1.25, 4]], atol=1e-14)
    assert len(mesh.faces) == 10
    assert mesh.area == pytest.approx(3 * 2.5 + 2 * 4 * (3 + 2.5), rel=1e-14)
    assert not np.any(np.abs(face_centres(mesh)[:, 2]) < 0.1)
    towards_middle = np.array([0, 0, 2.0]) - face_centres(mesh)
    assert np.all(np.sum(towards_middle * mesh.face_normals(), axis=1) > 0)


@pytest.mark.parametrize("matrix", [np.diag([0.5, 2.0, 1.5, 1.0]), MIRROR @ POSE.matrix()])
def test_transformed_faces_keep_the_side_of_their_normals(matrix):
    """Under any affine map, mirrored or not, the winding agrees with the transformed shading normals."""
    box = box_mesh([0.3, 0.5, 0.9], POSE)
    normals = np.repeat(box.face_normals()[::2], 4, axis=0)
    mesh = TriangleMesh(box.vertices, box.faces, box.uvs, normals).transformed(matrix)
    shading = mesh.normals[mesh.faces[:, 0]]
    np.testing.assert_allclose(np.sum(shading * mesh.face_normals(), axis=1), 1.0, atol=1e-13)
    assert signed_volume(mesh) == pytest.approx(0.135 * abs(np.linalg.det(matrix[:3, :3])), rel=1e-12)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1.0, 0.0, 1.0]), "singular"),
        (np.eye(3), "affine 4 x 4"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "last row"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_impossible_transforms_are_refused(matrix, message):
    """A transform that flattens or projects is refused."""
    with pytest.raises(ValueError, match=message):
        rectangle_mesh(1, 2).transformed(matrix)


def test_merged_meshes_keep_faces_and_texture():
    """Merging adds areas, and keeps uvs only when every part has them."""
    first, second = rectangle_mesh(0.6, 1.4), box_mesh([0.3, 0.5, 0.9], POSE)
    both = TriangleMesh.merged([first, second])
    np.testing.assert_array_equal(both.areas(), np.concatenate([first.areas(), second.areas()]))
    np.testing.assert_array_equal(both.uvs, np.concatenate([first.uvs, second.uvs]))
    bare = TriangleMesh(first.vertices, first.faces)
    assert TriangleMesh.merged([bare, second]).uvs is None
    with pytest.raises(ValueError, match="at least one"):
        TriangleMesh.merged([])


def test_subset_keeps_only_its_vertices():
    """A subset has the chosen faces' areas, texture and bounds, and no unused vertices."""
    box = box_mesh([0.3, 0.5, 0.9])
    mask = box.face_normals()[:, 2] > 0.5
    side = box.subset(mask)
    assert side.vertices.shape == (4, 3)
    assert side.uvs.shape == (4, 2)
    assert side.area == pytest.approx(0.15)
    np.testing.assert_allclose(side.bounds(), [[-0.15, -0.25, 0.45], [0.15, 0.25, 0.45]])
    empty = box.subset(np.zeros(12, dtype=bool))
    assert empty.area == 0
    with pytest.raises(ValueError, match="no bounds"):
        empty.bounds()
    with pytest.raises(ValueError, match="booleans"):
        box.subset(np.arange(12))


VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.array([[0, 0, 0], [1, np.nan, 0], [0, np.inf, 0]]), [[0, 1, 2]]), "vertices: vertex 1 is"),
        ((VERTICES, [[0, 1, 2], [0, 1, 3], [9, 0, 0]]), r"face 1 is \[0, 1, 3\]"),
        ((VERTICES, [[0, -1, 2]]), "face 0 is"),
        ((VERTICES, [[0.0, 1.0, 2.0]]), "integers"),
        ((VERTICES, [[0, 1]]), r"\(m, 3\) integers"),
        ((VERTICES[:, :2], [[0, 1, 2]]), "vertices have shape"),
        ((VERTICES, [[0, 1, 2]], np.zeros((2, 2))), r"uvs have shape \(2, 2\): need \(3, 2\)"),
        ((VERTICES, [[0, 1, 2]], None, np.full((3, 3), np.nan)), "normals: vertex 0"),
    ],
)
def test_broken_meshes_are_refused(arguments, message):
    """The first bad vertex or face is named."""
    with pytest.raises(ValueError, match=message):
        TriangleMesh(*arguments)


def test_a_mesh_cannot_be_changed():
    """Arrays of a mesh are read-only copies, in float64 and uint32."""
    vertices = VERTICES.copy()
    mesh = TriangleMesh(vertices, [[0, 1, 2]])
    vertices[0] = 7
    assert mesh.vertices[0].tolist() == [0, 0, 0]
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float64, np.uint32)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1
