"""The meshes of the closed rooms: as many triangles as said, inside the room, and turned to the light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nlosrender.bench.meshes import grid_faces, write_ply
from nlosrender.bench.paper.room_meshes import block, ellipsoid, write_furniture, write_statue
from nlosrender.scene.mesh_file import read_mesh
from nlosrender.scene.triangle_mesh import TriangleMesh


def volume(mesh: TriangleMesh) -> float:
    """Return the volume that a closed mesh with outward normals encloses (divergence theorem) [m^3]."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(("write", "asked"), [(write_statue, 20_000), (write_furniture, 400_000)])
def test_rooms_have_the_triangles_asked_for_and_stay_inside(tmp_path: Path, write, asked: int) -> None:
    """Within 1 % of the number, no triangle without area, all of it in a room of 2 x 2 x 2.2 m; written and read."""
    write(tmp_path / "room.ply", asked)
    mesh = read_mesh(str(tmp_path / "room.ply"), "ply", face_normals=True)
    assert len(mesh.faces) == pytest.approx(asked, rel=0.01)
    low, high = mesh.bounds()
    assert (low >= [-1, -1, 0]).all()
    assert (high <= [1, 1, 2.2]).all()


def test_solids_are_closed_and_turned_outwards() -> None:
    """Their volume by the divergence theorem: exact for a box, second order in the cells for an ellipsoid."""
    assert volume(TriangleMesh(*block((0.1, 0.2, 0.3), (0.4, 0.6, 0.8), 3))) == pytest.approx(0.3 * 0.4 * 0.5)
    round_one = TriangleMesh(*ellipsoid((1, 2, 3), (0.3, 0.2, 0.1), 64))
    # inscribed: a chord of angle pi / 64 cuts off (pi / 64)^2 / 6 in each of two directions
    assert volume(round_one) == pytest.approx(4 / 3 * np.pi * 0.3 * 0.2 * 0.1, rel=(np.pi / 64) ** 2)


def test_grid_faces_are_counter_clockwise() -> None:
    """A grid whose columns go right and rows go up looks at the viewer, and covers its area."""
    x, y = np.meshgrid(np.linspace(0, 3, 6), np.linspace(0, 2, 5))
    mesh = TriangleMesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), grid_faces(4, 5))
    assert mesh.area == pytest.approx(6)
    np.testing.assert_allclose(mesh.face_normals(), np.tile([0, 0, 1], (40, 1)))


def test_a_written_mesh_is_read_as_it_was(tmp_path: Path) -> None:
    """Binary, float32."""
    vertices = np.array([[0, 0, 0], [1, 0, 0.5], [0, 1, 0.25], [1, 1, 0]])
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    write_ply(tmp_path / "a.ply", vertices, faces)
    mesh = read_mesh(str(tmp_path / "a.ply"), "ply", face_normals=True)
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
