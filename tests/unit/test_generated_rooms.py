"""The meshes of the closed rooms: as many triangles as said, inside the room, and turned to the light."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import numpy as np
import pytest
from support.rendering import configured, flat_wall

from nlosrender.bench.generated_meshes import grid_faces, write_ply
from nlosrender.bench.paper.room_meshes import block, ellipsoid, write_furniture, write_statue
from nlosrender.bench.paper.rooms import ROOMS, Room, write_meshes
from nlosrender.bench.paper.study import Study
from nlosrender.config.load import config_hash, load_config, load_document
from nlosrender.config.sweep_load import sweep_of
from nlosrender.errors import ConfigError, FileError
from nlosrender.scene.meshes.mesh_file import read_mesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

PROJECT = Path(__file__).parents[2]


def volume(mesh: TriangleMesh) -> float:
    """Return the volume that a closed mesh with outward normals encloses (divergence theorem) [m^3]."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(("write", "asked"), [(write_statue, 20_000), (write_furniture, 400_000)])
def test_rooms_have_the_triangles_asked_for_and_stay_inside(tmp_path: Path, write, asked: int) -> None:
    """Within 1 % of the number, no triangle without area, all of it in a room of 2 x 2 x 2.2 m; written and read."""
    write(tmp_path / "room.ply", asked)
    mesh = read_mesh(str(tmp_path / "room.ply"), "ply", "flat")
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
    mesh = read_mesh(str(tmp_path / "a.ply"), "ply", "flat")
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_a_mesh_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that fails leaves neither half a mesh, which the next run would take for a whole one, nor a remnant."""

    def full(partial: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(FileError, match=r"a\.ply: cannot be written: No space left"):
        write_ply(tmp_path / "a.ply", np.eye(3), np.array([[0, 1, 2]]))
    assert not list(tmp_path.iterdir())


def test_a_room_that_has_no_mesh_yet_says_what_makes_it(tmp_path: Path) -> None:
    """The configurations that come along are valid once the command that their error names has run, and only then."""
    folder = tmp_path / "configs" / "paper"
    folder.mkdir(parents=True)
    study = Study(folder, tmp_path / "out" / "paper", quick=True)
    small = tuple(Room(room.config, 20_000, ROOMS[0].write) for room in ROOMS)
    for room in ROOMS:
        copy = folder / f"{room.config}.yaml"
        copy.write_text((PROJECT / "configs" / "paper" / copy.name).read_text(encoding="utf-8"), encoding="utf-8")
        with pytest.raises(ConfigError, match=r"there is no file at .* made by: nlosrender paper --meshes-only"):
            load_config(copy)
    assert [path.name for path in write_meshes(study, small)] == [f"{room.config}.ply" for room in ROOMS]
    for room in ROOMS:
        assert load_config(folder / f"{room.config}.yaml").scene.hidden_geometry[1].name in room.config


@pytest.mark.parametrize("path", sorted((PROJECT / "configs").rglob("*.yaml")), ids=lambda path: path.stem)
def test_every_configuration_is_valid_or_names_the_command_that_makes_its_mesh(path: Path) -> None:
    """On a fresh clone nothing else is missing; files do not go by the draw, so that 30 random captures tell it."""
    document = load_document(path)
    if document.tree.get("sweep") is not None:
        if (drawn := document.tree["sweep"].get("random")) is not None:
            drawn["count"] = 30
        assert sweep_of(document) is not None
        return
    with contextlib.suppress(ConfigError):
        load_config(path)
        return
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    (problem,) = caught.value.issues
    assert problem.message.endswith("It is made by: nlosrender paper --meshes-only")


def test_how_a_mesh_is_made_is_no_part_of_the_capture(tmp_path: Path) -> None:
    """Two configurations that differ in ``made_by`` alone are one capture, for meshes and mesh walls."""
    write_ply(tmp_path / "a.ply", np.eye(3), np.array([[0, 1, 2]]))
    mesh = {"type": "mesh", "filename": "a.ply"}
    made = {**mesh, "made_by": "make meshes"}
    hashes = {config_hash(configured(flat_wall(item) | {"name": "one"}, folder=tmp_path)) for item in (mesh, made)}
    walls = set()
    for wall in (mesh, made):
        config = flat_wall(capture={"sensor_grid": {"nx": 3, "ny": 2, "width": 1, "height": 1}})
        config["scene"]["relay_wall"] = wall
        walls.add(config_hash(configured(config, folder=tmp_path)))
    assert len(hashes) == len(walls) == 1
