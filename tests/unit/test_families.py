"""Scene families of a sweep: files, rotations, places, copies, and meshes of any format brought to a size."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from nlosrender.config import families, sweep_load
from nlosrender.config.draws import Draw
from nlosrender.config.families import FLOOR_GAP
from nlosrender.config.hidden_geometry import MESH_SUFFIXES
from nlosrender.config.load import parse_config, parse_document
from nlosrender.errors import ConfigError
from nlosrender.scene.item_bounds import item_bounds
from nlosrender.scene.meshes.mesh_file import READERS, read_mesh_file
from nlosrender.scene.meshes.primitives import box_mesh
from nlosrender.scene.pose import Pose, euler_xyz
from nlosrender.scene.read_surfaces import describe_meshes

BASE = """\
name: family
scene:
  relay_wall: {type: rectangle, width: 2.0, height: 1.6}
  hidden_geometry:
    - {type: sphere, radius: 0.1, center: [0.1, 0, 0.9]}
    - {type: rectangle, width: 4, height: 4, center: [0, -1, 1], normal: [0, 1, 0], up: [0, 0, 1]}
capture: {scan_type: confocal, sensor_grid: {nx: 5, ny: 3}}
"""


def write_box(path: Path, size: tuple[float, float, float] = (1, 2, 4), center: tuple[float, ...] = (7, 8, 9)) -> None:
    """Write a box as .obj."""
    mesh = box_mesh(size, Pose(np.eye(3), np.asarray(center, dtype=float)))
    lines = [f"v {' '.join(map(str, vertex))}" for vertex in mesh.vertices]
    path.write_text("\n".join(lines + [f"f {' '.join(map(str, face + 1))}" for face in mesh.faces.astype(int)]))


def sweep_of(keys: str, folder: Path = Path("/tmp"), count: int = 20, base: str = BASE) -> sweep_load.Sweep:
    """Parse a sweep with random keys, a flow mapping."""
    text = f"{base}sweep: {{random: {{count: {count}, seed: 3, keys: {keys}}}}}\n"
    sweep = sweep_load.sweep_of(parse_document(text, "z.yaml", folder), item_bounds)
    assert sweep is not None
    return sweep


def problems_of(keys: str, folder: Path = Path("/tmp")) -> str:
    """Parse a sweep that has a mistake."""
    with pytest.raises(ConfigError) as caught:
        sweep_of(keys, folder)
    return str(caught.value)


def test_rotations_are_uniform() -> None:
    """Over all rotations each entry of the matrix has mean 0 and mean square 1/3, and any two are uncorrelated."""
    n = 4000
    draw = Draw("rotation", ())
    entries = np.array([euler_xyz(draw.value("a", 1, number)).ravel() for number in range(n)])
    # 5 sigma for 9 + 81 numbers; an entry squared has the variance 1/5 - 1/9, a product of two at most 1/9
    assert np.abs(entries.mean(axis=0)).max() < 5 * math.sqrt(1 / 3 / n)
    moments = entries.T @ entries / n
    assert np.abs(moments - np.eye(9) / 3).max() < 5 * math.sqrt(1 / 9 / n)


def test_places_and_angles_stay_in_their_spans() -> None:
    """Three independent coordinates, each between its ends and with their mean."""
    spans = ((-1.0, 1.0), (0.0, 3.0), (2.0, 2.0))
    for kind in ("inside", "rotation"):
        drawn = np.array([Draw(kind, spans).value("k", 5, number) for number in range(3000)])
        assert np.all((drawn >= [-1, 0, 2]) & (drawn <= [1, 3, 2]))
        assert np.abs(drawn.mean(axis=0) - [0, 1.5, 2]).max() < 5 * 3 / math.sqrt(12 * 3000)  # 5 sigma
        assert abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]) < 5 / math.sqrt(3000)


def test_files_of_a_folder(tmp_path: Path) -> None:
    """Files are sorted by name; ``each`` takes one after the other, ``random`` any; further folders change nothing."""
    for name in ("b/2.obj", "a/1.obj", "a/3.obj", "c/notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_box(tmp_path / name)
    key = "scene.hidden_geometry.0"
    item = "{type: mesh, translate: [0, 0, 1], filename: {files: '**/*.obj', pick: each}}"
    sweep = sweep_of(f"{{{key}: {item}}}", tmp_path, count=5)
    names = [sweep.values(i)[f"{key}.filename"] for i in range(5)]
    assert names == ["a/1.obj", "a/3.obj", "b/2.obj", "a/1.obj", "a/3.obj"]
    assert sweep.facts(0).files == {f"{key}.filename": "a/1.obj"}
    assert sweep.config(2).scene.hidden_geometry[0].filename == tmp_path / "b/2.obj"
    sweep = sweep_of(f"{{{key}: {item.replace('each', 'random')}}}", tmp_path, count=60)
    counts = [sum(sweep.values(i)[f"{key}.filename"] == name for i in range(60)) for name in names[:3]]
    assert min(counts) > 20 - 5 * math.sqrt(60 * 2 / 9)  # 5 sigma
    assert sum(counts) == 60


def test_draws_inside_a_value_are_those_of_dotted_keys() -> None:
    """A value with draws in it is the same as those draws under their dotted keys."""
    nested = (
        "{scene.hidden_geometry.0: {type: sphere, radius: {uniform: [0.1, 0.2]}, center: [0, 0, {uniform: [1, 2]}]}}"
    )
    dotted = (
        "{scene.hidden_geometry.0.radius: {uniform: [0.1, 0.2]}, scene.hidden_geometry.0.center.2: {uniform: [1, 2]}}"
    )
    a, b = sweep_of(nested), sweep_of(dotted)
    assert [a.values(i) for i in range(20)] == [b.values(i) for i in range(20)]
    assert a.config(7).scene.hidden_geometry[0].radius == b.config(7).scene.hidden_geometry[0].radius


def test_a_choice_between_items_with_draws() -> None:
    """A chosen item brings its own draws, and its values go into the index."""
    keys = """{scene.hidden_geometry.0: {choice: [{type: box, center: [0, 0, 1], size: {inside: [[0.1, 0.3], [0.1, 0.3],
      [0.1, 0.3]]}}, {type: sphere, center: [0, 0, 1], radius: {uniform: [0.1, 0.2]}}]}}"""
    sweep = sweep_of(keys)
    types = [sweep.values(i)["scene.hidden_geometry.0.type"] for i in range(20)]
    assert set(types) == {"box", "sphere"}
    assert [sweep.config(i).scene.hidden_geometry[0].type for i in range(20)] == types
    sizes = {tuple(sweep.config(i).scene.hidden_geometry[0].size) for i in range(20) if types[i] == "box"}
    assert len(sizes) == types.count("box")


def family(count: str, more: str = "") -> str:
    """Return random keys of a family of boxes."""
    size = "{inside: [[0.1, 0.4], [0.1, 0.4], [0.1, 0.4]]}"
    return f"""{{scene.hidden_geometry.0: {{name: brick, type: box, size: {size}, count: {count},
      rotate_deg: {{rotation: uniform}}, center: {{inside: [[-0.8, 0.8], [-0.3, 0.7], [0.5, 1.7]]}}{more}}}}}"""


def test_copies_have_draws_of_their_own() -> None:
    """A drawn number of copies; they stand behind the file's items; keys of copies end in #1, #2."""
    sweep = sweep_of(family("{integers: [0, 3]}"))
    counts = [sweep.values(i)["scene.hidden_geometry.0.count"] for i in range(20)]
    assert set(counts) == {0, 1, 2, 3}
    for index, count in enumerate(counts):
        config, facts = sweep.capture(index)
        types = [item.type for item in config.scene.hidden_geometry]
        assert types == ["box"] * (count > 0) + ["rectangle"] + ["box"] * max(count - 1, 0)
        names = [item.name for item in config.scene.hidden_geometry if item.type == "box"]
        assert names == ["brick", "brick-2", "brick-3"][:count]
        sizes = [item.size for item in config.scene.hidden_geometry if item.type == "box"]
        assert len(set(sizes)) == count
        for number in range(1, count):
            assert facts.values[f"scene.hidden_geometry.0.size#{number}"] == list(sizes[number])


def test_more_copies_leave_the_first_ones(tmp_path: Path) -> None:
    """A larger count adds items and changes none."""
    few, many = sweep_of(family("2")), sweep_of(family("4"))
    for index in range(5):
        a, b = (sweep.config(index).scene.hidden_geometry for sweep in (few, many))
        assert b[: len(a)] == a


def boxes_of(sweep: sweep_load.Sweep, index: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the boxes around the items of a capture."""
    boxes = [item_bounds(item) for item in sweep.config(index).scene.hidden_geometry]
    return [box for box in boxes if box is not None]


def test_no_overlap_on_a_floor() -> None:
    """Boxes of all items are apart, and lie above the floor by the gap; sizes are those of a free family."""
    apart, free = sweep_of(family("4", ", no_overlap: true, on_floor: -1")), sweep_of(family("4"))
    n_moved = 0
    for index in range(10):
        boxes = boxes_of(apart, index)
        for i, (low, high) in enumerate(boxes):
            for other_low, other_high in boxes[:i]:
                assert np.any((low > other_high - 2e-6) | (other_low > high - 2e-6))
        lows = [low[1] for i, (low, _) in enumerate(boxes) if i != 1]
        assert lows == pytest.approx([-1 + FLOOR_GAP] * 4, abs=1e-12)
        items = zip(apart.config(index).scene.hidden_geometry, free.config(index).scene.hidden_geometry, strict=True)
        pairs = [(a, b) for a, b in items if a.type == "box"]
        assert all(a.size == b.size for a, b in pairs)
        n_moved += sum(a.center[::2] != b.center[::2] for a, b in pairs)
        where = apart.capture(index)[1].values["scene.hidden_geometry.0.center"]
        assert where == pytest.approx(pairs[0][0].center)
    assert 0 < n_moved < 40  # some places were rejected, not all


def test_a_capture_is_known_by_its_index() -> None:
    """More captures, or another order of asking, leave a capture as it is, its places included."""
    keys = family("3", ", no_overlap: true, on_floor: -1")
    short, long = sweep_of(keys, count=4), sweep_of(keys, count=9)
    assert [long.config(i) for i in (3, 1)] == [short.config(i) for i in (3, 1)]


def test_no_place_without_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no place is free the capture fails with its place in the file, and the sweep itself is valid."""
    monkeypatch.setattr(families, "ROUNDS", 2)
    monkeypatch.setattr(families, "MAX_TRIES", 5)
    keys = family("9", ", no_overlap: true").replace(
        "[-0.8, 0.8], [-0.3, 0.7], [0.5, 1.7]", "[0, 0.1], [0, 0.1], [1, 1.1]"
    )
    with pytest.raises(ConfigError, match=r"hidden_geometry.0: found no place without overlap for copy \d in 2 arr"):
        sweep_of(keys, count=1).config(0)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            "{scene.hidden_geometry.0.radius: {files: 'no/*.obj'}}",
            r"a pattern that some file matches; none in /tmp",
        ),
        ("{scene.hidden_geometry.0.radius: {files: '*', pick: some}}", "got 'some' \\(text\\), need random or each"),
        ("{scene.hidden_geometry.0.center: {inside: [[0, 1], [0, 1]]}}", r"need three pairs \[a, b\] with a <= b"),
        ("{scene.hidden_geometry.0.center: {inside: [[0, 1], [0, 1], [1, 0]]}}", r"need three pairs"),
        ("{scene.hidden_geometry.0.center: {rotation: any}}", "of x, y and z, or uniform"),
        ("{scene.hidden_geometry.0.radius: {type: 3}}", r"need one of {uniform: \[a, b\]}"),
        (
            "{scene.hidden_geometry.0.count: {integers: [-2, -1]}}",
            "count: got -[12], need an integer from 0 to 100",
        ),
        ("{scene.hidden_geometry.0.no_overlap: {choice: [maybe]}}", "no_overlap: got 'maybe'"),
        ("{scene.hidden_geometry.0.radius: {files: ['a\\0b']}}", "a pattern that some file matches"),
        (
            "{scene.hidden_geometry.0: {choice: [{type: room, size: [3, 3, {uniform: [1, 2]}], on_floor: 0}]}}",
            "not for room",
        ),
        (
            "{scene.hidden_geometry.0: {choice: [3, {type: box, size: {uniform: [1, 2]}, count: 2}]}}",
            "got 3, need a mapping",
        ),
        ("{scene.hidden_geometry.0.on_floor: {choice: [low]}}", "on_floor: got 'low' \\(text\\), need a height"),
    ],
)
def test_mistakes(keys: str, message: str) -> None:
    """Every mistake is told with what is allowed."""
    assert re.search(message, problems_of(keys)), problems_of(keys)


def test_family_keys_are_for_sweeps() -> None:
    """Outside of a sweep an item has no count."""
    with pytest.raises(ConfigError, match="count: unknown key"):
        parse_config(BASE.replace("radius: 0.1", "radius: 0.1, count: 2"), "z.yaml", Path("/tmp"))


@pytest.mark.parametrize("scale", ["1", "0.1", "[1, 1, -3]"])
def test_fit(tmp_path: Path, scale: str) -> None:
    """A mesh of any unit and origin: its box is centred on translate, its largest edge has the length asked for."""
    write_box(tmp_path / "box.obj")
    item = f"{{type: mesh, filename: box.obj, scale: {scale}, fit: {{largest: 0.6}}, translate: [0.1, 0.2, 1.5]}}"
    text = BASE.replace("{type: sphere, radius: 0.1, center: [0.1, 0, 0.9]}", item)
    config = parse_config(text, "z.yaml", tmp_path)
    low, high = item_bounds(config.scene.hidden_geometry[0])
    edges = np.array([1, 2, 12 if "3" in scale else 4])
    assert high - low == pytest.approx(0.6 * edges / edges.max(), abs=1e-12)
    assert (low + high) / 2 == pytest.approx([0.1, 0.2, 1.5], abs=1e-12)
    (report,) = describe_meshes(config.scene).meshes
    assert report.extent == pytest.approx(tuple(high - low))
    assert report.disagreeing_edges == 0


def test_every_suffix_has_a_reader() -> None:
    """What the configuration takes is what can be read."""
    assert {f".{kind}" for kind in READERS} == set(MESH_SUFFIXES)


@pytest.mark.parametrize("kind", ["stl", "off", "glb"])
def test_formats_that_trimesh_reads(tmp_path: Path, kind: str) -> None:
    """The triangles of a file are those of the mesh that was written, in float64 where the format has it."""
    trimesh = pytest.importorskip("trimesh")
    box = box_mesh((1, 2, 4), Pose(np.eye(3), np.array([7.0, 8, 9])))
    written = trimesh.Trimesh(box.vertices, box.faces.astype(int), process=False)
    path = tmp_path / f"box.{kind}"
    written.export(path)
    mesh = read_mesh_file(str(path), kind).mesh
    assert np.sort(mesh.vertices[mesh.faces].reshape(-1, 9), axis=0) == pytest.approx(
        np.sort(box.vertices[box.faces].reshape(-1, 9), axis=0), abs=1e-6
    )
    assert mesh.area == pytest.approx(28, rel=1e-6)
    path.write_bytes(path.read_bytes()[:37])
    with pytest.raises(ValueError, match=f"it is no .{kind} file|it has no triangles"):
        read_mesh_file(str(path), kind)


def test_a_mesh_file_with_a_tree(tmp_path: Path) -> None:
    """Parts of a .glb stand where its tree puts them, and materials are named, not read."""
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(1)
    ball.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(ball.vertices), 2)), material=trimesh.visual.material.PBRMaterial(name="wood")
    )
    scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.add_geometry(trimesh.creation.box((2, 2, 2)))
    path = tmp_path / "scene.glb"
    path.write_bytes(scene.export(file_type="glb"))
    read = read_mesh_file(str(path), "glb")
    low, high = read.mesh.bounds()
    assert (low[0], high[0]) == pytest.approx((-1, 6), abs=1e-6)
    assert "wood" in read.materials
    assert "texture coordinates" in read.dropped


def test_values_are_plain(tmp_path: Path) -> None:
    """What goes into the index is JSON."""
    sweep = sweep_of(family("3", ", no_overlap: true, on_floor: -1"))
    json.dumps(sweep.capture(0)[1].values, allow_nan=False)
