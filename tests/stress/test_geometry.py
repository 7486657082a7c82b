"""Laws of geometry: what a mesh is made of does not matter, only where its surface is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import Ledger
from stressed import BOTH, Array, noise_of, relative_difference, scene
from support.rendering import Rendering, configured, render

from nlosrender.bench.generated_meshes import write_ply
from nlosrender.errors import ConfigError
from nlosrender.rendering import stages

TWO_SIDED = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": 1.0}}
QUAD = np.array([[-0.3, -0.2, 0.0], [0.3, -0.2, 0.0], [0.3, 0.2, 0.0], [-0.3, 0.2, 0.0]])
TOWARDS_WALL = np.array([[0, 2, 1], [0, 3, 2]])


def saved(path: Path, vertices: Array, faces: np.ndarray) -> Path:
    """Write a mesh; return its path."""
    write_ply(path, vertices, faces)
    return path


def of_mesh(path: Path, engine: str, bsdf: dict | None = None, **changes: object) -> Rendering:
    """Render a mesh, 0.9 m in front of the wall."""
    item: dict = {"type": "mesh", "filename": str(path), "translate": [0.1, 0.0, 0.9], "face_normals": True}
    if bsdf:
        item["bsdf"] = bsdf
    return render(scene(item, engine=engine, **({"max_bounces": 3, "sensors": (3, 2)} | changes)))


def strips(n: int) -> tuple[Array, np.ndarray]:
    """Return the quad cut into ``n`` strips of two triangles each."""
    x = np.linspace(-0.3, 0.3, n + 1)
    vertices = np.concatenate([np.column_stack([x, np.full(n + 1, y), np.zeros(n + 1)]) for y in (-0.2, 0.2)])
    i = np.arange(n)
    lower, upper = i, i + n + 1
    faces = np.concatenate([np.column_stack([lower, upper + 1, lower + 1]), np.column_stack([lower, upper, upper + 1])])
    return vertices, faces


def grid(n: int, m: int) -> tuple[Array, np.ndarray]:
    """Return the quad cut into n x m cells of two triangles each."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, n + 1), np.linspace(-0.2, 0.2, m + 1))
    corner = (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()
    right, above, across = corner + 1, corner + n + 1, corner + n + 2
    faces = np.concatenate([np.column_stack([corner, across, right]), np.column_stack([corner, above, across])])
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), faces


def variants() -> dict[str, tuple[Array, np.ndarray]]:
    """Return meshes whose surface is that of the quad."""
    far = np.array([[1e20, 0.0, 0.0], [3.0, -4.0, 5.0]])
    needless = np.array([[0, 0, 1], [2, 2, 2], [0, 1, 1]])
    on_a_line = np.array([[-0.3, -0.2, 0.0], [0.0, -0.2, 0.0], [0.3, -0.2, 0.0]])
    return {
        "zero-area triangles": (
            np.concatenate([QUAD, on_a_line]),
            np.concatenate([TOWARDS_WALL, needless, [[4, 5, 6]]]),
        ),
        "duplicate vertices": (QUAD[[0, 2, 1, 0, 3, 2]], np.arange(6).reshape(2, 3)),
        "unreferenced vertices": (np.concatenate([QUAD, far]), TOWARDS_WALL),
        "coplanar double faces": (np.concatenate([QUAD, QUAD]), np.concatenate([TOWARDS_WALL, TOWARDS_WALL + 4])),
        "doubles with other corners first": (QUAD, np.concatenate([TOWARDS_WALL, TOWARDS_WALL[:, [1, 2, 0]]])),
    }


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("variant", variants())
def test_needless_parts_of_a_mesh_change_nothing(variant: str, engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """Triangles without area, doubles, and vertices nobody uses are not there."""
    plain = of_mesh(saved(tmp_path / "plain.ply", QUAD, TOWARDS_WALL), engine)
    other = of_mesh(saved(tmp_path / "other.ply", *variants()[variant]), engine)
    assert plain.mean.sum() > 0
    ledger.check(
        f"needless parts of a mesh change nothing ({engine})", relative_difference(other.mean, plain.mean), 1e-6
    )


@pytest.mark.parametrize("engine", BOTH)
def test_the_winding_of_a_two_sided_mesh_does_not_matter(engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """Some faces turned round, on a two-sided material: the same light."""
    turned = np.array([[0, 2, 1], [0, 2, 3]])
    plain = of_mesh(saved(tmp_path / "plain.ply", QUAD, TOWARDS_WALL), engine, TWO_SIDED)
    other = of_mesh(saved(tmp_path / "other.ply", QUAD, turned), engine, TWO_SIDED)
    # the corners of a triangle change places, and so do the samples on it
    allowed = noise_of(plain, other)
    ledger.check(f"mixed winding, two-sided ({engine})", relative_difference(other.mean, plain.mean), allowed)


@pytest.mark.stress
@pytest.mark.parametrize("engine", BOTH)
def test_slivers_are_the_surface_they_cover(engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """A plate of 100_000 slivers of 0.4 m x 6 micrometres, 7e4 : 1 (float32 has no thinner ones that tile)."""
    plain = of_mesh(saved(tmp_path / "plain.ply", QUAD, TOWARDS_WALL), engine)
    other = of_mesh(saved(tmp_path / "other.ply", *strips(100_000)), engine)
    allowed = noise_of(plain, other)
    ledger.check(f"slivers of 7e4:1 ({engine})", relative_difference(other.mean, plain.mean), allowed)
    deviation = abs(other.mean.sum() / plain.mean.sum() - 1)
    ledger.check(f"energy of slivers of 7e4:1 ({engine})", float(deviation), 0.02)


@pytest.mark.parametrize("engine", BOTH)
def test_one_sliver_of_a_million_to_one_harms_nothing(engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """A triangle of 0.6 m x 0.6 micrometres beside the plate adds 5e-7 of its area."""
    vertices = np.concatenate([QUAD, [[-0.3, 0.25, 0.0], [0.3, 0.25, 0.0], [0.3, 0.25 + 6e-7, 0.0]]])
    plain = of_mesh(saved(tmp_path / "plain.ply", QUAD, TOWARDS_WALL), engine)
    other = of_mesh(saved(tmp_path / "other.ply", vertices, np.concatenate([TOWARDS_WALL, [[4, 6, 5]]])), engine)
    allowed = noise_of(plain, other)
    ledger.check(f"a sliver of 1e6:1 beside a plate ({engine})", relative_difference(other.mean, plain.mean), allowed)


@pytest.mark.stress
@pytest.mark.parametrize("engine", BOTH)
def test_surfaces_that_cross_in_one_mesh_are_those_of_two(engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """Non-manifold and self-intersecting: two crossing plates in one file or in two."""
    turn = np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]])
    first = saved(tmp_path / "first.ply", QUAD, TOWARDS_WALL)
    second = saved(tmp_path / "second.ply", QUAD @ turn.T, TOWARDS_WALL)
    both = np.concatenate([QUAD, QUAD @ turn.T]), np.concatenate([TOWARDS_WALL, TOWARDS_WALL + 4])
    joined = of_mesh(saved(tmp_path / "both.ply", *both), engine, TWO_SIDED)
    items = [
        {"type": "mesh", "filename": str(path), "translate": [0.1, 0.0, 0.9], "face_normals": True, "bsdf": TWO_SIDED}
        for path in (first, second)
    ]
    apart = render(scene(*items, engine=engine, max_bounces=3, sensors=(3, 2)))
    allowed = noise_of(joined, apart)
    ledger.check(
        f"crossing surfaces in one mesh or two ({engine})", relative_difference(joined.mean, apart.mean), allowed
    )


@pytest.mark.stress
@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("cells", [(1000, 500), (2500, 1000)])
def test_millions_of_triangles_are_the_surface_they_cover(
    cells: tuple[int, int], engine: str, tmp_path: Path, ledger: Ledger
) -> None:
    """1 and 5 million triangles of one plate: the plate."""
    plain = of_mesh(saved(tmp_path / "plain.ply", QUAD, TOWARDS_WALL), engine)
    other = of_mesh(saved(tmp_path / "other.ply", *grid(*cells)), engine)
    allowed = noise_of(plain, other)
    law = f"{2 * cells[0] * cells[1]:_} triangles are the plate they tile ({engine})"
    ledger.check(law, relative_difference(other.mean, plain.mean), allowed)


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize(
    "item",
    [
        {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [0, 0, -0.5], "normal": [0, 0, 1]},
        {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [0, 0, 0.5], "normal": [0, 0, 1]},
        {"type": "sphere", "center": [0, 0, -2.0], "radius": 1.0},
        {"type": "box", "center": [0, 0, -1e-6], "size": [1.0, 1.0, 1e-6]},
    ],
)
def test_what_the_wall_cannot_see_gives_exactly_nothing(engine: str, item: dict, ledger: Ledger) -> None:
    """Behind the wall, or with its back to it: zero, not something small."""
    result = render(scene(item, engine=engine, max_bounces=4, sensors=(3, 2)))
    ledger.check(f"light of what the wall cannot see ({engine})", float(result.mean.sum() + result.outside.sum()), 0.0)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.where(QUAD == 0.2, np.nan, QUAD), TOWARDS_WALL, r"vertex 2 is \[.*nan, 0\.0\], need finite numbers"),
        (np.where(QUAD == 0.3, np.inf, QUAD), TOWARDS_WALL, r"vertex 1 is \[inf, .*need finite numbers"),
        (QUAD, np.zeros((0, 3), dtype=int), "it has no triangles"),
        (QUAD, np.array([[0, 0, 1], [2, 2, 2]]), "none of its triangles has an area"),
        (QUAD, np.array([[0, 2, 9]]), r"face 0 is \[0, 2, 9\]: indices must lie between 0 and 3"),
        (QUAD * 1e7, TOWARDS_WALL, "need at most 100000 times the wall's size"),
        (QUAD * 1e-11, TOWARDS_WALL, "float32 rounds its triangles to nothing|it has no extent"),
    ],
)
def test_impossible_meshes_are_errors_that_name_what_is_wrong(
    vertices: Array, faces: np.ndarray, message: str, tmp_path: Path
) -> None:
    """The first vertex or face that cannot be is in the message."""
    with pytest.raises(ConfigError, match=message):
        of_mesh(saved(tmp_path / "bad.ply", vertices, faces), "path")


@pytest.mark.parametrize("engine", BOTH)
def test_an_item_on_top_of_another_counts_once(engine: str, tmp_path: Path, ledger: Ledger) -> None:
    """A second item that lies exactly on the first, and goes on beside it, is all there is to see; that is said."""
    beside = QUAD + np.array([0.0, 0.5, 0.0])
    halves = np.concatenate([QUAD, beside]), np.concatenate([TOWARDS_WALL[:, [2, 0, 1]], TOWARDS_WALL + 4])
    place = {"type": "mesh", "translate": [0.1, 0.0, 0.9], "face_normals": True}
    first, both = (
        place | {"filename": str(saved(tmp_path / f"{name}.ply", *mesh))}
        for name, mesh in (("first", (QUAD, TOWARDS_WALL)), ("both", halves))
    )
    grey = {"bsdf": {"type": "diffuse", "reflectance": 0.25}}
    settings = {"engine": engine, "max_bounces": 3, "sensors": (3, 2)}
    overlaid = render(scene(first, both | grey, **settings))
    alone = render(scene(both | grey, **settings))
    assert alone.mean.sum() > 0
    difference, allowed = relative_difference(overlaid.mean, alone.mean), noise_of(overlaid, alone)
    ledger.check(f"an item on top of another counts once ({engine})", difference, allowed)
    with_overlap = scene(first, both | grey, **settings)
    built = stages.load_scene(configured(with_overlap))
    assert any("1: 50 % of its area lies where scene.hidden_geometry.0" in text for text in built.warnings)


def test_sheets_that_face_opposite_ways_in_one_place_are_left_alone() -> None:
    """Two boxes that share a side have such faces, and nobody sees them."""
    boxes = [{"type": "box", "center": [x, 0, 1], "size": [0.2, 0.2, 0.2]} for x in (-0.1, 0.1)]
    together = render(scene(*boxes, engine="virtual_lights", max_bounces=3, sensors=(3, 2)))
    assert together.mean.sum() > 0
